from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from unjam.drivers import PISaturation
from unjam.errors import InputError
from unjam.scenarios import FigureEight, Ring
from unjam.virtual.fitting import Fit
from unjam.virtual.roads import RoadModel, check_roads, fit_roads, moments_of
from unjam.virtual.settings import VirtualSettings
from unjam.worlds.batch.run import run_batch
from unjam.worlds.record import Episode
from unjam.worlds.workers import EpisodeTask

RING = Ring(length=(120, 130), vehicles=8, horizon=600, warmup=0)


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return run_batch([EpisodeTask(RING, PISaturation(), (seed,)) for seed in range(10)])


def fitted(episodes: list[Episode], **changes: Any) -> tuple[RoadModel, Fit]:
    settings = VirtualSettings(model="road", **changes)
    model = RoadModel(settings, (0,))
    kept = [moments_of(episode, number) for number, episode in enumerate(episodes)]
    return model, fit_roads(model, kept, settings, RING, (1,))


def test_where_people_are_known_only_their_noise_is_left(episodes: list[Episode]) -> None:
    model, found = fitted(episodes)
    assert found.learned == ()
    assert found.errors["unexplained"] < 1e-9
    assert found.errors["transitions"] < 1e-6
    assert found.errors["total_variation"] == 0.0
    assert float(model.noise) == pytest.approx(RING.noise_per_step * RING.simulation_step, rel=0.05)


@pytest.mark.parametrize("base", ["none", "ovm"])
def test_what_a_base_does_not_know_the_networks_learn(episodes: list[Episode], base: str) -> None:
    _, found = fitted(episodes, base=base, epochs=20)
    step = found.one_step["speed"]
    assert found.learned == ("speed",)
    assert step.model < step.base / 3
    assert found.errors["unexplained"] == pytest.approx((step.model / step.change) ** 2)


def test_too_few_episodes_are_held_out_in_part(episodes: list[Episode]) -> None:
    assert fitted(episodes[:1])[1].held_out > 0


def test_moments_are_what_was_recorded_and_what_came_next(episodes: list[Episode]) -> None:
    episode = episodes[3]
    kept = moments_of(episode, 7)
    assert (kept.episode, kept.every, kept.people.sum()) == (7, 1, 7)
    np.testing.assert_array_equal(kept.after, episode.speeds[1:])
    drivers = kept.people > 0
    noise = (kept.after - kept.moved)[:, drivers][kept.moved[:, drivers] > 0.5]
    assert abs(noise.mean()) < 0.002
    assert np.abs((kept.after - kept.moved)[:, ~drivers]).max() < 1e-9


@pytest.mark.parametrize(
    ("road", "why"),
    [(FigureEight(), "it is no ring"), (replace(RING, steps_per_decision=2), "steps_per_decision is 2")],
)
def test_other_roads_are_refused_in_one_line(road: Any, why: str) -> None:
    with pytest.raises(InputError, match=f"virtual.model: road is not allowed; allowed: row, for .*{why}"):
        check_roads(road)
