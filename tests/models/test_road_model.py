from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from unjam.drivers import PISaturation
from unjam.errors import InputError
from unjam.models.ensemble import ModelFit, torch_generator
from unjam.models.registry import world_model_class
from unjam.models.road_model import RoadEnsemble, base_human_model, fit_road_model, learned_human_model, road_samples
from unjam.models.settings import ModelSettings
from unjam.scenarios import FigureEight, Merge, Ring
from unjam.scenarios.ring import LoopScenario
from unjam.worlds.batch.run import run_batch
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import EpisodeTask

RING = Ring(length=(120, 130), vehicles=8, horizon=600, warmup=0)
EIGHT = FigureEight(horizon=600, warmup=0)


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return run_batch([EpisodeTask(RING, PISaturation(), (seed,)) for seed in range(10)])


@pytest.fixture(scope="module")
def figure_eights() -> list[Episode]:
    tasks = [EpisodeTask(EIGHT, PISaturation(), (seed,)) for seed in range(10)]
    return run_batch(tasks, allow_statistical=True)


def fitted(episodes: list[Episode], road: LoopScenario = RING, **changes: Any) -> tuple[RoadEnsemble, ModelFit]:
    settings = ModelSettings(kind="road", **changes)
    model = RoadEnsemble(settings, (0,))
    samples = [road_samples(episode, number, road) for number, episode in enumerate(episodes)]
    return model, fit_road_model(model, samples, settings, road, (1,))


def test_exact_base_leaves_only_noise(episodes: list[Episode]) -> None:
    model, found = fitted(episodes)
    assert found.learned_targets == ()
    assert found.errors["unexplained_variance"] < 1e-9
    assert found.errors["transitions"] < 1e-6
    assert found.errors["total_variation"] == 0.0
    assert float(model.noise) == pytest.approx(RING.noise_per_step * RING.simulation_step, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("base", ["none", "ovm"])
def test_networks_learn_what_the_base_lacks(episodes: list[Episode], base: str) -> None:
    _, found = fitted(episodes, base=base, epochs=20)
    step = found.one_step["speed"]
    assert found.learned_targets == ("speed",)
    assert step.model < step.base / 3
    assert found.errors["unexplained_variance"] == pytest.approx((step.model / step.change) ** 2)


@pytest.mark.slow
def test_right_of_way_and_noise_are_no_model_error_on_a_figure_eight(figure_eights: list[Episode]) -> None:
    model, found = fitted(figure_eights, EIGHT)
    sigma = EIGHT.noise_per_step * EIGHT.simulation_step
    assert found.one_step["speed"].base == pytest.approx(sigma, rel=0.05)
    assert found.errors["unexplained_variance"] < 0.02
    assert float(model.noise) == sigma


@pytest.mark.slow
def test_networks_learn_what_the_base_lacks_on_a_figure_eight(figure_eights: list[Episode]) -> None:
    _, found = fitted(figure_eights, EIGHT, base="none", epochs=20)
    sigma, step = EIGHT.noise_per_step * EIGHT.simulation_step, found.one_step["speed"]
    assert found.learned_targets == ("speed",)
    assert step.base > 2 * sigma
    assert step.model == pytest.approx(sigma, rel=0.2)


def test_part_of_too_few_episodes_is_held_out(episodes: list[Episode]) -> None:
    assert fitted(episodes[:1])[1].holdout_rows > 0


def test_samples_are_recorded_states_and_next_states(episodes: list[Episode]) -> None:
    episode = episodes[3]
    samples = road_samples(episode, 7, RING)
    assert (samples.episode, samples.interval, samples.is_human.sum()) == (7, 1, 7)
    np.testing.assert_array_equal(samples.next_speeds, episode.speeds[1:])
    drivers = samples.is_human > 0
    noise = (samples.next_speeds - samples.intended_speeds)[:, drivers][samples.intended_speeds[:, drivers] > 0.5]
    assert abs(noise.mean()) < 0.002
    assert np.abs((samples.next_speeds - samples.intended_speeds)[:, ~drivers]).max() < 1e-9


@pytest.mark.parametrize(
    ("road", "why"),
    [(Merge(), "merge is not a ring"), (replace(RING, steps_per_control_step=2), "steps_per_control_step is 2")],
)
def test_unsupported_roads_are_refused(road: Any, why: str) -> None:
    settings = ModelSettings(kind="road")
    with pytest.raises(InputError, match=f"model.kind: road is not allowed; allowed: row, for .*{why}"):
        world_model_class(road, settings).check(road, settings)


def test_learned_human_model_on_tensors_equals_arrays(episodes: list[Episode]) -> None:
    model, _ = fitted(episodes, base="none", epochs=5)
    inputs = [np.array([[3.0, 9.0], [0.0, 25.0]]), np.array([[4.0, 2.0], [1.0, 20.0]])]
    inputs.append(np.array([[5.0, 12.0], [2.0, 30.0]]))
    on_arrays, on_tensors = (learned_human_model(model, RING, torch_generator((1,), "cpu")) for _ in range(2))
    found = on_tensors(*map(torch.from_numpy, inputs))
    assert torch.equal(found, torch.from_numpy(on_arrays(*inputs)))
    assert not torch.equal(found, base_human_model("none", RING)(*map(torch.from_numpy, inputs)))
