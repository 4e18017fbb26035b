"""A batch of figure eights agrees with SUMO's episodes, step by step and in the mean."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worlds.batch.one_step import errors
from unjam.drivers import Constant
from unjam.drivers.registry import driver_from_name
from unjam.drivers.safety import INSTANT_ACTUATOR
from unjam.errors import InputError
from unjam.measures.metrics import measure
from unjam.scenarios import FigureEight, Ring
from unjam.scenarios.road import ClosedRoad
from unjam.training.config import RunConfig
from unjam.worlds.batch.figure_eight.crossing import FigureEightMovement, crossing_memories, figure_eight_contacts
from unjam.worlds.batch.run import WARM_UP_CACHE, run_batch
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Floats
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask

SHORT = FigureEight(horizon=300)
"""vehicles that must yield have waited for some vehicles, gone before others, and stood"""


def tasks(eight: FigureEight, expert: str, seeds: range) -> list[EpisodeTask]:
    return [EpisodeTask(eight, driver_from_name(expert, eight.control_step), (seed,)) for seed in seeds]


EIGHTS: dict[str, tuple[FigureEight, str, int]] = {
    "human-only traffic": (SHORT, "human", 170),
    "a CAV": (SHORT, "pi", 300),
    "three CAVs": (replace(SHORT, cavs=3), "pi", 300),
    "a CAV after a warm-up": (replace(SHORT, warmup=130, horizon=150), "idm", 40),
    "few on a small one": (replace(SHORT, vehicles=6, radius=(30, 31)), "idm", 60),
    "patient human drivers": (replace(SHORT, impatience=0.0), "pi", 80),
    "commands that are held": (replace(SHORT, steps_per_control_step=5, horizon=30), "pi", 30),
}
"""by what is special: road, driver, and for how many decisions it is to be SUMO's"""


