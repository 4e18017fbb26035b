"""Traffic on a motorway compared with SUMO, and commands to CAVs."""

from dataclasses import replace
from pathlib import Path

import libsumo
import numpy as np
import pytest

from tests.adapters.onnx_policies import linear, write
from unjam.adapters import onnx_driver
from unjam.drivers import Human, PISaturation
from unjam.drivers.car_following import AdaptiveACC
from unjam.drivers.command import Command
from unjam.drivers.local_state import MAX_OBSERVED_GAP, LocalState
from unjam.drivers.road_experts import AdvisorySpeed, Cruise, JamAhead
from unjam.drivers.roadside import RoadsideSettings
from unjam.measures.metrics import measure
from unjam.scenarios import Ring
from unjam.scenarios.motorway import ON_RAMP, Motorway
from unjam.scenarios.motorway_vehicles import LaneChanging, Trucks
from unjam.scenarios.road_control import RampMeter, SpeedLimitControl
from unjam.worlds.backend import WorldOptions
from unjam.worlds.batch.motorway.world import MotorwayBatch
from unjam.worlds.episode import can_drive, run_episode
from unjam.worlds.record import Episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic
from unjam.worlds.sumo.motorway import MotorwayTraffic
from unjam.worlds.sumo.simulation import Simulation

BUSY = replace(ON_RAMP, peak=(0.0, 240.0), penetration_rate=0.2, horizon=240)


def motorway(simulation: Simulation, scenario: Motorway = BUSY) -> MotorwayTraffic:
    traffic = make_traffic(scenario, (3,), simulation, WorldOptions(LocalState._fields))
    assert isinstance(traffic, MotorwayTraffic)
    traffic.start(is_controlled=True)
    return traffic


@pytest.fixture(scope="module")
def capped() -> Episode:
    return run_episode(BUSY, JamAhead(), (3,), record_details=True)


def test_leaders_and_gaps_are_sumos(simulation: Simulation) -> None:
    traffic, compared = motorway(simulation), 0
    for _ in range(150):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
        seen = traffic.local_state()
        for row, name in enumerate(traffic.cav_ids):
            leader, gap = libsumo.vehicle.getLeader(name, 90.0) or ("", 0.0)
            if not leader or libsumo.vehicle.getRoadID(name) in ("ramp", "merging"):
                continue  # there SUMO looks across lanes
            true_gap = gap + libsumo.vehicle.getMinGap(name)
            if true_gap < 90.0:
                assert seen.leader_gap[row] == pytest.approx(true_gap, abs=1e-6)
                assert seen.leader_speed[row] == libsumo.vehicle.getSpeed(leader)
                compared += 1
            assert seen.speed[row] == libsumo.vehicle.getSpeed(name)
    assert compared > 500


def test_adjacent_vehicles_are_those_of_sumo(simulation: Simulation) -> None:
    traffic, compared = motorway(simulation), 0
    for _ in range(150):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
        seen = traffic.local_state()
        for row, name in enumerate(traffic.cav_ids):
            here = libsumo.vehicle.getRoadID(name)
            if here != "motorway":  # where lanes end SUMO looks on to those that follow
                continue
            for column, mode in enumerate((0b010, 0b000, 0b011, 0b001)):
                lane = libsumo.vehicle.getLaneIndex(name) + (1 if column < 2 else -1)
                found = [
                    other
                    for other, _ in libsumo.vehicle.getNeighbors(name, mode)
                    if libsumo.vehicle.getRoadID(other) == here
                ]
                if not found or not 0 <= lane < 2:
                    continue
                (other,) = found
                way = libsumo.vehicle.getLanePosition(other) - libsumo.vehicle.getLanePosition(name)
                gap = abs(way) - 4.8
                if gap < MAX_OBSERVED_GAP:
                    assert seen.adjacent_gaps[row, column] == pytest.approx(gap, abs=1e-6)
                    assert seen.adjacent_speeds[row, column] == libsumo.vehicle.getSpeed(other)
                    compared += 1
    assert compared > 500


