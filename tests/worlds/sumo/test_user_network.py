"""Users' networks in SUMO, on networks from other sources."""

import warnings
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import pytest

from tests.worlds.sumo.user_networks import SPARSE, game, grid, straight
from tests.worlds.test_record import fingerprint, serialize_and_restore
from unjam.controller import make_driver
from unjam.drivers import IDM, Constant, Human, PISaturation
from unjam.drivers.command import Command
from unjam.drivers.network import Network
from unjam.errors import InputError, SumoInputError
from unjam.measures.feasibility import feasibility
from unjam.measures.metrics import measure
from unjam.physics.idm import IDMParameters
from unjam.scenarios import Scenario, make_scenario
from unjam.scenarios.population import Population, write_population
from unjam.scenarios.user_network import ACC_SETTINGS
from unjam.worlds.backend import WorldOptions
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, make_traffic, sumo_inputs
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.user_network import UserNetworkTraffic
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool
from unjam.worlds.world import DriverLog


@pytest.fixture(
    scope="module", params=["ramp", *(pytest.param(name, marks=pytest.mark.long) for name in ("cross", "grid"))]
)
def file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp(request.param)
    return grid(folder) if request.param == "grid" else game(folder, request.param)


@pytest.fixture(scope="module")
def network_with_signals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return grid(tmp_path_factory.mktemp("signalled"))


def scenario_of(file: Path, **changes: Any) -> Scenario:
    return make_scenario(str(file), {"penetration_rate": 0.3, "horizon": 200, **changes})


def own(simulation: Simulation, file: Path, seed: int = 0, **changes: Any) -> UserNetworkTraffic:
    traffic = make_traffic(scenario_of(file, **changes), (seed,), simulation, WorldOptions(record_details=True))
    assert isinstance(traffic, UserNetworkTraffic)
    traffic.start(is_controlled=True)
    return traffic


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_in_process_and_in_workers(file: Path, sumo: SumoBackend) -> None:
    scenario = scenario_of(file, horizon=80)
    task = EpisodeTask(scenario, PISaturation(time_step=scenario.control_step), (3,))
    here = run_episode(task.scenario, task.driver, task.seed, backend=sumo)
    run_episode(task.scenario, Constant(0.4), (4,), backend=sumo)
    with WorkerPool(1) as workers:
        (there,) = workers.run([task])
    again = run_episode(task.scenario, task.driver, task.seed, backend=sumo)
    assert here.status == "completed"
    assert fingerprint(there) == fingerprint(again) == fingerprint(here) == fingerprint(serialize_and_restore(here))


def test_the_same_vehicles_are_cavs_for_every_driver(file: Path, sumo: SumoBackend) -> None:
    scenario = scenario_of(file)
    slow, fast, human = (
        run_episode(scenario, driver, (0,), backend=sumo) for driver in (Constant(-0.2), IDM(), Human())
    )
    assert len(human.cav_ids) > 2
    for one, other in ((slow, fast), (fast, human)):
        both = set(one.vehicle_ids) & set(other.vehicle_ids)
        # A vehicle that came in the very last decision has no trajectory.
        new = {name for each in (one, other) for name in each.vehicle_ids if steps_on_road(each, name) < 2}
        assert set(one.cav_ids) & both - new == set(other.cav_ids) & both - new


def steps_on_road(episode: Any, name: str) -> int:
    column = episode.vehicle_ids.index(name)
    return int((~np.isnan(episode.speeds[:, column])).sum())


@pytest.mark.slow
def test_penetration_rate_and_cav_types_select_the_cavs(tmp_path: Path) -> None:
    file = game(tmp_path, "ramp")
    episode = run_episode(scenario_of(file, penetration_rate=0.3, horizon=600), Human(), (0,))
    share = len(episode.cav_ids) / len(episode.vehicle_ids)
    assert share == pytest.approx(0.3, abs=0.12)
    with Simulation() as simulation:
        traffic = own(simulation, file, penetration_rate=0.0, cav_types=["truck"], horizon=300)
        kinds: dict[str, str] = {}
        for _ in range(150):
            for name in libsumo.vehicle.getIDList():
                kinds.setdefault(name, libsumo.vehicle.getTypeID(name))
            traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
        assert {name for name, kind in kinds.items() if "truck" in kind} >= set(traffic.cav_ids)
        driven = {name for moment in traffic._log.trips.cav_ids for name in moment}
        there = set(traffic._log.traffic.names) | driven
        assert driven == {name for name in there if "truck" in kinds.get(name, "")} != set()


