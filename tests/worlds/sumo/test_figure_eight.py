"""The figure eight in SUMO."""

from dataclasses import replace
from typing import Any

import libsumo
import numpy as np
import pytest

from unjam.drivers import Driver, LocalState, Memory, PISaturation
from unjam.drivers.car_following import Human
from unjam.drivers.command import Command
from unjam.drivers.road_experts import Pacer
from unjam.drivers.safety import INSTANT_ACTUATOR, SafetyFilter
from unjam.measures.metrics import measure
from unjam.scenarios.figure_eight import FigureEight
from unjam.scenarios.scenario import MIN_CAV_GAP
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.ordered_road import OrderedTraffic
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

SEEDS = 5
FLOW_SPEEDS = {
    # (driver, radius): mean speed of all vehicles in the first 1,500 steps, measured with Flow on SUMO 1.28
    ("human", 32): 6.02,
    ("human", 35): 6.34,
    ("pi", 32): 6.33,
    ("pi", 35): 6.39,
}
AS_FLOW = FigureEight(actuation="flow", enforce_human_limits=False, safety=SafetyFilter(active=False))
DRIVERS = {"human": Human(), "pi": PISaturation(time_constant=0.0)}


@pytest.mark.slow
def test_agrees_with_flow_within_six_percent_without_collision() -> None:
    tasks = [
        EpisodeTask(replace(AS_FLOW, radius=(radius, radius)), DRIVERS[driver], (seed,))
        for driver, radius in FLOW_SPEEDS
        for seed in range(SEEDS)
    ]
    with WorkerPool(2) as workers:
        episodes = workers.run(tasks)
    assert all(episode.status == "completed" for episode in episodes)
    speeds = np.array([measure(episode)["mean_speed"] for episode in episodes]).reshape(-1, SEEDS).mean(1)
    np.testing.assert_allclose(speeds, list(FLOW_SPEEDS.values()), rtol=0.06)


def test_leader_and_gap_are_those_of_sumo(simulation: Simulation) -> None:
    traffic = make_traffic(FigureEight(cavs=14), (3,), simulation)
    assert isinstance(traffic, OrderedTraffic)
    traffic.start(is_controlled=True)
    ids, compared = traffic.road.vehicle_ids, 0
    for _ in range(400):
        traffic.advance(Command(np.full(14, 0.2)))
        state = traffic.local_state()
        for row, name in enumerate(ids):
            found = libsumo.vehicle.getLeader(name, 200.0)
            if found:
                leader, gap = found
                assert leader == ids[(row + 1) % 14]
                assert state.leader_gap[row] == pytest.approx(gap + MIN_CAV_GAP, abs=1e-3)
                compared += 1
    assert compared > 1000


@pytest.mark.parametrize("cavs", [2, 7, 14])
def test_several_cavs_are_driven_and_recorded_separately(cavs: int, sumo: SumoBackend) -> None:
    road = replace(AS_FLOW, cavs=cavs, horizon=300, actuator=INSTANT_ACTUATOR)
    episode = run_episode(road, AccelerationByRow(), (1,), backend=sumo)
    assert (episode.status, len(episode.trajectories)) == ("completed", cavs)
    assert tuple(trajectory.vehicle for trajectory in episode.trajectories) == episode.cav_ids
    for row, trajectory in enumerate(episode.trajectories):
        position = episode.vehicle_ids.index(trajectory.vehicle)
        states = trajectory.states
        np.testing.assert_array_equal(states.speed, episode.speeds[:, position])
        np.testing.assert_array_equal(states.leader_speed, episode.speeds[:, (position + 1) % 14])
        np.testing.assert_array_equal(states.follower_gap, episode.gaps[:, (position - 1) % 14])
        np.testing.assert_allclose(
            trajectory.applied_acceleration, 0.1 + 0.02 * row + 0.001 * np.arange(300), atol=1e-12
        )
        commanded_speed = np.maximum(states.speed[:-1] + 0.1 * trajectory.applied_acceleration, 0.0)
        np.testing.assert_allclose(states.speed[1:], commanded_speed - 0.1 * trajectory.shield_braking, atol=1e-9)


class AccelerationByRow(Driver):
    """A driver with an acceleration that increases with the row of the CAV and with time."""

    def initial_memory(self, n: int) -> Memory:
        return {"decisions": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        acceleration = 0.1 + 0.02 * np.arange(len(state.speed)) + 0.001 * memory["decisions"]
        return acceleration, {"decisions": memory["decisions"] + 1.0}


def test_vehicles_from_the_right_yield(sumo: SumoBackend) -> None:
    """Vehicles stand before the crossing on the yielding approach, and never on the other one."""
    episode = run_episode(FigureEight(radius=(32, 32)), Human(), (0,), backend=sumo)
    road = FigureEight(radius=(32, 32)).draw(np.random.default_rng(0))
    position = episode.positions % road.loop_length
    standing = episode.speeds < 0.1
    for (start, _), expected in zip(road.crossings, (False, True), strict=True):
        is_at_stop_line = (position > start - 3) & (position <= start)
        assert bool((standing & is_at_stop_line)[50:].any()) is expected


def test_sumo_drives_human_driven_vehicles_on_the_crossing(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    traffic = make_traffic(FigureEight(radius=(32, 32)), (0,), simulation)
    assert isinstance(traffic, OrderedTraffic)
    commands: list[tuple[str, float]] = []
    monkeypatch.setattr(
        simulation, "command_speeds", lambda ids, speeds: commands.extend(zip(ids, speeds, strict=True))
    )
    traffic.start(is_controlled=False)
    for _ in range(200):
        commands.clear()
        position = np.array(list(traffic._tracked_positions.values())) % traffic.road.loop_length
        traffic.advance(None)
        for row, (_, speed) in enumerate(commands):
            is_on_crossing = any(start <= position[row] < end for start, end in traffic.road.crossings)
            assert (speed == -1.0) == is_on_crossing
            assert is_on_crossing or speed >= 0.0


def slow_case(*values: object) -> Any:
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("driver", "radius", "speed"),
    [
        slow_case(Pacer(), 32, 5.8),
        slow_case(Pacer(), 35, 6.2),
        slow_case(Pacer(use_tuned=True), 32, 6.8),
        slow_case(Pacer(use_tuned=True), 33, 6.8),
        slow_case(Pacer(use_tuned=True), 34, 6.9),
        (Pacer(use_tuned=True), 35, 7.2),
    ],
)
def test_pacers_keep_a_queue_that_avoids_itself_at_the_crossing(driver: Pacer, radius: int, speed: float) -> None:
    road = FigureEight(radius=(radius, radius), horizon=3000)
    with WorkerPool(2) as workers:
        episodes = workers.run([EpisodeTask(road, driver, (seed,)) for seed in range(3)])
    assert all(episode.status == "completed" for episode in episodes)
    assert min(measure(episode)["mean_speed_steady"] for episode in episodes) > speed