def test_ramp_vehicles_are_adjacent_to_the_right_lane_before_the_merge(simulation: Simulation) -> None:
    traffic, seen_there = motorway(simulation, replace(BUSY, penetration_rate=1.0)), 0
    for _ in range(200):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
        seen = traffic.local_state()
        on_ramp = {
            libsumo.vehicle.getLanePosition(name) - 400.0: libsumo.vehicle.getSpeed(name)
            for name in libsumo.edge.getLastStepVehicleIDs("ramp")
        }
        for row, name in enumerate(traffic.cav_ids):
            if libsumo.vehicle.getLaneID(name) != "motorway_0":
                continue
            place = libsumo.vehicle.getLanePosition(name) - 2000.0
            ahead = [other for other in on_ramp if place <= other]
            if ahead and min(ahead) - place - 4.8 < MAX_OBSERVED_GAP:
                assert seen.adjacent_gaps[row, 2] == pytest.approx(min(ahead) - place - 4.8, abs=1e-6)
                assert seen.adjacent_speeds[row, 2] == on_ramp[min(ahead)]
                seen_there += 1
            assert (seen.adjacent_gaps[row] > -4.8 - 1e-9).all()
    assert seen_there > 20


def test_a_cav_has_a_set_speed_cap_upstream_and_none_where_the_lane_closes(simulation: Simulation) -> None:
    traffic, held, free = motorway(simulation), [], []
    for _ in range(200):
        before = dict(zip(traffic.cav_ids, traffic.local_state().speed.tolist(), strict=True))
        traffic.advance(Command(np.full(traffic.cav_count, -0.1)))
        seen = traffic.local_state()
        for row, name in enumerate(traffic.cav_ids):
            if name in before and before[name] > 10.0:
                change = seen.speed[row] - before[name]
                (held if seen.distance_to_merge[row] > 60.0 else free).append(change)
    assert len(held) > 200
    assert max(held) <= -0.1 + 1e-9
    assert max(free) > 0.5


def test_the_observed_penetration_rate_is_that_of_entered_vehicles(simulation: Simulation) -> None:
    traffic = motorway(simulation, replace(BUSY, penetration_rate=0.3))
    for _ in range(100):
        traffic.advance(Command(np.full(traffic.cav_count, 1.0)))
    came = {*libsumo.vehicle.getIDList(), *simulation.arrived_vehicles()}
    share = np.unique(traffic.local_state().penetration_rate)
    assert share == pytest.approx([sum(name in traffic.road.cav_ids for name in came) / len(came)], abs=0.02)


@pytest.mark.long
def test_an_acc_keeps_the_commanded_time_gap_while_it_is_commanded(simulation: Simulation) -> None:
    def shortest(asked: float) -> float:
        """Return a short time headway of CAVs on a full road [s], and look that SUMO knows what was asked."""
        traffic, own, found = motorway(simulation), BUSY.cruise.time_gap, list[float]()
        for decision in range(200):
            free = np.full(traffic.cav_count, 100.0)
            traffic.advance(Command(free, np.full(traffic.cav_count, asked)))
            if decision > 100:
                seen = traffic.local_state()
                found += (seen.leader_gap / seen.speed.clip(0.1))[seen.leader_gap < MAX_OBSERVED_GAP].tolist()
        before = traffic.cav_ids
        traffic.advance(Command(np.full(traffic.cav_count, 100.0), np.full(traffic.cav_count, asked)))
        remaining = [name for name in before if name in traffic.cav_ids]
        assert {libsumo.vehicle.getTau(name) for name in remaining} == {max(asked, own)}
        traffic.advance(Command(np.full(traffic.cav_count, 100.0), np.full(traffic.cav_count, np.nan)))
        assert {libsumo.vehicle.getTau(name) for name in remaining if name in traffic.cav_ids} == {own}
        traffic.advance(Command(np.full(traffic.cav_count, 100.0), np.full(traffic.cav_count, asked)))
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))  # nothing asked is as NaN for all
        assert {libsumo.vehicle.getTau(name) for name in remaining if name in traffic.cav_ids} == {own}
        return float(np.quantile(found, 0.1))

    assert shortest(2.0) > shortest(0.5) + 0.3