@pytest.mark.slow
def test_calibrated_drivers_drive_the_cars_and_the_same_vehicles_are_cavs(tmp_path: Path) -> None:
    file, population = game(tmp_path, "ramp"), tmp_path / "drivers.json"
    near, far = IDMParameters(time_headway=0.8), IDMParameters(time_headway=3.0, minimum_gap=6.0)
    write_population(population, Population(near, (near, far), (-9.0, 3.0)))
    plain = run_episode(scenario_of(file, horizon=400), Human(), (0,))
    calibrated = scenario_of(file, horizon=400, population=str(population))
    assert "2 calibrated drivers" in calibrated.human_description
    driven = run_episode(calibrated, Human(), (0,))
    assert set(plain.cav_ids) & set(driven.cav_ids)
    assert not set(driven.cav_ids) & (set(plain.vehicle_ids) - set(plain.cav_ids))
    assert np.nanmean(driven.speeds) != np.nanmean(plain.speeds)
    with Simulation() as simulation:
        traffic = own(simulation, file, population=str(population), horizon=100)
        seen: dict[str, set[tuple[float, float]]] = {}
        for _ in range(100):
            traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
            for name in set(libsumo.vehicle.getIDList()) - set(traffic.cav_ids):
                kind = libsumo.vehicle.getVehicleClass(name)
                seen.setdefault(kind, set()).add((libsumo.vehicle.getTau(name), libsumo.vehicle.getMinGap(name)))
    assert seen["passenger"] == {(one.time_headway, one.minimum_gap) for one in (near, far)}
    assert not seen.get("truck", set()) & seen["passenger"]


@pytest.mark.parametrize("setting", ["ramp_meter.active", "speed_limit_control.target_density"])
def test_controls_of_built_in_motorways_are_refused_with_an_alternative_that_drives(
    setting: str, tmp_path: Path, sumo: SumoBackend
) -> None:
    file = str(straight(tmp_path, '<vType id="own"/>' + SPARSE))
    with pytest.raises(InputError, match=r"only on motorways such as on-ramp; allowed here: a fixed speed") as refused:
        make_scenario(file, {setting: 1})
    words = str(refused.value).partition("-d ")[2].partition(")")[0]
    road = make_scenario(file, {**ACC_SETTINGS, "penetration_rate": 1.0, "horizon": 300})
    speeds = [
        run_episode(road, make_driver(driver, road.control_step), 1, backend=sumo).speeds[-1, 0]
        for driver in ("cruise", words.replace("20", "9"))
    ]
    assert speeds[0] > 11.0
    assert speeds[1] == pytest.approx(9.0, abs=0.5)


def test_a_population_with_a_residual_is_refused_on_a_users_network(tmp_path: Path) -> None:
    residual = Network(((np.zeros((3, 1)), np.zeros(1)),), 0.5)
    one, population = IDMParameters(), tmp_path / "drivers.json"
    write_population(population, Population(one, (one,), (-9.0, 3.0), residual))
    with pytest.raises(InputError, match="residual network is not allowed on a user network"):
        scenario_of(game(tmp_path, "ramp"), population=str(population))
    with pytest.raises(InputError, match="human_control: native is not allowed for a population with a residual"):
        make_scenario("ring", {"population": str(population), "human_control": "native"})


def test_all_vehicles_or_none_may_be_cavs(file: Path, sumo: SumoBackend) -> None:
    everyone = run_episode(scenario_of(file, penetration_rate=1.0, horizon=60), IDM(), (0,), backend=sumo)
    there = [name for name in everyone.vehicle_ids if steps_on_road(everyone, name) > 1]
    assert set(everyone.cav_ids) == set(there)
    with pytest.raises(InputError, match="no CAV was on the road in 5 control steps"):
        run_episode(scenario_of(file, penetration_rate=1e-9, horizon=5), IDM(), (0,), backend=sumo)


