"""A batch of rings equals SUMO's episodes of the same seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from unjam.controller import make_driver
from unjam.drivers import Constant, Driver
from unjam.drivers.command import Command
from unjam.drivers.driver import Memory
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_from_name
from unjam.drivers.requirements import Requirements
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.errors import InputError
from unjam.measures.metrics import measure
from unjam.models.rollouts import to_device
from unjam.physics.arrays import Array
from unjam.scenarios import FigureEight, Ring
from unjam.scenarios.population import Population, write_population
from unjam.training.speed import make_benchmark_driver
from unjam.worlds.batch.noise import ArrayFactory, NoiseState
from unjam.worlds.batch.ring.world import RingBatch, WarmUpState
from unjam.worlds.batch.run import WARM_UP_CACHE, run_batch, run_batches, start_batch_drive, warm_up_states
from unjam.worlds.batch.support import unsupported_reason
from unjam.worlds.drive import finish_drive
from unjam.worlds.episode import run_episode
from unjam.worlds.record import Episode, Floats
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.worker_pool import EpisodeTask

NEEDS_A_CARD = pytest.mark.skipif(not torch.cuda.is_available(), reason="no graphics card")
SHORT = Ring(horizon=300)
NO_FILTER = SafetyFilter(active=False)
WRONG: dict[str, Any] = {
    "sensors": Sensors(gap_error=0.5, speed_error=0.4, dropout=0.2),
    "safety": SafetyFilter(gap_error=0.5, speed_error=0.5),
}
QUICK_HUMANS = replace(SHORT.humans, exponent=3.0, time_headway=1.4, desired_speed=12.0)


def tasks(
    ring: Ring, driver: Driver, seeds: Sequence[int], explore: bool = False, reward: str = ""
) -> list[EpisodeTask]:
    return [EpisodeTask(ring, driver, (seed,), reward, explore) for seed in seeds]


def assert_alike(found: Episode, actual: Episode) -> None:
    """Speeds and positions are the same to 1e-9; so is all that is measured, but for rounding."""
    assert found.speeds.shape == actual.speeds.shape
    assert np.abs(found.speeds - actual.speeds).max() < 1e-9
    assert np.abs(found.positions - actual.positions).max() < 1e-9
    assert found.vehicle_ids == actual.vehicle_ids
    row = {**measure(found), "warnings": measure(actual)["warnings"]}  # of which the batch has none
    for name, value in measure(actual).items():
        assert row[name] == (pytest.approx(value, 1e-7, 1e-9, True) if isinstance(value, float) else value)


RINGS: dict[str, tuple[Ring, str]] = {
    "human-only traffic": (SHORT, "human"),
    "human-only traffic after a warm-up": (replace(SHORT, warmup=130), "human"),
    "a CAV": (SHORT, "pi"),
    "a CAV after a warm-up": (replace(SHORT, warmup=750), "pi"),
    "a CAV that forgets the warm-up": (replace(SHORT, warmup=130, remember_warmup=False), "pi"),
    "four CAVs": (replace(SHORT, cavs=4), "pi"),
    "CAVs alone": (replace(SHORT, cavs=22), "pi"),
    "a short ring": (Ring(length=(60, 80), vehicles=8, cavs=2, horizon=300, warmup=100), "pi"),
    "a tiny ring": (Ring(length=(24, 28), vehicles=3, horizon=300), "pi"),
    "a long ring": (Ring(length=(500, 560), vehicles=50, cavs=5, horizon=300), "pi"),
    "a ring with few": (Ring(length=(300, 400), vehicles=2, horizon=300), "pi"),
    "a wide ring, where human drivers observe beyond the leader": (Ring(length=(800, 900), horizon=300), "pi"),
    "commands that are held": (replace(SHORT, steps_per_control_step=5, horizon=80, warmup=52), "pi"),
    "a coarser step": (replace(SHORT, simulation_step=0.3), "pi"),
    "the paper's PI": (SHORT, "pi:time_constant=0"),
    "late cars": (replace(SHORT, actuator=Actuator(delay=0.2, lag=0.3)), "pi"),
    "wrong sensors": (replace(SHORT, warmup=130, **WRONG), "idm"),
    "wrong sensors of three late CAVs": (
        replace(SHORT, cavs=3, steps_per_control_step=3, actuator=Actuator(delay=0.2, lag=0.3), **WRONG),
        "idm",
    ),
    "raw": (replace(SHORT, actuation="raw", safety=NO_FILTER), "pi"),
    "human drivers with much noise": (replace(SHORT, noise=10.0), "pi"),
    "human drivers that brake as hard as they can": (replace(SHORT, noise=20.0), "human"),
    "human drivers above their desired speed": (
        Ring(length=(400, 400), vehicles=12, horizon=300, humans=replace(SHORT.humans, desired_speed=3.0)),
        "human",
    ),
    "human drivers above their desired speed that brake gently": (
        Ring(
            length=(400, 400),
            vehicles=12,
            horizon=300,
            humans=replace(SHORT.humans, desired_speed=3.0, comfortable_deceleration=0.6),
        ),
        "human",
    ),
    "human drivers without noise": (replace(SHORT, noise=0.0), "pi"),
    "other human drivers": (replace(SHORT, humans=QUICK_HUMANS), "pi"),
}


@dataclass(frozen=True)
class ByShare(Driver):
    """Brakes by the penetration rate that it receives."""

    class_requirements: ClassVar[Requirements] = Requirements(used_fields=frozenset({"penetration_rate"}))

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        return -state.penetration_rate, memory


@pytest.mark.parametrize(("cavs", "warmup"), [(1, 0), (4, 130)])
def test_the_share_of_cavs_is_told_to_whom_asks_for_it_alone(cavs: int, warmup: int) -> None:
    ring = replace(SHORT, horizon=20, cavs=cavs, warmup=warmup)
    (found,) = run_batch(tasks(ring, ByShare(), [3]))
    actual = run_episode(ring, ByShare(), (3,))
    for episode in (found, actual):
        for trajectory in episode.trajectories:
            assert trajectory.states.penetration_rate == pytest.approx(cavs / 22)
            assert trajectory.applied_acceleration == pytest.approx(-cavs / 22)
    assert_alike(found, actual)
    assert run_episode(ring, driver_from_name("pi", 0.1), (3,)).trajectories[0].states.penetration_rate is None


@pytest.mark.parametrize("name", RINGS)
def test_a_ring_of_the_batch_is_sumos_of_the_same_seed(name: str, sumo: SumoBackend) -> None:
    ring, expert = RINGS[name]
    driver = driver_from_name(expert, ring.control_step)
    for found, seed in zip(run_batch(tasks(ring, driver, (1, 2))), (1, 2), strict=True):
        assert_alike(found, run_episode(ring, driver, seed, backend=sumo))


@pytest.mark.long
@pytest.mark.parametrize("name", ["human-only traffic after a warm-up", "a CAV after a warm-up", "wrong sensors"])
def test_a_ring_that_was_warmed_up_with_others_goes_on_to_the_same_bits(name: str) -> None:
    ring, expert = RINGS[name]
    now, coming = (tasks(ring, driver_from_name(expert, 0.1), seeds) for seeds in ((1, 2), (3, 4, 5)))
    WARM_UP_CACHE.clear()
    alone = run_batch(coming)
    WARM_UP_CACHE.clear()
    run_batches(now, upcoming=[*coming, *tasks(replace(ring, cavs=2), Constant(), [3])])
    assert [(scenario.cavs, seed) for scenario, seed, _ in WARM_UP_CACHE] == [
        (ring.cavs, (each,)) for each in range(1, 6)
    ]
    for found, expected in zip(run_batch(coming[::-1]), alone[::-1], strict=True):
        assert found.speeds.tobytes() == expected.speeds.tobytes()
        assert found.positions.tobytes() == expected.positions.tobytes()


def test_rings_are_warmed_up_once_and_the_newest_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    kept: Any = {}

    def warm_up(rings: Sequence[str]) -> dict[str, WarmUpState]:
        asked.append(list(rings))
        still, noise = np.zeros(3), NoiseState({}, np.zeros((0, 2)))
        return {ring: WarmUpState(still, still[1:], still[1:], False, noise, None) for ring in rings}

    for name, value in {"MAX_CACHED_CAVS": 4, "WARM_UP_CACHE": kept, "_simulate_warm_ups": warm_up}.items():
        monkeypatch.setattr(f"unjam.worlds.batch.run.{name}", value)
    states: Any = warm_up_states
    first, second, same = states(["a", "b", "a"], ["b", "c"])
    assert first is same is kept["a"]
    assert second is kept["b"]
    assert states(["c"], ["d"]) == [kept["c"]]
    assert asked == [["a", "b", "c"]], "where nothing is missing nothing is warmed up ahead"
    assert states(["a", "e", "f"], []) == [first, kept["e"], kept["f"]]
    assert asked[1:] == [["e", "f"]]
    assert list(kept) == ["b", "c", "e", "f"]


@pytest.mark.slow
def test_it_stays_so_for_five_minutes(sumo: SumoBackend) -> None:
    ring, driver = Ring(cavs=2), driver_from_name("pi", 0.1)
    for found, seed in zip(run_batch(tasks(ring, driver, (7, 8))), (7, 8), strict=True):
        assert found.control_steps == 3000
        assert_alike(found, run_episode(ring, driver, seed, backend=sumo))


@pytest.mark.parametrize("hold", [1, 10])
@pytest.mark.parametrize("wrong", [{}, WRONG], ids=["exact sensors", "wrong sensors"])
def test_a_network_sees_explores_and_is_recorded_as_in_sumo(
    hold: int, wrong: dict[str, Any], sumo: SumoBackend
) -> None:
    ring, driver = Ring(cavs=2, warmup=120, horizon=100, **wrong), make_benchmark_driver(0.1, 0.1 * hold)
    for found, seed in zip(run_batch(tasks(ring, driver, (1, 2), True)), (1, 2), strict=True):
        actual = run_episode(ring, driver, seed, explore=True, backend=sumo)
        assert_alike(found, actual)
        for one, other in zip(found.trajectories, actual.trajectories, strict=True):
            for name in (
                "observations",
                "expert_acceleration",
                "residual",
                "applied_acceleration",
                "filter_braking",
                "reward",
            ):
                assert getattr(one, name) == pytest.approx(getattr(other, name), abs=1e-9), name
            for name, values in other.initial_memory.items():
                assert one.initial_memory[name] == pytest.approx(values, abs=1e-9, nan_ok=True), name


def test_who_collides_ends_there_and_others_go_on(sumo: SumoBackend) -> None:
    ring = Ring(length=(230, 260), horizon=200, actuation="raw", safety=NO_FILTER)
    found = run_batch(tasks(ring, Constant(0.6), (1, 2, 3)))
    for episode, seed in zip(found, (1, 2, 3), strict=True):
        assert_alike(episode, run_episode(ring, Constant(0.6), seed, backend=sumo))
    assert {episode.status for episode in found} == {"collision"}
    assert len({episode.control_steps for episode in found}) > 1


class Hasty(Driver):
    """Brakes harder than its brakes can, now and then."""

    def act(self, state: LocalState, memory: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return np.where(np.asarray(state.speed) > 2.0, -8.0, 0.8), memory


def test_brakes_do_what_they_can(sumo: SumoBackend) -> None:
    ring = replace(SHORT, action_limit=8.0, actuator=INSTANT_ACTUATOR)
    (found,) = run_batch(tasks(ring, Hasty(), (1,)))
    assert_alike(found, run_episode(ring, Hasty(), 1, backend=sumo))
    assert found.audit.cav_braking.max_braking == pytest.approx(6.0)


def test_each_of_a_population_drives_in_its_own_way(tmp_path: Path, sumo: SumoBackend) -> None:
    one = SHORT.humans
    slow = replace(one, time_headway=1.5, desired_speed=4.0, comfortable_deceleration=2.2)
    quick = replace(one, max_acceleration=1.8, minimum_gap=1.5, exponent=2.0)
    write_population(tmp_path / "people.json", Population(one, (one, slow, quick), (-9.0, 3.0)))
    ring = replace(SHORT, population=str(tmp_path / "people.json"), warmup=130)
    driver = driver_from_name("pi", 0.1)
    for found, seed in zip(run_batch(tasks(ring, driver, (1, 2))), (1, 2), strict=True):
        assert_alike(found, run_episode(ring, driver, seed, backend=sumo))


def test_people_collide_where_sumo_says_so(sumo: SumoBackend) -> None:
    ring, driver = Ring(noise=40.0, horizon=90), driver_from_name("human", 0.1)
    found = run_batch(tasks(ring, driver, (1, 2, 3)))
    for episode, seed in zip(found, (1, 2, 3), strict=True):
        assert_alike(episode, run_episode(ring, driver, seed, backend=sumo))
    assert {episode.status for episode in found} == {"collision"}


def doubles(values: Floats) -> Tensor:
    return torch.as_tensor(values)


@pytest.mark.parametrize("wrong", [{}, WRONG], ids=["exact sensors", "wrong sensors"])
def test_tensors_do_what_arrays_do(wrong: dict[str, Any]) -> None:
    asked = tasks(Ring(horizon=200, cavs=2, warmup=100, **wrong), make_benchmark_driver(0.1), range(3))
    for one, other in zip(run_batch(asked), run_batch(asked, doubles), strict=True):
        assert_alike(one, other)


def singles(device: str) -> ArrayFactory:
    return partial(to_device, device=device)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NEEDS_A_CARD)])
def test_single_precision_is_near(device: str) -> None:
    asked = tasks(Ring(horizon=300), make_benchmark_driver(0.1), range(3))
    for one, other in zip(run_batch(asked), run_batch(asked, singles(device)), strict=True):
        assert np.abs(one.speeds - other.speeds).max() < 1e-3
        assert other.reward.sum() == pytest.approx(one.reward.sum(), rel=1e-4)


def test_sensors_read_once_in_a_decision() -> None:
    world, exact = (RingBatch([replace(SHORT, **each)] * 2, [(1,), (2,)]) for each in (WRONG, {}))
    first = world.local_state()
    assert world.local_state() is first
    off = np.abs(first.leader_gap - exact.local_state().leader_gap)
    assert 0.0 < off.min() <= off.max() <= 0.5
    world.start(True)
    world.advance(Command(np.zeros(2)))
    assert world.local_state() is not first


def test_quick_noise_is_of_the_same_size_and_cavs_have_none() -> None:
    generator = torch.Generator().manual_seed(0)

    def draw(shape: tuple[int, ...]) -> Tensor:
        return torch.randn(shape, generator=generator)

    ring = Ring(horizon=30, noise=2.0, humans=replace(Ring().humans, time_headway=0.5))
    world = RingBatch([replace(ring, warmup=60)] * 50, [(seed,) for seed in range(50)], singles("cpu"), draw=draw)
    episodes = finish_drive(start_batch_drive(world, Constant(0.2), singles("cpu")))
    noise = [
        episode.speeds[1:] - np.diff(episode.positions, axis=0) / episode.control_step
        for episode in episodes
        if episode.speeds.min() > 0.5
    ]
    cav = episodes[0].vehicle_ids.index("cav_0")
    added = np.array(noise)
    assert np.abs(added[:, :, cav]).max() < 1e-3
    human_changes = np.delete(added, cav, axis=2)
    assert human_changes.std() == pytest.approx(ring.noise_per_step * ring.simulation_step, rel=0.05)


@pytest.mark.parametrize(
    ("scenario", "why"),
    [
        (FigureEight(), "is neither a ring nor a recorded road"),
        (replace(SHORT, human_control="commanded"), "human_control: commanded"),
        (replace(SHORT, safety=NO_FILTER), "SUMO's own check"),
        (replace(SHORT, actuation="flow"), "SUMO's own check"),
        (replace(SHORT, simulation_step=0.5), "simulation_step: 0.5"),
    ],
)
def test_what_would_not_be_exact_is_refused(scenario: Any, why: str) -> None:
    assert why in unsupported_reason(scenario)
    with pytest.raises(InputError, match="batch: "):
        run_batch(tasks(scenario, driver_from_name("pi", scenario.control_step), (1,)))


def test_rings_differ_in_their_lengths_alone() -> None:
    driver = driver_from_name("pi", 0.1)
    two = [EpisodeTask(each, driver, (1,)) for each in (SHORT, replace(SHORT, cavs=2))]
    with pytest.raises(InputError, match="differ in more than their lengths"):
        run_batch(two)
    parts = [EpisodeTask(SHORT.stratum(part, 2), driver, (1,)) for part in range(2)]
    assert len({episode.loop_length for episode in run_batch(parts)}) == 2
    other = [*tasks(SHORT, driver, (1,)), *tasks(SHORT, driver_from_name("idm", 0.1), (2,))]
    together, alone = run_batch(other), [run_batch([each])[0] for each in other]
    assert all(np.array_equal(one.speeds, two.speeds) for one, two in zip(together, alone, strict=True))
    with pytest.raises(InputError, match="differ in driver"):
        run_batch([other[0], replace(other[1], reward="eq16")])


@pytest.mark.long
def test_who_of_a_mixture_drives_does_not_depend_on_the_other_rings() -> None:
    two = replace(SHORT, cavs=2)
    for ring in (SHORT, two):
        every = tasks(ring, make_driver("pi+idm", 0.1), (1, 2, 3))
        together, alone = run_batch(every), [run_batch([each])[0] for each in every]
        assert all(np.array_equal(one.speeds, other.speeds) for one, other in zip(together, alone, strict=True))


def test_what_a_driver_sees_is_not_the_worlds_own() -> None:
    world = RingBatch([SHORT], [(1,)])
    with pytest.raises(ValueError, match="read-only"):
        world.local_state().speed[0] = 1.0


def test_rings_on_which_somebody_touched_within_a_decision_have_collided() -> None:
    raw = replace(SHORT, actuation="raw", safety=NO_FILTER, steps_per_control_step=10, action_limit=3.0, horizon=40)
    every = tasks(raw, Constant(3.0), range(24))
    scenarios, seeds = [each.scenario for each in every], [each.seed for each in every]
    world = RingBatch(scenarios, seeds)  # pyright: ignore[reportArgumentType]
    crashed = [each for each in finish_drive(start_batch_drive(world, Constant(3.0))) if each.status == "collision"]
    assert crashed
    assert all(episode.collisions >= 2 for episode in crashed)


@pytest.mark.long
def test_rings_of_many_kinds_come_back_in_their_order() -> None:
    pi, idm = (driver_from_name(name, 0.1) for name in ("pi", "idm"))
    asked = [
        EpisodeTask(SHORT.stratum(1, 2), pi, (1,)),
        EpisodeTask(replace(SHORT, cavs=2), pi, (2,)),
        EpisodeTask(SHORT.stratum(0, 2), pi, (3,)),
        EpisodeTask(SHORT.stratum(0, 2), idm, (4,)),
        EpisodeTask(replace(SHORT, vehicles=40, length=(400, 480)), pi, (5,)),  # they do not fit on the other roads
    ]
    found = run_batches(asked)
    assert [episode.seed for episode in found] == [(1,), (2,), (3,), (4,), (5,)]
    for episode, task in zip(found, asked, strict=True):
        (alone,) = run_batch([task])
        assert np.array_equal(episode.speeds, alone.speeds)


class Broken(Driver):
    """Answers something that is not finite in its third step."""

    def initial_memory(self, n: int) -> dict[str, Any]:
        return {"step": np.zeros(n)}

    def act(self, state: LocalState, memory: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        step = memory["step"]
        return np.where(step == 2, np.nan, 0.0) + 0.0 * state.speed, {"step": step + 1}


def test_an_answer_that_is_not_finite_is_refused_with_its_step() -> None:
    with pytest.raises(InputError, match="step 2"):
        run_batch(tasks(SHORT, Broken(), (1, 2)))