def test_a_cav_without_a_cap_drives_as_its_own_acc(sumo: SumoBackend) -> None:
    episode = run_episode(BUSY, Cruise(), (3,), backend=sumo)
    assert episode.status == "completed"
    assert measure(episode)["shield_override_share"] == 0.0
    fastest = max(trajectory.applied_acceleration.max() for trajectory in episode.trajectories)
    assert 1.5 < fastest <= 2.5


@pytest.mark.parametrize("asked", [0.2, 0.5, 1.0])
def test_a_standing_cav_starts_at_any_positive_command_in_sumo_and_in_a_batch(
    asked: float, simulation: Simulation
) -> None:
    """SUMO's IDM stands for ever at set speeds below half a metre a second."""
    for world in (make_traffic(BUSY, (3,), simulation), MotorwayBatch(BUSY, [(3,)])):
        world.start(is_controlled=True)
        for _ in range(36):
            world.advance(Command(np.full(world.cav_count, -3.0)))
        assert world.local_state().speed.max() <= 0.1
        for _ in range(10):
            world.advance(Command(np.full(world.cav_count, asked)))
        assert 0.8 * asked * 10.0 < world.local_state().speed[0] < 1.3 + asked * 10.0


def test_cavs_have_the_desired_speeds_of_the_vehicles_that_they_replace(simulation: Simulation) -> None:
    traffic = motorway(simulation)
    for _ in range(60):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    kinds = {entry.name: entry.vehicle_type for entry in traffic.road.entries}
    for row, name in enumerate(traffic.cav_ids):
        factor = traffic.road.vehicle_types[kinds[name]].speed_factor
        assert libsumo.vehicle.getSpeedFactor(name) == pytest.approx(factor)
        assert simulation.type_of(name) == f"cav_of_{kinds[name]}"
        assert traffic.local_state().allowed_speed[row] == libsumo.vehicle.getAllowedSpeed(name)


def on_the_left(simulation: Simulation, **lanes: float) -> float:
    """Return in what share of the time CAVs upstream of the ramp are on the left lane."""
    road = replace(BUSY, peak=(0.0, 0.0), cruise=replace(BUSY.cruise, **lanes))
    traffic = motorway(simulation, road)
    left = upstream = 0
    for _ in range(200):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
        lanes_now = [libsumo.vehicle.getLaneID(name) for name in traffic.cav_ids]
        left += lanes_now.count("motorway_1")
        upstream += lanes_now.count("motorway_1") + lanes_now.count("motorway_0")
    return left / upstream


@pytest.mark.long
def test_cavs_keep_right_and_overtake_as_configured(simulation: Simulation) -> None:
    as_people = on_the_left(simulation)
    assert on_the_left(simulation, keep_right=1.0, speed_gain=1.0) == as_people
    assert on_the_left(simulation, keep_right=10.0) < as_people - 0.05
    assert on_the_left(simulation, speed_gain=5.0) > as_people + 0.05
    assert on_the_left(simulation, keep_right=0.0) > as_people + 0.05
    assert on_the_left(simulation, speed_gain=0.0) < as_people - 0.05