@pytest.mark.long
@pytest.mark.parametrize("name", EIGHTS)
def test_it_begins_as_sumos_of_the_same_seed(name: str, sumo: SumoBackend) -> None:
    eight, expert, until = EIGHTS[name]
    for task, found in zip(
        tasks(eight, expert, range(2)), run_batch(tasks(eight, expert, range(2)), allow_statistical=True), strict=True
    ):
        actual = run_episode(eight, task.driver, task.seed, backend=sumo)
        assert np.abs(found.speeds[:until] - actual.speeds[:until]).max() < 1e-3
        assert np.abs(found.positions[:until] - actual.positions[:until]).max() < 1e-2
        assert found.crossings == actual.crossings
        states, expected = found.trajectories[0].states, actual.trajectories[0].states
        assert states.distance_to_crossing[:until] == pytest.approx(expected.distance_to_crossing[:until], abs=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("expert", ["human", "pi"])
def test_from_each_of_sumos_moments_a_step_is_sumos(expert: str, simulation: Simulation) -> None:
    eight = replace(SHORT, horizon=900, actuator=INSTANT_ACTUATOR)  # a moment has no pending commands
    found = np.abs(errors(eight, driver_from_name(expert, eight.control_step), 3, simulation))
    assert np.median(found) < 1e-12
    # A vehicle at the stop line may creep, and where times differ only by rounding a vehicle may start a step later.
    assert (found > 1e-6).mean() < 0.02
    assert (found > 1e-4).sum() <= 1


@pytest.mark.slow
def test_whole_episodes_are_alike(sumo: SumoBackend) -> None:
    eight, seeds = FigureEight(), range(3)
    found = run_batch(tasks(eight, "idm", seeds), allow_statistical=True)
    driver = driver_from_name("idm", eight.control_step)
    for episode, seed in zip(found, seeds, strict=True):
        actual = run_episode(eight, driver, seed, backend=sumo)
        assert episode.status == actual.status == "completed"
        assert episode.speeds.mean() == pytest.approx(actual.speeds.mean(), rel=0.01)
        assert measure(episode)["return"] == pytest.approx(measure(actual)["return"], rel=0.01)
        stood = (episode.speeds < 0.1).mean(), (actual.speeds < 0.1).mean()
        assert 0.0 < stood[1] == pytest.approx(stood[0], abs=0.002)


def test_warmed_up_with_others_it_goes_on_to_the_same_bits() -> None:
    eight = replace(SHORT, warmup=230, horizon=100)
    WARM_UP_CACHE.clear()
    (alone,) = run_batch(tasks(eight, "pi", range(1)), allow_statistical=True)
    WARM_UP_CACHE.clear()
    run_batch(tasks(eight, "pi", range(2)), allow_statistical=True)
    (again,) = run_batch(tasks(eight, "pi", range(1)), allow_statistical=True)
    assert again.speeds.tobytes() == alone.speeds.tobytes()


def test_who_waits_is_known_from_the_record(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, moved = [], FigureEightMovement.move

    def watched(movement: FigureEightMovement, *arguments: Any) -> Any:
        seen.append([each[:, 0] for each in movement.memory])
        return moved(movement, *arguments)

    monkeypatch.setattr(FigureEightMovement, "move", watched)
    (episode,) = run_batch(tasks(SHORT, "human", range(1)), allow_statistical=True)
    road = cast(ClosedRoad, SHORT.draw_from_seed((0,))[0])
    waited, entered = np.stack(seen, 1)
    assert waited.max() > 5.0
    assert 0.0 > entered.min() > -SHORT.horizon
    found = crossing_memories(SHORT, road, episode.speeds, episode.positions)
    np.testing.assert_allclose(found.waiting_time[:-1], waited, atol=1e-9)
    np.testing.assert_array_equal(found.entry_step[:-1], entered)


@pytest.mark.long
def test_tensors_do_what_arrays_do() -> None:
    def doubles(values: Floats) -> Tensor:
        return torch.as_tensor(values)

    asked = tasks(replace(SHORT, horizon=150), "pi", range(2))
    for one, other in zip(
        run_batch(asked, allow_statistical=True), run_batch(asked, doubles, allow_statistical=True), strict=True
    ):
        assert np.abs(one.speeds - other.speeds).max() < 1e-6


def test_who_covers_the_crossing_with_another_one_collides() -> None:
    (made, _), places = FigureEight(radius=(32, 32)).draw_from_seed((1,)), np.zeros(3)
    road = cast(ClosedRoad, made)
    (first, _), (second, _) = road.crossings
    places[:] = first + 6.0, second + 6.0, second + 60.0
    apart = np.full(3, 20.0)
    assert figure_eight_contacts(places, apart, road.loop_length).tolist() == [True, True, False]
    places[1] = second + 1.0  # its front is not there yet
    assert not figure_eight_contacts(places, apart, road.loop_length).any()
    touches = np.array([20.0, -0.1, 20.0])
    places[:] = first - 20.0, first - 9.0, first - 4.1
    assert figure_eight_contacts(places, touches, road.loop_length).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("scenario", "why"),
    [
        (replace(SHORT, human_control="native"), "human_control: native"),
        (replace(SHORT, right_of_way=False), "right_of_way"),
        (replace(SHORT, enforce_human_limits=False), "enforce_human_limits"),
        (replace(SHORT, radius=(20, 22), vehicles=5, free_length=30.0), "radius"),
        (replace(SHORT, actuation="raw"), "raw"),
        (replace(SHORT, actuation="flow"), "SUMO's own check"),
        (replace(SHORT, simulation_step=0.5), "simulation_step"),
    ],
)
def test_what_was_never_compared_is_refused(scenario: Any, why: str) -> None:
    assert why in statistically_unsupported_reason(scenario)
    with pytest.raises(InputError, match="batch: "):
        run_batch([EpisodeTask(scenario, Constant(), (1,))], allow_statistical=True)


def test_it_is_no_exact_road_and_driven_only_where_that_is_asked_for() -> None:
    assert unsupported_reason(SHORT)
    assert not statistically_unsupported_reason(SHORT)
    assert not statistically_unsupported_reason(Ring())
    with pytest.raises(InputError, match="is neither a ring nor a recorded road"):
        run_batch(tasks(SHORT, "pi", range(1)))


def test_a_training_on_it_may_be_batched() -> None:
    assert RunConfig(scenario="figure-eight", backend="batch").backend == "batch"
    with pytest.raises(InputError, match="backend"):
        RunConfig(scenario="merge", backend="batch")
