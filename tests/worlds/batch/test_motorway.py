"""Do motorways of a batch do what SUMO's do: step by step where nothing is drawn, and in the mean?"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.conftest import random_network
from unjam.drivers import ResidualDriver
from unjam.drivers.command import Command
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError
from unjam.measures.metrics import mean_travel_time
from unjam.physics.arrays import Floats
from unjam.physics.idm import IDMArrays
from unjam.scenarios.motorway import MOTORWAY_SCENARIOS, ON_RAMP, Motorway
from unjam.scenarios.motorway_road import MotorwayGeometry
from unjam.scenarios.road import Edge, Node, RoadNetwork
from unjam.worlds.batch.motorway import eidm
from unjam.worlds.batch.motorway.eidm import (
    DriverErrors,
    LeaderMotion,
    eidm_effective_gap,
    eidm_follow_speed,
    eidm_speed_bounds,
    finalize_eidm_speed,
)
from unjam.worlds.batch.motorway.lane_changes import change_lanes
from unjam.worlds.batch.motorway.traffic import BatchMotorways
from unjam.worlds.batch.motorway.vehicles import NO_ADVICE, MotorwayDrivers, MotorwayVehicles, sort_vehicles
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.batch.run import run_batch, run_batched_if_supported
from unjam.worlds.batch.support import statistically_unsupported_reason, unsupported_reason
from unjam.worlds.episode import run_episode
from unjam.worlds.lane_neighbors import find_neighbors, find_road_neighbors, neighbors_on_lane
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.inputs import SumoInputs
from unjam.worlds.sumo.networks import network_file, xml_document
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask

STEP, LIMIT, LENGTH = 0.5, 27.78, 4.8
SHORT = replace(ON_RAMP, horizon=320, peak=(60.0, 300.0))
TWO_RAMPS = replace(MOTORWAY_SCENARIOS["two-ramps"], horizon=320, peak=(60.0, 300.0))


def rows_of(drawn: Floats) -> IDMArrays:
    time_headway, most, braking, gap, factor = drawn.T
    return IDMArrays(LIMIT * factor, time_headway, most, braking, 4.0, gap)


def people(count: int, generator: np.random.Generator) -> Floats:
    """People who differ: time headway, acceleration, braking, gap, and wanted speed over the limit."""
    low, high = [1.0, 1.0, 1.5, 2.0, 0.8], [1.8, 1.5, 2.0, 2.5, 1.2]
    return generator.uniform(low, high, (count, 5)).round(4)


def load(simulation: Simulation, drawn: Floats, times: Floats, lanes: int) -> list[str]:
    """People who err in nothing enter a straight road one after the other, on its lanes in turn."""
    names = [f"car_{number}" for number in range(len(drawn))]
    exact = {"sigmaleader": 0.0, "sigmagap": 0.0, "sigmaerror": 0.0, "speedDev": 0.0, "length": LENGTH}
    types = [
        {"id": name, "carFollowModel": "EIDM", "emergencyDecel": 9.0, **exact}
        | dict(zip(("tau", "accel", "decel", "minGap", "speedFactor"), map(str, row), strict=True))
        for name, row in zip(names, drawn, strict=True)
    ]
    nodes = Node("here", 0.0, 0.0), Node("there", 4000.0, 0.0)
    network = RoadNetwork(nodes, (Edge("road", "here", "there", 4000.0, lanes=lanes),), LIMIT, has_internal_links=False)
    routes = "<route id='all' edges='road'/>" + "".join(
        f"<vehicle id='{name}' type='{name}' route='all' depart='{time:.1f}' departSpeed='last' "
        f"departLane='{number % lanes}' departPos='base' insertionChecks='collision'/>"
        for number, (name, time) in enumerate(zip(names, times, strict=True))
    )
    xml = xml_document("routes", "vType", types).replace("</routes>", routes + "</routes>")
    files = SumoInputs((), {"--net-file": (network_file(network),)}, xml, "--route-files")
    simulation.load(files, STEP, 1)
    return names


def platoon(simulation: Simulation) -> tuple[IDMArrays, Floats, Floats]:
    """People on one lane behind one who stops and goes: who they are, places and speeds by step."""
    drawn = people(8, np.random.default_rng(3))
    drawn[0, 4] = 0.6
    names = load(simulation, drawn, np.linspace(0.0, 21.0, 8), 1)
    places, speeds = [], []
    for step in range(330):
        if step in (140, 180, 220):
            simulation.set_max_speed(names[0], {140: 3.0, 180: 0.01, 220: 40.0}[step])
        simulation.step()
        if step > 60:
            places.append(simulation.lane_offsets(names))
            speeds.append(simulation.speeds(names))
    return rows_of(drawn), np.array(places), np.array(speeds)


def test_extended_drivers_who_err_in_nothing_are_sumos(simulation: Simulation) -> None:
    people, places, speeds = platoon(simulation)
    count = places.shape[1] - 1
    own = IDMArrays(*(each if np.ndim(each) == 0 else each[1:] for each in people))
    started, worst = np.full(count, -1000.0), []
    exact = DriverErrors(*np.zeros((3, count)))
    for step in range(2, len(speeds)):
        before, now = speeds[step - 1], (step + 61.0) * STEP
        speed, leader = before[1:], before[:-1]
        acceleration = (before - speeds[step - 2]) / STEP
        gap = places[step - 1, :-1] - LENGTH - places[step - 1, 1:]
        cool = (started + eidm.START_UP_DURATION < now - STEP) & (speed > eidm.EIDM_HALTING_SPEED)
        wanted = eidm_follow_speed(speed, gap, leader, own, exact, STEP, LeaderMotion(acceleration[:-1], cool))
        freely = eidm_follow_speed(speed, 500.0 + own.minimum_gap, own.desired_speed, own, exact, STEP)
        heeded = np.where(
            freely.uncooled_acceleration < wanted.uncooled_acceleration + 1e-3,
            np.minimum(freely.speed, wanted.speed),
            wanted.speed,
        )
        safe = np.minimum(heeded, speed + own.max_acceleration * STEP)
        _, wish, highest = eidm_speed_bounds(speed, safe, eidm_effective_gap(gap, own), leader, own, exact, STEP)
        about = wish, highest, started, own.max_acceleration, now, STEP
        found, started = finalize_eidm_speed(speed, acceleration[1:], *about)
        worst.append(np.abs(found - speeds[step, 1:]).max())
    assert min(speeds[:, 3]) < 0.05
    assert max(speeds[:, 3]) > 10.0
    assert np.quantile(worst, 0.98) < 1e-3
    assert max(worst) < 0.03  # behind one who stands but for a millimetre


def test_gaps_and_speeds_of_both_kinds_of_drivers_are_sumos(simulation: Simulation) -> None:
    people, _, _ = platoon(simulation)
    sumo = simulation._sumo.vehicle  # no other test asks what SUMO's own formulas say
    states = np.array([[20.0, 20.0, 30.0], [20.0, 15.0, 18.0], [25.0, 5.0, 60.0], [5.0, 8.0, 4.0]])
    for row in (2, 5):
        name = f"car_{row}"
        one = IDMArrays(*(each if np.ndim(each) == 0 else np.full(len(states), each[row]) for each in people))
        drivers = MotorwayDrivers(one, DriverErrors(*np.zeros((3, len(states)))), np.ones(len(states), bool))
        speed, leader, gap = states.T
        expected = [sumo.getSecureGap(name, *state[:2], 2.0, "car_1") for state in states]
        assert drivers.secure_gap(speed, leader).clip(0.0) == pytest.approx(expected, abs=1e-6)
        expected = [sumo.getFollowSpeed(name, own, gap, its, 2.0, "car_1") for own, its, gap in states]
        assert drivers.follow_speed(speed, gap + one.minimum_gap, leader, STEP) == pytest.approx(expected, abs=1e-6)
        expected = [sumo.getStopSpeed(name, own, way) for own, _, way in states]
        assert drivers.stop_speed(speed, gap, STEP) == pytest.approx(expected, abs=1e-6)


def test_who_changes_lanes_is_who_does_in_sumo(simulation: Simulation) -> None:
    generator = np.random.default_rng(1)
    drawn = people(160, generator)
    names = load(simulation, drawn, np.cumsum(generator.uniform(0.6, 1.6, 160)), 2)
    time_headway, most, braking, gap, factor = drawn.T
    road = MotorwayGeometry(4000.0, LIMIT, 2, LENGTH)
    nothing, free = np.zeros(160), np.full(160, NO_ADVICE)
    wishes = dict.fromkeys(("speed_gain", "keep_right", "look_ahead_speed"), nothing)
    before = {"speed": nothing, "way": nothing - 1.0}
    changes, alike, others, moments = 0, 0, 0, 0
    for _ in range(320):
        simulation.step()
        known = [number for number in range(160) if before["way"][number] >= 0]
        there = (set(simulation.vehicles_on_lane("road_0")), set(simulation.vehicles_on_lane("road_1")))
        way = np.array([next((lane + 1 for lane in (0, 1) if name in there[lane]), -1) for name in names])
        on_road = [number for number in range(160) if way[number] >= 0]
        speed, place = np.zeros((2, 160))
        speed[on_road] = simulation.speeds([names[number] for number in on_road])
        place[on_road] = simulation.lane_offsets([names[number] for number in on_road])
        columns = (
            dict.fromkeys(MotorwayVehicles._fields, nothing)
            | wishes
            | {
                **{"road": np.zeros(160, int), "entry": np.arange(160), "lane": before["way"].astype(int)},
                **{"position": place, "speed": speed, "acceleration": (speed - before["speed"]) / STEP},
                **{
                    "time_headway": time_headway,
                    "max_acceleration": most,
                    "braking": braking,
                    "minimum_gap": gap,
                    "speed_factor": factor,
                },
                **{"is_eidm": np.ones(160, bool), "speed_cap": free, "desired_speed": LIMIT * factor},
            }
        )
        if known:
            vehicles = sort_vehicles(MotorwayVehicles(**columns).select(np.array(known)))
            after = change_lanes(vehicles, road, STEP)
            mine, sumos = after.lane != vehicles.lane, way[after.entry] != vehicles.lane
            counted = (vehicles.position > 20.0) & (way[after.entry] > 0)
            changes += int((sumos & counted).sum())
            alike += int((mine & sumos & counted).sum())
            others += int((mine & ~sumos & counted).sum())
            moments += int(counted.sum())
            wishes = {name: values.copy() for name, values in wishes.items()}
            for name, values in wishes.items():
                values[after.entry] = np.where(sumos, 0.0, getattr(after, name))
        before = {"speed": speed, "way": way.astype(float)}
    assert moments > 10_000
    assert changes > 20
    assert alike > 0.8 * changes
    assert others < 0.15 * changes


def seeds_of(count: int) -> list[tuple[int, ...]]:
    return [(11, number) for number in range(count)]


def tasks_of(road: Motorway, driver: Driver, count: int) -> list[EpisodeTask]:
    return [EpisodeTask(road, driver, seed) for seed in seeds_of(count)]


def driver_of(name: str) -> Driver:
    return driver_from_name(name, SHORT.control_step)


def batch_of(road: Motorway, name: str, count: int) -> list[Episode]:
    return run_batch(tasks_of(road, driver_of(name), count), allow_statistical=True)


@pytest.fixture(scope="module")
def driven() -> dict[str, list[Episode]]:
    return {name: batch_of(SHORT, name, 4) for name in ("human", "jam-ahead")}


def about(episode: Episode) -> list[float]:
    """Mean travel time, speed, share on the right lane, and lane changes for a vehicle."""
    there = ~np.isnan(episode.lane_indices)
    both = there[1:] & there[:-1] & (np.diff(episode.speeds, axis=0) > -20.0)
    changes = (np.diff(episode.lane_indices, axis=0) != 0.0) & both
    return [
        mean_travel_time(episode),
        float(np.nanmean(episode.speeds)),
        float((episode.lane_indices[there] == 1.0).mean()),
        changes.sum() / len(episode.vehicle_ids),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("road", [SHORT, TWO_RAMPS, replace(SHORT, ramps=())], ids=["one", "two", "none"])
@pytest.mark.parametrize("name", [pytest.param("human", marks=pytest.mark.slow), "cruise"])
def test_episodes_are_sumos_in_the_mean(name: str, road: Motorway, sumo: SumoBackend) -> None:
    ours = np.array([about(episode) for episode in batch_of(road, name, 4)])
    theirs = np.array(
        [about(run_episode(road, driver_of(name), seed, record_details=True, backend=sumo)) for seed in seeds_of(4)]
    )
    assert ours.mean(0) == pytest.approx(theirs.mean(0), rel=0.08)


@pytest.mark.slow
def test_vehicles_slow_down_at_both_ramps_as_in_sumo(sumo: SumoBackend) -> None:
    driver = driver_of("jam-ahead")
    ours = batch_of(TWO_RAMPS, "jam-ahead", 4)
    theirs = [run_episode(TWO_RAMPS, driver, seed, backend=sumo) for seed in seeds_of(4)]
    for begin, end in ((-500, 0), (0, 300), (1000, 1500), (1500, 1800), (1800, 2500)):
        means = [
            np.mean([each.speeds[(each.positions > begin) & (each.positions < end)].mean() for each in episodes])
            for episodes in (ours, theirs)
        ]
        assert means[0] == pytest.approx(means[1], rel=0.08)
    for episode in ours:
        assert episode.status == "completed"
        assert np.nanmin(episode.gaps) > 0.0
        assert set(episode.branches) == {"motorway", "ramp", "ramp2"}


def test_vehicles_of_different_ramps_are_no_neighbors_on_the_lane_of_ramps() -> None:
    geometry = TWO_RAMPS.geometry
    lane, position = np.array([0, 0, 0, 1]), np.array([3300.0, 3200.0, 2200.0, 2100.0])
    neighbors = find_road_neighbors(np.zeros(4, int), lane, position, geometry)
    np.testing.assert_array_equal(neighbors_on_lane(neighbors.leaders, lane), [-1, 0, -1, -1])
    np.testing.assert_array_equal(neighbors_on_lane(neighbors.followers, lane), [1, -1, -1, -1])
    assert neighbors.leaders[0, 3] == 2  # adjacent on the right


@pytest.mark.slow
def test_a_road_is_the_same_alone_and_among_others(driven: dict[str, list[Episode]]) -> None:
    (alone,) = run_batch([EpisodeTask(SHORT, driver_of("jam-ahead"), seeds_of(4)[2])], allow_statistical=True)
    among = driven["jam-ahead"][2]
    np.testing.assert_array_equal(alone.speeds, among.speeds)
    assert alone.vehicle_ids == among.vehicle_ids
    assert alone.audit == among.audit


@pytest.mark.slow
def test_nobody_touches_anybody_or_is_lost(driven: dict[str, list[Episode]]) -> None:
    for episode in driven["human"] + driven["jam-ahead"]:
        assert episode.status == "completed"
        assert np.nanmin(episode.gaps) > 0.0
        there = ~np.isnan(episode.speeds)
        assert there[-1].sum() + episode.arrivals == len(episode.vehicle_ids)
        assert np.nanmin(episode.speeds) >= 0.0
        assert episode.audit.human_braking.max_braking <= 9.0 + 1e-9


@pytest.mark.slow
def test_each_road_has_its_own_driver_and_exploration() -> None:
    road = replace(SHORT, horizon=150, penetration_rate=0.3)
    drivers = [driver_of("jam-ahead"), driver_of("cruise"), driver_of("gap-maker")]
    tasks = [EpisodeTask(road, driver, seeds_of(2)[-1]) for driver in drivers]
    for task, together in zip(tasks, run_batch(tasks, allow_statistical=True), strict=True):
        (alone,) = run_batch([task], allow_statistical=True)
        np.testing.assert_array_equal(together.speeds, alone.speeds)
    noises = [replace(random_network(3), episode_noise=lasts) for lasts in (False, True)]
    for network in noises:
        driver = ResidualDriver(
            driver_of("jam-ahead"), network, 2.5, ("distance_to_merge", "allowed_speed", "penetration_rate")
        )
        tasks = [EpisodeTask(road, driver, seeds_of(1)[0], explore=explore) for explore in (1.0, -1.0)]
        one, other = run_batch(tasks, allow_statistical=True)
        first, second = (each.trajectories[0] for each in (one, other))
        calm = network(first.observations[:1])
        assert first.residual[0] != second.residual[0]
        assert first.residual[0] + second.residual[0] == pytest.approx(2.0 * calm[0], abs=1e-12)


def test_noise_that_lasts_is_that_of_the_road() -> None:
    world = MotorwayBatch(replace(SHORT, penetration_rate=0.5), seeds_of(2))
    world.start(True)
    seen = set[tuple[float, ...]]()
    for _ in range(40):
        world.advance(Command(np.zeros(world.cav_count)))
        assert world.noise(3).shape == (world.cav_count, 3)
        seen |= set(map(tuple, world.noise(3).tolist()))
    assert len(seen) == 2


def test_what_a_cav_perceived_is_what_was_there(driven: dict[str, list[Episode]]) -> None:
    episode = driven["jam-ahead"][0]
    column = dict(zip(episode.vehicle_ids, episode.vehicle_columns, strict=True))
    assert len(episode.trajectories) > 5
    for trajectory in episode.trajectories:
        moments = slice(trajectory.start_step, trajectory.start_step + len(trajectory.states.speed))
        np.testing.assert_allclose(trajectory.states.speed, episode.speeds[moments, column[trajectory.vehicle]])
        np.testing.assert_allclose(
            trajectory.states.route_position, episode.positions[moments, column[trajectory.vehicle]]
        )
        gaps = episode.gaps[moments, column[trajectory.vehicle]]
        near = gaps < 100.0
        np.testing.assert_allclose(trajectory.states.leader_gap[near], gaps[near])
        change = np.diff(trajectory.states.speed) / episode.control_step
        np.testing.assert_allclose(trajectory.applied_acceleration, change, atol=1e-12)
        assert not trajectory.terminated
        assert np.isfinite(trajectory.reward).all()


@pytest.mark.slow
def test_cavs_that_hold_back_are_slower_upstream_than_those_that_never_do() -> None:
    crowded = replace(SHORT, penetration_rate=0.5, horizon=200)

    def upstream(name: str) -> float:
        states = [trajectory.states for episode in batch_of(crowded, name, 3) for trajectory in episode.trajectories]
        return float(np.mean(np.concatenate([state.speed[state.distance_to_merge > 0.0] for state in states])))

    assert upstream("constant:acceleration=-1") < 0.8 * upstream("cruise")


def test_neighbours_are_those_next_on_each_way_of_the_same_road() -> None:
    generator = np.random.default_rng(5)
    count = 60
    road, way = np.sort(generator.integers(0, 3, count)), generator.integers(0, 3, count)
    place = generator.uniform(0.0, 3000.0, count)
    order = np.lexsort((-place, road))
    columns = dict.fromkeys(MotorwayVehicles._fields, np.zeros(count)) | {"road": road, "lane": way, "position": place}
    vehicles = MotorwayVehicles(**columns).select(order)
    near = find_neighbors(vehicles.road, vehicles.lane, 3)
    for row in range(count):
        for side in range(3):
            there = np.flatnonzero((vehicles.road == vehicles.road[row]) & (vehicles.lane == side))
            ahead = there[there < row].max(initial=-1)
            behind = there[there > row].min(initial=count)
            assert near.leaders[side, row] == ahead
            assert near.followers[side, row] == (behind if behind < count else -1)
    beyond = neighbors_on_lane(near.leaders, vehicles.lane + 5)
    assert (beyond == -1).all()


def test_nobody_enters_before_the_time_or_without_room() -> None:
    road = SHORT.draw(np.random.default_rng(1))
    traffic = BatchMotorways([road], STEP, np.zeros)
    times = [entry.time for entry in road.entries]
    for _ in range(240):
        known = set(traffic.vehicles.entry.tolist())
        traffic.step()
        vehicles = traffic.vehicles
        new = [row for row, entry in enumerate(vehicles.entry.tolist()) if entry not in known]
        assert all(times[vehicles.entry[row]] <= traffic.time for row in new)
        row = neighbors_on_lane(find_neighbors(vehicles.road, vehicles.lane, 3).leaders, vehicles.lane)
        gaps = np.where(row >= 0, vehicles.position[row] - LENGTH - vehicles.position, np.inf)
        assert (gaps[new] >= vehicles.minimum_gap[new] - 1e-9).all()
    assert traffic.insertion_queue.entry_counts[0] >= len(traffic.vehicles.entry) > 20


def test_a_control_step_does_not_change_earlier_records_of_vehicles() -> None:
    world = MotorwayBatch(replace(SHORT, penetration_rate=0.5), seeds_of(1))
    world.start(True)
    for _ in range(80):
        before = world._traffic.vehicles
        copies = before.map(np.copy)
        world.advance(Command(np.full(world.cav_count, -1.0), np.full(world.cav_count, 1.5)))
        for values, copied in zip(before, copies, strict=True):
            np.testing.assert_array_equal(values, copied)


REFUSED: dict[str, dict[str, Any]] = {
    "lanes": {"lanes": 3},
    "actuation": {"actuation": "shielded"},
    "simulation_step": {"simulation_step": 0.25, "steps_per_control_step": 4},
    "warmup": {"warmup": 100},
    "roadside.loss_rate": {"roadside": replace(SHORT.roadside, loss_rate=0.1)},
    "cruise.keep_right": {"cruise": replace(SHORT.cruise, keep_right=5.0)},
    "cruise.speed_gain": {"cruise": replace(SHORT.cruise, speed_gain=0.0)},
    "actuator.is_instant": {"actuator": replace(SHORT.actuator, lag=0.3)},
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_batch_cannot_do_is_refused_by_name(name: str) -> None:
    road = replace(SHORT, **REFUSED[name])
    assert statistically_unsupported_reason(road).startswith(name)
    with pytest.raises(InputError, match=f"batch: {name}"):
        run_batch(tasks_of(road, driver_of("cruise"), 1), allow_statistical=True)


def test_where_episodes_must_be_sumos_it_runs_in_sumo() -> None:
    assert unsupported_reason(SHORT)
    assert not statistically_unsupported_reason(SHORT)
    asked = list[EpisodeTask]()

    def run(tasks: Any) -> list[Episode]:
        asked.extend(tasks)
        return [Episode(seed=task.seed, status="completed") for task in tasks]

    some = tasks_of(replace(SHORT, horizon=20), driver_of("cruise"), 1)
    run_batched_if_supported(some, run)
    assert asked == some
    asked.clear()
    run_batched_if_supported(some, run, allow_statistical=True)
    assert not asked