def test_the_message_is_the_mean_speed_of_the_lane_ahead(simulation: Simulation) -> None:
    traffic = motorway(simulation)
    for _ in range(120):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    state, checked = traffic.local_state(), 0
    for row, name in enumerate(traffic.cav_ids):
        lane = libsumo.vehicle.getLaneID(name)
        if not lane.startswith("motorway"):
            continue
        section = int(libsumo.vehicle.getLanePosition(name) // 100)
        there = libsumo.lane.getLastStepVehicleIDs(lane)
        speeds = [
            libsumo.vehicle.getSpeed(other)
            for other in there
            if int(libsumo.vehicle.getLanePosition(other) // 100) == section
        ]
        assert state.lane_speeds[row, 0] == pytest.approx(np.mean(speeds))
        checked += 1
    assert checked > 5


def test_human_only_traffic_does_not_depend_on_the_penetration_rate(sumo: SumoBackend) -> None:
    one, other = (
        run_episode(replace(ON_RAMP, peak=(0.0, 60.0), horizon=60, penetration_rate=share), Human(), (1,), backend=sumo)
        for share in (0.05, 0.5)
    )
    np.testing.assert_array_equal(one.speeds, other.speeds)


def test_the_audit_separates_cut_ins_from_car_following(capped: Episode) -> None:
    audit = capped.audit
    assert audit.has_lanes
    assert audit.required_time_gap == 1.0
    assert audit.cut_in_braking.samples > 100
    assert audit.cav_braking.samples > audit.cut_in_braking.samples
    everybody = audit.human_braking.samples + audit.cav_braking.samples + audit.cut_in_braking.samples
    there = (~np.isnan(capped.speeds[1:])).sum()
    assert everybody == pytest.approx(2 * there, rel=0.02)
    assert 0.5 < audit.following.min_time_gap < 3.0
    row = measure(capped)
    assert row["feasibility"] == "feasible"
    assert row["cav_max_braking"] < 4.0


def test_branches_and_demand_peak_are_recorded(capped: Episode) -> None:
    assert set(capped.branches) == {"motorway", "ramp"}
    assert capped.demand_peak == (0.0, 240.0)
    assert -2000.0 <= np.nanmin(capped.positions) < np.nanmax(capped.positions) <= 1000.0
    stays = [trajectory for trajectory in capped.trajectories if len(trajectory.applied_acceleration) > 60]
    assert stays
    assert all((np.diff(stay.states.distance_to_merge) <= 1e-9).all() for stay in stays)


@pytest.mark.slow
def test_a_cav_with_a_cap_still_brakes_as_hard_as_its_own_acc(sumo: SumoBackend) -> None:
    """SUMO limits vehicles with a commanded speed to comfortable braking: they would run into the tail of a jam."""
    road = replace(ON_RAMP, penetration_rate=0.3, horizon=800)
    episode = run_episode(road, AdaptiveACC(time_step=1.0), (2,), backend=sumo)
    assert (episode.status, episode.collisions) == ("completed", 0)
    assert road.cruise.deceleration is not None
    assert episode.audit.cav_braking.max_braking > road.cruise.deceleration + 0.1
    assert episode.audit.cav_braking.exceedances[1] == 0


def test_an_onnx_policy_sets_the_speed_of_cars_with_an_acc(tmp_path: Path) -> None:
    description = 'inputs = ["penetration_rate"]\noutput = { quantity = "set_speed", unit = "km/h", offset = 54.0 }'
    driver = onnx_driver(write(tmp_path, linear(1, [0.0]), description))
    light = replace(BUSY, inflow=600, ramps=(), penetration_rate=0.5, horizon=120)
    episode = run_episode(light, driver, (3,))
    late = [each.states.speed[40:] for each in episode.trajectories if len(each.states.speed) > 60]
    assert len(late) > 3
    assert all(abs(speeds.max() - 15.0) < 0.5 for speeds in late)
    assert measure(episode)["contacts"] == 0


def test_gaps_reach_to_the_rear_of_trucks(simulation: Simulation) -> None:
    traffic, compared = motorway(simulation, replace(BUSY, trucks=Trucks(share=0.4))), 0
    for _ in range(120):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
        seen = traffic.local_state()
        for row, name in enumerate(traffic.cav_ids):
            leader, gap = libsumo.vehicle.getLeader(name, 90.0) or ("", 0.0)
            true_gap = gap + libsumo.vehicle.getMinGap(name)
            is_behind_truck = leader and libsumo.vehicle.getLength(leader) > 10.0 and true_gap < 90.0
            if is_behind_truck and libsumo.vehicle.getRoadID(name) == "motorway":
                assert seen.leader_gap[row] == pytest.approx(true_gap, abs=1e-6)
                compared += 1
    assert compared > 100


def test_cavs_cooperate_as_configured_and_people_as_they_are(simulation: Simulation) -> None:
    changing = LaneChanging(cooperation=(0.2, 0.4))
    scenario = replace(BUSY, lane_changing=changing, cruise=replace(BUSY.cruise, cooperation=0.9))
    traffic, key = motorway(simulation, scenario), "laneChangeModel.lcCooperative"
    for _ in range(60):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    values = {name: float(libsumo.vehicle.getParameter(name, key)) for name in libsumo.vehicle.getIDList()}
    assert {values[name] for name in traffic.cav_ids} == {0.9}
    assert all(0.2 <= value <= 0.4 for name, value in values.items() if name not in traffic.cav_ids)


def test_without_a_source_of_speeds_no_message_arrives(simulation: Simulation) -> None:
    scenario = replace(BUSY, roadside=RoadsideSettings(source="none"))
    traffic = motorway(simulation, scenario)
    traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    assert traffic.local_state().lane_speeds is None
    assert "lane_speeds" not in scenario.provided_fields


CONTROLLED = replace(ON_RAMP, peak=(0.0, 600.0), penetration_rate=0.0, horizon=400)


def test_a_ramp_meter_lets_vehicles_pass_at_its_rate(simulation: Simulation) -> None:
    meter = RampMeter(active=True, target_density=1.0, rates=(240.0, 1200.0), gain=1000.0)
    ramp = replace(ON_RAMP.ramps[0], length=1000.0, inflow=600.0)
    traffic = motorway(simulation, replace(CONTROLLED, ramp_meter=meter, ramps=(ramp,)))
    ramp_vehicles, merge_times = set[str](), dict[str, int]()
    for second in range(400):
        traffic.advance(None)
        ramp_vehicles.update(libsumo.edge.getLastStepVehicleIDs("ramp"))
        for name in ramp_vehicles.intersection(libsumo.edge.getLastStepVehicleIDs("merging")):
            merge_times.setdefault(name, second)
    late = [time for time in merge_times.values() if time >= 150]  # vehicles that entered without a meter have merged
    assert len(late) == pytest.approx(240.0 * 250.0 / 3600.0, abs=2)
    assert not libsumo.simulation.getCollidingVehiclesIDList()


def test_a_ramp_meter_does_not_let_its_queue_reach_the_entrance(sumo: SumoBackend) -> None:
    meter = RampMeter(active=True, target_density=1.0, gain=1000.0)
    episode = run_episode(replace(CONTROLLED, ramp_meter=meter), Human(), (3,), backend=sumo)
    assert episode.status == "completed"
    assert episode.backlog.max() <= 3


@pytest.mark.long
def test_vehicles_do_not_brake_hard_for_a_speed_limit(sumo: SumoBackend) -> None:
    control = SpeedLimitControl(active=True, target_density=1.0, gain=1.0, length=800.0, acceleration_length=500.0)
    braking = [
        measure(run_episode(replace(CONTROLLED, inflow=600.0, speed_limit_control=each), Human(), (3,), backend=sumo))
        for each in (control, replace(control, active=False))
    ]
    assert braking[0]["mean_speed"] < braking[1]["mean_speed"] - 1.0
    assert braking[0]["human_max_braking"] < braking[1]["human_max_braking"] + 0.5


def test_the_lowest_of_a_speed_limit_and_the_cap_of_a_cav_holds(simulation: Simulation) -> None:
    control = SpeedLimitControl(active=True, target_density=1.0, gain=1.0, min_limit=15.0)
    traffic = motorway(simulation, replace(BUSY, speed_limit_control=control))
    for _ in range(120):
        traffic.advance(Command(np.full(traffic.cav_count, -1.0)))
    for _ in range(3):
        slow = libsumo.vehicle.getSpeed(traffic.cav_ids[-1])
        traffic.advance(Command(np.full(traffic.cav_count, -1.0)))
        assert libsumo.vehicle.getSpeed(traffic.cav_ids[-1]) <= max(0.2, slow - 0.9)
    for _ in range(60):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    limited = [
        name
        for name in libsumo.edge.getLastStepVehicleIDs("motorway")
        if 600.0 < libsumo.vehicle.getLanePosition(name) < 1400.0
    ]
    assert set(limited) & set(traffic.cav_ids)
    assert max(map(libsumo.vehicle.getSpeed, limited)) < 15.5


def test_a_collision_among_human_drivers_is_counted_and_ends_nothing(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    traffic = motorway(simulation)
    for _ in range(60):
        traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    humans = [name for name in libsumo.vehicle.getIDList() if name not in traffic.cav_ids][:2]
    monkeypatch.setattr(simulation, "colliding_vehicles", lambda: humans)
    traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    assert not traffic.has_crashed
    assert len(traffic._vehicles.collided_vehicles) == 2
    monkeypatch.setattr(simulation, "colliding_vehicles", lambda: [humans[0], traffic.cav_ids[0]])
    traffic.advance(Command(np.full(traffic.cav_count, 100.0)))
    assert traffic.has_crashed


def test_a_speed_limit_holds_upstream_while_the_density_is_high(simulation: Simulation) -> None:
    control = SpeedLimitControl(active=True, target_density=1.0, gain=1.0, length=800.0, acceleration_length=500.0)
    traffic = motorway(simulation, replace(CONTROLLED, speed_limit_control=control))
    for _ in range(300):
        traffic.advance(None)
    speeds = {"limited": list[float](), "downstream": list[float]()}
    for _ in range(60):
        traffic.advance(None)
        for name in libsumo.edge.getLastStepVehicleIDs("motorway"):
            position, speed = libsumo.vehicle.getLanePosition(name), libsumo.vehicle.getSpeed(name)
            if 1100.0 < position < 1450.0:
                speeds["limited"].append(speed)
            elif position > 1900.0:
                speeds["downstream"].append(speed)
    assert np.mean(speeds["limited"]) == pytest.approx(control.min_limit, abs=1.0)
    assert np.mean(speeds["downstream"]) > control.min_limit + 3.0


def test_an_advised_speed_holds_on_its_section_and_without_a_map_everywhere() -> None:
    driver = AdvisorySpeed(advised_speed=20.0, first_distance=1000.0, last_distance=200.0)
    ones = np.ones(4)
    state = LocalState(25.0 * ones, 25.0 * ones, 50.0 * ones, *(25.0 * ones, 50.0 * ones), ones, np.nan * ones)
    state = state._replace(distance_to_merge=np.array([1500.0, 900.0, 100.0, -50.0]))
    accelerations, _ = driver.act(state, {})
    assert accelerations.tolist() == [100.0, -1.5, 100.0, 100.0]
    without_map, _ = driver.act(state._replace(distance_to_merge=None), {})
    assert without_map.tolist() == [-1.5] * 4


def test_advisory_speed_drives_on_open_roads_and_no_default_comparison_stops_at_it() -> None:
    assert can_drive(AdvisorySpeed(), ON_RAMP)
    assert not can_drive(AdvisorySpeed(), Ring())
    assert can_drive(PISaturation(time_step=0.5), Ring())  # a wrong time step is refused later, in words