def test_cavs_exceed_the_allowed_speed_only_while_braking(file: Path, simulation: Simulation) -> None:
    traffic = own(simulation, file)
    compared, brakes = 0, traffic.scenario.safety.braking
    for _ in range(200):
        driven = list(traffic.cav_ids)
        before = {name: libsumo.vehicle.getSpeed(name) for name in driven}
        traffic.advance(Command(np.ones(len(driven))))
        for name in driven:
            if name in traffic.cav_ids:
                speed, allowed = libsumo.vehicle.getSpeed(name), libsumo.vehicle.getAllowedSpeed(name)
                compared += 1
                braked = before[name] - brakes * traffic.scenario.control_step
                assert speed <= max(allowed, braked) + 1e-6
    assert compared > 200
    assert not traffic.has_crashed


def test_cavs_stop_at_red(network_with_signals: Path, simulation: Simulation) -> None:
    traffic = own(simulation, network_with_signals, penetration_rate=1.0, horizon=240)
    waited = passed = 0
    ahead: dict[str, Any] = {}
    for _ in range(200):
        traffic.advance(Command(np.ones(len(traffic.cav_ids))))
        for name in libsumo.vehicle.getIDList():
            signals = libsumo.vehicle.getNextTLS(name)
            now = signals[0] if signals else None
            before = ahead.get(name)
            if before is not None and (now is None or now[0] != before[0]):
                passed += 1
                assert before[3] != "r", f"{name} drove across a red light"
            if now is not None:
                waited += now[3] == "r" and now[2] < 3.0 and libsumo.vehicle.getSpeed(name) < 0.1
            ahead[name] = now
        for name in set(ahead) - set(libsumo.vehicle.getIDList()):
            del ahead[name]
    assert waited > 20
    assert passed > 20


COLUMN = "".join(
    f'<vehicle id="{number}" type="{"van" if number % 3 == 1 else "car"}" route="along" depart="0" '
    f'departPos="{place}" departSpeed="10"/>'
    for number, place in enumerate((400, 340, 310, 180, 60))
)


def test_neighbors_on_one_lane_agree_with_the_positions(tmp_path: Path, simulation: Simulation) -> None:
    traffic = own(simulation, straight(tmp_path, COLUMN), penetration_rate=1.0, horizon=400)
    generator = np.random.default_rng(0)
    lengths = {name: 7.0 if int(name) % 3 == 1 else 5.0 for name in "01234"}
    seen = 0
    for _ in range(300):
        traffic.advance(Command(generator.uniform(-0.6, 0.5, len(traffic.cav_ids))))
        state = traffic.local_state()
        order = sorted(traffic.cav_ids)  # no overtaking on one lane
        place = {name: libsumo.vehicle.getLanePosition(name) for name in order}
        speed = {name: libsumo.vehicle.getSpeed(name) for name in order}
        for row, name in enumerate(traffic.cav_ids):
            at = order.index(name)
            for other, gap, rate in (
                (order[at - 1] if at else None, state.leader_gap[row], state.leader_speed[row]),
                (order[at + 1] if at + 1 < len(order) else None, state.follower_gap[row], state.follower_speed[row]),
            ):
                if other is None:
                    assert (gap, rate) == (100.0, speed[name])
                    continue
                front, back = (name, other) if place[name] > place[other] else (other, name)
                expected = place[front] - lengths[front] - place[back]
                near = expected < 100.0
                assert gap == pytest.approx(expected if near else 100.0, abs=1e-6)
                assert rate == (speed[other] if near else speed[name])
                seen += near
    assert seen > 500


def test_commands_are_carried_out_exactly_where_it_is_safe_and_allowed(tmp_path: Path, sumo: SumoBackend) -> None:
    one = '<vehicle id="v" type="van" route="along" depart="0" departPos="10" departSpeed="5"/>'
    scenario = scenario_of(straight(tmp_path, one), penetration_rate=1.0, horizon=300)
    (trajectory,) = run_episode(scenario, Constant(0.7), (0,), backend=sumo).trajectories
    expected = np.minimum(5.0 + 0.07 * np.arange(301), 20.0)
    np.testing.assert_allclose(trajectory.states.speed, expected, atol=1e-9)
    assert not (trajectory.shield_braking > 1e-9).any()


def test_a_vehicle_with_the_name_of_one_that_has_left_is_controlled_as_well(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = '<vehicle id="{}" type="car" route="along" depart="{}"/>'
    departures = ("v", 0), ("other", 210), ("v", 300)  # SUMO reads 200 s ahead, and there refuses a name of a vehicle
    file = straight(tmp_path, "".join(one.format(*each) for each in departures), length=100.0, step=1.0)
    controlled, take_control = list[str](), simulation.take_control
    monkeypatch.setattr(
        simulation, "take_control", lambda names, *given: (controlled.extend(names), take_control(names, *given))
    )
    scenario = scenario_of(file, penetration_rate=1.0, horizon=330)
    run_episode(scenario, IDM(), (0,), backend=SumoBackend(simulation))
    assert controlled == ["v", "other", "v"]


def test_a_command_holds_for_its_step_whatever_the_configuration_says(tmp_path: Path, sumo: SumoBackend) -> None:
    one = '<vehicle id="v" type="car" route="along" depart="0" departPos="10" departSpeed="5"/>'
    file = straight(tmp_path, one)
    file.write_text(file.read_text().replace("<end ", '<default.action-step-length value="1"/><end '))
    scenario = scenario_of(file, penetration_rate=1.0, horizon=100)
    (trajectory,) = run_episode(scenario, Constant(0.7), (0,), backend=sumo).trajectories
    np.testing.assert_allclose(np.diff(trajectory.states.speed), 0.07, atol=1e-9)


def test_a_heavy_vehicle_keeps_its_properties_as_a_cav(tmp_path: Path) -> None:
    one = '<vehicle id="v" type="van" route="along" depart="0"/>'
    file = straight(tmp_path, one)
    demand = tmp_path / "demand.rou.xml"
    demand.write_text(demand.read_text().replace('id="van"', 'id="van" mass="3000"'))
    scenario = scenario_of(file, penetration_rate=1.0)
    traffic = sumo_inputs(scenario, scenario.draw(np.random.default_rng(0))).traffic_xml
    assert 'mass="3000"' in traffic


@pytest.mark.long
def test_an_episode_ends_when_the_last_vehicle_has_arrived(tmp_path: Path, sumo: SumoBackend) -> None:
    scenario = scenario_of(straight(tmp_path, COLUMN), penetration_rate=1.0, horizon=4000)
    episode = run_episode(scenario, IDM(), (0,), backend=sumo)
    assert episode.status == "completed"
    assert episode.control_steps < 1500
    assert (episode.arrivals, len(episode.trajectories)) == (5, 5)
    assert not any(trajectory.terminated for trajectory in episode.trajectories)


@pytest.mark.slow
def test_the_flow_does_not_depend_on_the_last_arrival(tmp_path: Path, sumo: SumoBackend) -> None:
    vehicles = '<flow id="f" type="car" route="along" begin="0" end="20" period="2"/>'
    scenario = make_scenario(str(straight(tmp_path, vehicles, 800.0, 120.0)), {"penetration_rate": 1.0})
    one, other = (run_episode(scenario, driver, (0,), backend=sumo) for driver in (Human(), Constant(0.3)))
    assert other.control_steps != one.control_steps
    planned = 120.0 - 0.1  # the first step inserts the first vehicles, before control
    flow = measure(one)["outflow_veh_per_h"]
    assert measure(other)["outflow_veh_per_h"] == flow == pytest.approx(10 * 3600.0 / planned)


def test_vehicles_with_a_long_insertion_delay_are_not_dropped(tmp_path: Path, sumo: SumoBackend) -> None:
    vehicles = '<flow id="f" type="van" route="along" begin="0" end="30" period="0.2" departSpeed="0"/>'
    file = straight(tmp_path, vehicles)
    file.write_text(file.read_text().replace("<end ", '<max-depart-delay value="5"/><end '))
    episode = run_episode(scenario_of(file, horizon=350), Human(), (0,), backend=sumo)
    assert len(episode.vehicle_ids) + episode.backlog[-1] == 150


@pytest.mark.slow
def test_flows_without_an_end_last_until_the_given_end(tmp_path: Path, sumo: SumoBackend) -> None:
    file = straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" period="5"/>', end=30.0)
    asked = [{}, {"end": 100.0}, {"end": 100.0, "begin": 0.0}, {"horizon": 999}]
    roads = [make_scenario(str(file), {"penetration_rate": 0.5, **each}) for each in asked]
    counts = [len(run_episode(road, Human(), (0,), backend=sumo).vehicle_ids) for road in roads]
    assert counts[0] < 8
    assert counts[1:] == [counts[1]] * 3
    assert counts[1] >= 20


def test_collisions_of_human_driven_vehicles_count_once_each_and_do_not_end_the_episode(
    tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = straight(tmp_path, '<flow id="f" type="car" route="along" begin="0" end="60" period="3"/>')
    collisions = iter([["f.0", "f.1"], ["f.0", "f.1"], ["f.1", "f.2"]])
    monkeypatch.setattr(simulation, "colliding_vehicles", lambda: next(collisions, []))
    episode = run_episode(
        scenario_of(file, penetration_rate=0.2, horizon=300), IDM(), (0,), backend=SumoBackend(simulation)
    )
    row = measure(episode)
    assert not {"f.0", "f.1", "f.2"} & set(episode.cav_ids)
    assert (episode.status, row["collisions"]) == ("completed", 3.0)
    assert "contact" not in feasibility(row)


def test_all_metrics_of_an_episode_are_computed(file: Path, sumo: SumoBackend) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for horizon in (2, 200):
            found = run_episode(
                scenario_of(file, penetration_rate=0.9, horizon=horizon),
                Human(),
                (0,),
                record_details=True,
                backend=sumo,
            )
            row = measure(found)
    assert 0 < row["mean_speed"] < 40
    assert row["outflow_veh_per_h"] == pytest.approx(found.arrivals / (200 * found.control_step) * 3600)
    assert 0.2 < row["speed_limit_ratio"] < 1.2
    assert row["fuel_ml_per_km"] > 20


def test_lanes_are_those_of_sumo_counted_from_the_left(tmp_path: Path, simulation: Simulation) -> None:
    traffic = own(simulation, game(tmp_path, "ramp"))
    for _ in range(60):
        traffic.advance(Command(np.zeros(len(traffic.cav_ids))))
    here = {
        name: libsumo.edge.getLaneNumber(libsumo.vehicle.getRoadID(name)) - 1 - libsumo.vehicle.getLaneIndex(name)
        for name in libsumo.vehicle.getIDList()
    }
    episode = traffic.record(DriverLog())
    column, seen = {name: number for number, name in enumerate(episode.vehicle_ids)}, set()
    for name, from_left in here.items():
        lane = episode.lane_indices[-1, column[name]]
        assert np.isnan(lane) == np.isnan(episode.positions[-1, column[name]]), "lanes of the route alone"
        if not np.isnan(lane):
            assert lane == from_left
            seen.add(episode.lane_names[int(lane)])
    assert "left lane" in seen
    assert len(seen) > 1


def test_positions_are_along_the_most_frequent_route(file: Path, sumo: SumoBackend) -> None:
    episode = run_episode(scenario_of(file), Human(), (0,), record_details=True, backend=sumo)
    assert np.isnan(run_episode(scenario_of(file), Human(), (0,), backend=sumo).positions).all()
    there = ~np.isnan(episode.positions)
    assert there.sum() > 300
    assert not (there & np.isnan(episode.speeds)).any()
    forward = np.diff(episode.positions, axis=0)
    assert np.nanmin(forward) > -1e-6
    assert np.isfinite(episode.poses[~np.isnan(episode.speeds)]).all()
    # On the route, distance driven is distance along it, but for the ways across junctions.
    step = episode.speeds[1:] * episode.control_step
    close = np.abs(forward - step)[there[1:] & there[:-1]]
    assert np.mean(close < 1e-3) > 0.6


def test_a_warm_up_runs_before_the_first_control_step(file: Path, sumo: SumoBackend) -> None:
    cold = run_episode(scenario_of(file, horizon=100), Human(), (1,), backend=sumo)
    warm = run_episode(scenario_of(file, horizon=40, warmup=60), Human(), (1,), backend=sumo)
    for name in warm.vehicle_ids:
        if name in cold.vehicle_ids:
            column, other = warm.vehicle_ids.index(name), cold.vehicle_ids.index(name)
            np.testing.assert_array_equal(warm.speeds[:, column], cold.speeds[60:, other])


def test_a_vehicle_that_sumo_refuses_later_is_reported_in_one_line(tmp_path: Path) -> None:
    late = COLUMN + '<vehicle id="v" type="ghost" route="along" depart="300"/>'
    scenario = scenario_of(straight(tmp_path, late, end=1000.0), penetration_rate=1.0, horizon=5000)
    with WorkerPool(1) as workers, pytest.raises(SumoInputError, match="ghost") as refused:
        workers.run([EpisodeTask(scenario, IDM(), (0,))])
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_an_error_of_sumo_during_the_episode_is_reported_in_one_line(tmp_path: Path) -> None:
    flow = '<flow id="f" type="car" from="road" to="road" begin="0" end="690" period="9"/>'
    late = flow + '<trip id="w" type="car" from="road" to="road" depart="690"/>'  # so far SUMO reads ahead
    late += '<trip id="v" type="car" from="road" to="road" depart="700" departPos="nowhere"/>'
    file = straight(tmp_path, late, end=1000.0)
    file.write_text(file.read_text().replace('value="0.1"', 'value="1"'))
    task = EpisodeTask(scenario_of(file, penetration_rate=0.5, horizon=1000), IDM(), (0,))
    words = "^SUMO cannot go on: Invalid departPos definition for trip 'v'"
    with WorkerPool(1) as workers, pytest.raises(SumoInputError, match=words) as refused:
        workers.run([task])
    assert "\n" not in str(refused.value)
    with pytest.raises(SumoInputError, match=words):
        run_episode(task.scenario, task.driver, task.seed)


def test_sumos_messages_before_it_has_a_log_are_reported(tmp_path: Path) -> None:
    file = straight(tmp_path, COLUMN)
    demand = tmp_path / "demand.rou.xml"
    demand.write_text(demand.read_text().replace('id="van"', 'id="van" emissionClass="PHEMlight5/none"'))
    words = "emissionClass with name 'PHEMlight5/none' doesn't exist"
    with WorkerPool(1) as workers, pytest.raises(SumoInputError, match=words):
        workers.run([EpisodeTask(scenario_of(file, penetration_rate=1.0, horizon=5), IDM(), (0,))])


def test_figures_show_a_network_that_was_made_again(tmp_path: Path, sumo: SumoBackend) -> None:
    for length in (500.0, 800.0):
        scenario = scenario_of(straight(tmp_path, COLUMN, length), penetration_rate=1.0, horizon=5)
        episode = run_episode(scenario, IDM(), (0,), backend=sumo, record_details=True)
        assert np.nanmax(episode.lane_lines) == length


def test_nothing_is_written_into_the_users_folder(tmp_path: Path) -> None:
    scenario = scenario_of(straight(tmp_path, COLUMN), penetration_rate=1.0, horizon=20)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, IDM(), (0,), record_details=True)])
    assert episode.has_run
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_network_that_breaks_later_fails_its_episode_and_nothing_else(tmp_path: Path) -> None:
    scenario = scenario_of(straight(tmp_path, COLUMN), penetration_rate=1.0, horizon=20)
    whole = (tmp_path / "road.net.xml").read_text()
    with WorkerPool(1) as workers:
        task = EpisodeTask(scenario, IDM(), (0,))
        (tmp_path / "road.net.xml").write_text("<net><edge/></net>")  # on this one SUMO itself would crash
        (broken,) = workers.run([task])
        (tmp_path / "road.net.xml").write_text(whole)
        (mended,) = workers.run([task])
    assert (broken.status, broken.error) == ("failed", "InputError")
    assert "the network has no version" in broken.reason
    assert mended.status == "completed"


@pytest.mark.long
def test_a_fast_cav_stops_behind_a_standing_vehicle_beyond_sensor_range(tmp_path: Path, sumo: SumoBackend) -> None:
    stands = '<vehicle id="stands" type="van" route="along" depart="0" departPos="900"><stop lane="road_0" '
    stands += 'endPos="905" duration="100"/></vehicle>'
    fast = '<vehicle id="fast" type="car" route="along" depart="1" departSpeed="max"/>'
    file = straight(tmp_path, stands + fast, end=50, speed=45)
    road = scenario_of(
        file,
        penetration_rate=0.0,
        cav_types=("car",),
        horizon=480,
        actuation="raw",
        action_limit=6.0,
        safety={"active": True},
    )
    episode = run_episode(road, Constant(acceleration=1.0), (0,), backend=sumo)
    fastest = max(each.states.speed.max() for each in episode.trajectories)
    assert fastest > 36.0, "at this speed the braking distance exceeds 100 m"
    assert episode.status == "completed"
    assert episode.audit.cav_braking.max_braking <= 6.0 + 1e-6
