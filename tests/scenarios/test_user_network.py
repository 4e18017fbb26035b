import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.sumo_files.test_sumo_files import configuration
from tests.worlds.sumo.user_networks import straight
from unjam.drivers import Human
from unjam.errors import InputError
from unjam.scenarios import make_scenario, scenario_from_recipe, scenario_recipe
from unjam.scenarios.road import UserNetworkRoad
from unjam.scenarios.user_network import UserNetwork, _log_once, load_user_network, passenger_types
from unjam.sumo_files import read_sumo_files
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend, sumo_inputs

TYPES = """
<routes>
  <vType id="car" length="4.2" minGap="3" carFollowModel="IDM" sigma="0.7" lcStrategic="2"/>
  <vType id="truck" vClass="truck" maxSpeed="22"/>
  <vType id="bike" vClass="bicycle"/>
  <vType id="unused"/>
  <flow id="f" type="car"/><flow id="g" type="bike"/><vehicle id="h" type="truck"/>
</routes>
"""


def own(folder: Path, times: str = "", routes: str = TYPES, **changes: Any) -> UserNetwork:
    changes = changes or {"penetration_rate": 0.5}
    found = make_scenario(str(configuration(folder, times, routes=routes)), changes)
    assert isinstance(found, UserNetwork)
    return found


def draw_road(folder: Path, **changes: Any) -> UserNetworkRoad:
    return own(folder, **changes).draw(np.random.default_rng(0))


TIMES = '<time><begin value="30"/><end value="90"/><step-length value="0.2"/></time>'


@pytest.mark.parametrize(
    ("changes", "step", "horizon"),
    [
        ({}, 0.2, 299),
        ({"steps_per_control_step": 5}, 0.2, 59),
        ({"simulation_step": 0.5}, 0.5, 119),
        ({"horizon": 7}, 0.2, 7),
        ({"simulation_step": 0.1, "steps_per_control_step": 3}, 0.1, 199),
        ({"begin": 50.0}, 0.2, 199),
        ({"begin": 40.0, "end": 70.0}, 0.2, 149),
        ({"end": 70.0, "horizon": 9}, 0.2, 9),
        ({"begin": 40.0, "end": 70.0, "warmup": 50}, 0.2, 99),
    ],
)
def test_step_and_horizon_are_those_of_the_configuration_unless_set(
    changes: dict[str, Any], step: float, horizon: int, tmp_path: Path
) -> None:
    found = own(tmp_path, TIMES, penetration_rate=0.1, **changes)
    assert (found.simulation_step, found.horizon) == (step, horizon)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"begin": 50.0}, " --begin 50"),
        ({"end": 70.0}, " --end 70"),
        ({"horizon": 99}, " --end 50"),
        ({"begin": 40.0, "end": 60.0}, " --begin 40 --end 60"),
    ],
)
def test_the_command_for_plain_sumo_has_changed_times_and_no_calibrated_drivers(
    changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    road = own(tmp_path, TIMES, penetration_rate=0.1, **changes)
    command = f"sumo -c {road.file} --seed 7{words} --tripinfo-output trips.xml --tripinfo-output.write-unfinished"
    assert road.plain_sumo_command(7) == f"{command} --tripinfo-output.write-undeparted"
    assert replace(road, population="unjam:ngsim").plain_sumo_command(7) == ""


def test_the_command_for_plain_sumo_has_the_values_of_replaced_options(tmp_path: Path) -> None:
    options = '<random value="true"/><max-depart-delay value="10"/>'
    path = straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>', options=options)
    command = make_scenario(str(path), {"penetration_rate": 0.1}).plain_sumo_command(7)
    assert " --random false" in command
    assert " --max-depart-delay -1" in command


@pytest.mark.long
def test_vehicles_that_depart_before_the_begin_are_left_out(tmp_path: Path, sumo: SumoBackend) -> None:
    departing = (f'<vehicle id="{at}" type="car" route="along" depart="{at}"/>' for at in (0, 5, 40, 60))
    road = str(straight(tmp_path, "".join(departing)))
    asked = {"penetration_rate": 1.0, "end": 80.0}
    early, late = (
        run_episode(load_user_network(road, {**asked, **begin}), Human(), (0,), backend=sumo)
        for begin in ({}, {"begin": 30.0})
    )
    assert (len(early.vehicle_ids), len(late.vehicle_ids)) == (4, 2)


@pytest.mark.long
def test_a_begin_after_the_end_that_the_configuration_names_needs_another_end(
    tmp_path: Path, sumo: SumoBackend
) -> None:
    road = str(straight(tmp_path, '<vehicle id="it" type="car" route="along" depart="90"/>', end=60.0))
    for end, horizon in (({"end": 100.0}, 199), ({"horizon": 200}, 200)):
        late = load_user_network(road, {"penetration_rate": 1.0, "begin": 80.0, **end})
        episode = run_episode(late, Human(), (0,), backend=sumo)
        assert (episode.vehicle_ids, late.horizon) == (("it",), horizon)


@pytest.mark.parametrize("times", [{"begin": 90.0}, {"end": 20.0}, {"begin": 50.0, "end": 50.0}])
def test_an_end_before_the_begin_is_refused(times: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"end: .* is not allowed; allowed: > [0-9.]+ s, the first step after begin"):
        own(tmp_path, TIMES, penetration_rate=0.1, **times)


def test_sumo_receives_all_digits_of_the_begin(tmp_path: Path) -> None:
    road = own(tmp_path, penetration_rate=0.1, begin=1234567.5, end=1234667.5).draw(np.random.default_rng(0))
    assert isinstance(road, UserNetworkRoad)
    assert float(road.files.options["begin"]) == 1234567.5


def test_without_an_end_an_episode_lasts_an_hour(tmp_path: Path) -> None:
    assert own(tmp_path).horizon == 3599


EVERYTHING = {
    **{"vClass": "passenger", "length": "4.2", "mass": "3000", "personCapacity": "7", "emergencyDecel": "8"},
    **{"accel": "1.9", "decel": "3.9", "lcStrategic": "2", "jmDriveAfterRedTime": "3", "minGapLat": "0.3"},
    **{"latAlignment": "left", "actionStepLength": "1", "boardingDuration": "2", "collisionMinGapFactor": "0.5"},
}
LAW = {"carFollowModel": "EIDM", "tau": "0.7", "minGap": "3", "sigma": "0.7", "delta": "7", "stepping": "0.1"}
ATTRIBUTES = " ".join(f'{name}="{value}"' for name, value in {**EVERYTHING, **LAW}.items())
TYPE = (
    f'<routes><vType id="car" {ATTRIBUTES} speedDev="0.4" imgFile="car.png">'
    '<param key="has.battery.device" value="true"/><param key="device.ssm.file" value="x"/>'
    '</vType><flow id="f" type="car"/></routes>'
)


@pytest.mark.parametrize(
    ("changes", "law", "replaced"),
    [
        ({"actuation": "cruise"}, {"carFollowModel": "IDM", "tau": 1.1, "minGap": 2.0, "delta": 4.0}, set()),
        ({"actuation": "cruise", "cruise.acceleration": 1.0}, {"accel": 1.0}, {"accel"}),
        ({}, {"carFollowModel": "Krauss", "minGap": 0.5}, {"decel", "emergencyDecel", "actionStepLength"}),
    ],
)
def test_a_cav_type_has_all_properties_of_its_type_except_car_following(
    changes: dict[str, Any], law: dict[str, Any], replaced: set[str], tmp_path: Path
) -> None:
    scenario = own(tmp_path, routes=TYPE, penetration_rate=0.5, **changes)
    types = sumo_inputs(scenario, scenario.draw(np.random.default_rng(0))).traffic_xml
    (car,) = (kind for kind in ElementTree.fromstring(types) if kind.get("id") == "cav_of_car")
    kept = {name: value for name, value in EVERYTHING.items() if name not in replaced}
    assert {name: car.get(name) for name in kept} == kept
    assert {name: car.get(name) for name in law} == {name: str(value) for name, value in law.items()}
    assert {car.get("stepping"), car.get("imgFile")} == {None}
    assert float(car.get("sigma", "nan")) == float(car.get("speedDev", "nan")) == 0.0
    assert [dict(each.items()) for each in car] == [{"key": "has.battery.device", "value": "true"}]


@pytest.mark.parametrize(
    ("changes", "eligible"),
    [
        ({}, {"car"}),
        ({"cav_classes": ["truck"]}, {"truck"}),
        ({"cav_classes": ["passenger", "truck"]}, {"car", "truck"}),
    ],
)
def test_passenger_cars_become_cavs_unless_other_classes_are_named(
    changes: dict[str, Any], eligible: set[str], tmp_path: Path
) -> None:
    scenario = own(tmp_path, penetration_rate=0.5, **changes)
    road = scenario.draw(np.random.default_rng(0))
    assert road.eligible_types == eligible
    assert (road.penetration_rate, road.cav_types) == (0.5, ())
    (note,) = scenario.notes
    others = sorted({"car", "truck", "bike"} - eligible)
    assert [name for name in ("bike", "car", "truck") if f"{name} (" in note] == others
    assert not own(tmp_path, cav_types=["bike"]).notes


@pytest.mark.parametrize("name", ["passenger", "private", "hov", "taxi", "evehicle", None])
def test_all_kinds_of_passenger_cars_are_eligible(name: str | None, tmp_path: Path) -> None:
    kind = f'vClass="{name}"' if name else ""
    routes = f'<routes><vType id="it" {kind}/><flow id="g" type="it"/></routes>'
    scenario = own(tmp_path, routes=routes, penetration_rate=0.5)
    assert (scenario.draw(np.random.default_rng(0)).eligible_types, scenario.notes) == ({"it"}, [])


def test_types_within_distributions_are_eligible_by_their_own_class(tmp_path: Path) -> None:
    routes = (
        '<routes><vType id="a"/><vType id="t" vClass="truck"/><vTypeDistribution id="mix">'
        '<vType refId="a" probability="1"/><vType id="b" vClass="hov" probability="1"/></vTypeDistribution>'
        '<vTypeDistribution id="more" vTypes="a t"/><flow id="f" type="mix"/><flow id="g" type="more"/>'
        "</routes>"
    )
    assert draw_road(tmp_path, routes=routes, penetration_rate=0.5).eligible_types == {"a", "b"}


def test_the_acc_has_the_limits_of_its_vehicle_by_default(tmp_path: Path) -> None:
    def cruise(**changes: Any) -> tuple[float | None, float | None]:
        found = own(tmp_path, penetration_rate=0.1, **changes).cruise
        return found.acceleration, found.deceleration

    assert cruise() == cruise(**{"cruise.time_gap": 2.0}) == (None, None)
    assert cruise(**{"cruise.acceleration": 1.5}) == (1.5, None)
    with pytest.raises(InputError, match=r"cruise.acceleration: None is not allowed on motorway; allowed: > 0"):
        make_scenario("on-ramp", {"cruise.acceleration": None})


def test_other_episodes_have_other_cavs(tmp_path: Path) -> None:
    scenario = own(tmp_path)
    seeds = {scenario.draw(np.random.default_rng(seed)).cav_seed for seed in range(5)}
    assert len(seeds) == 5
    assert np.isnan(scenario.draw(np.random.default_rng(0)).limit_speed)


def test_a_recipe_restores_the_scenario(tmp_path: Path) -> None:
    scenario = own(tmp_path, TIMES, cav_types=["car", "truck"], penetration_rate=0.25)
    assert scenario_from_recipe(scenario_recipe(scenario)) == scenario
    assert (
        dict(scenario.summary())["vehicles"]
        == "as its files say (25 % CAV of passenger, private, hov, taxi, evehicle, car, truck)"
    )


def test_its_cav_ids_are_unknown_before_an_episode(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cavs: None is not allowed here"):
        own(tmp_path).possible_cav_ids()


BIKES = '<routes><vType id="bike" vClass="bicycle"/><flow id="g" type="bike"/></routes>'


@pytest.mark.parametrize(
    ("changes", "routes", "words"),
    [
        ({"penetration_rate": 0.0}, TYPES, "penetration_rate: 0.0 is not allowed without cav_types"),
        ({"penetration_rate": 1.5}, TYPES, "penetration_rate: 1.5"),
        ({"penetration_rate": "some"}, TYPES, "penetration_rate: 'some'"),
        ({"cav_types": ["tank"]}, TYPES, "no vehicle has the type 'tank'; allowed: bike, car, truck"),
        ({"cav_types": ["unused"]}, TYPES, "no vehicle has the type 'unused'"),
        (
            {"penetration_rate": 0.1},
            BIKES,
            "no vehicle has one of the classes passenger, private, hov, taxi, evehicle; its types are bike "
            "(bicycle); set cav_classes or cav_types",
        ),
        ({"penetration_rate": 0.1, "cav_classes": ["car"]}, TYPES, "cav_classes: 'car' is not allowed; allowed: pass"),
        ({"penetration_rate": 0.1, "human_control": "commanded"}, TYPES, "human_control: 'commanded' is not allowed"),
        ({"penetration_rate": 0.1, "noise": 0.2}, TYPES, "noise: 0.2"),
        ({"penetration_rate": 0.1, "simulation_step": 0}, TYPES, "simulation_step: 0"),
        ({"penetration_rate": 0.1, "simulation_step": "fast"}, TYPES, "simulation_step: 'fast'"),
        ({"penetration_rate": 0.1, "steps_per_control_step": 0}, TYPES, "steps_per_control_step: 0"),
        ({"penetration_rate": 0.1, "length": 3}, TYPES, "length: unknown name"),
    ],
)
def test_invalid_values_are_reported_in_one_line(
    changes: dict[str, Any], routes: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        own(tmp_path, routes=routes, **changes)
    assert "\n" not in str(caught.value)


def test_a_predefined_type_of_sumo_can_become_a_cav(tmp_path: Path) -> None:
    routes = '<routes><flow id="g" type="DEFAULT_BIKETYPE"/></routes>'
    with pytest.raises(InputError, match="no vehicle has one of the classes"):
        own(tmp_path, routes=routes)
    road = draw_road(tmp_path, routes=routes, cav_types=["DEFAULT_BIKETYPE"])
    types = ElementTree.fromstring(sumo_inputs(own(tmp_path), road).traffic_xml)
    (bike,) = [kind for kind in types if kind.get("id") == "cav_of_DEFAULT_BIKETYPE"]
    assert bike.get("vClass") == "bicycle"


@pytest.mark.parametrize(
    "attributes", ['vClass="rail_urban"', 'vClass="ship"', 'vClass="aircraft"', 'carFollowModel="Rail"']
)
def test_trains_ships_and_aircraft_never_become_cavs(attributes: str, tmp_path: Path) -> None:
    routes = f'<routes><vType id="train" {attributes}/><vType id="car"/>{{}}<trip id="t" type="train"/></routes>'
    with pytest.raises(InputError, match="cav_types: 'train' is not allowed: its vehicles are not road vehicles"):
        own(tmp_path, routes=routes.format(""), cav_types=("train",))
    with pytest.raises(InputError, match="penetration_rate: no vehicle has one of the classes"):
        own(tmp_path, routes=routes.format(""), penetration_rate=1.0)
    found = own(tmp_path, routes=routes.format('<trip id="c" type="car"/>'), penetration_rate=1.0)
    files = read_sumo_files(tmp_path / "road.sumocfg")
    assert found.draw(np.random.default_rng(0)).eligible_types == {"car"}
    assert passenger_types(files) == ["car"]


@pytest.mark.parametrize("changes", [{}, {"end": 900.0}, {"horizon": 300, "warmup": 30}])
def test_demand_that_begins_after_the_end_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    routes = '<routes><flow id="f" begin="7:00:00"/></routes>'
    path = configuration(tmp_path, '<end value="300"/>', routes=routes)
    words = "no vehicle entered before .* s; the first departs at 25,200 s; use --begin 25200"
    with pytest.raises(InputError, match=words):
        make_scenario(str(path), {"penetration_rate": 0.5, **changes})
    assert make_scenario(str(path), {"penetration_rate": 0.5, "begin": 25200.0, "end": 25300.0}).horizon == 99


def test_the_default_penetration_rate_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    _log_once.cache_clear()
    path = str(configuration(tmp_path))
    rates = [load_user_network(path, changes).penetration_rate for changes in ({}, {"cav_types": ["car"]})]
    assert rates == [0.1, 0.0]
    assert "penetration rate: 10 % by default; --penetration-rate changes it" in caplog.messages


def test_differences_from_plain_sumo_are_noted(tmp_path: Path) -> None:
    inside = '<seed value="7"/><max-depart-delay value="9"/><fcd-output value="x"/><tripinfo value="y"/>'
    assert own(tmp_path, inside).notes[:-1] == [
        "road.sumocfg: left out because they only write or listen: option fcd-output, option tripinfo",
        "road.sumocfg: replaced by values of unjam: seed, max-depart-delay",
    ]
    assert make_scenario("ring").notes == []


def test_traffic_that_sumo_makes_otherwise_is_noted(tmp_path: Path) -> None:
    shares = '<device.rerouting.probability value="0.5"/><device.fcd.probability value="0.5"/><threads value="2"/>'
    network = '<net version="1.20"><edge id="a"><lane id="a_0" allow="bicycle"/></edge></net>'
    path = configuration(tmp_path, shares, network=network)
    assert load_user_network(str(path), {"penetration_rate": 0.5}).notes[:4] == [
        "road.sumocfg: left out because they only write or listen: option device.fcd.probability",
        "road.sumocfg: replaced by values of unjam: threads",
        "road.sumocfg: without the devices left out, SUMO equips other vehicles with the rest",
        "road.sumocfg: has bicycle lanes, where SUMO repeats an episode only in a new process: travel times of equal "
        "seeds differ by about 0.1 %",
    ]


def test_sources_of_speeds_that_only_motorways_have_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"roadside.source: 'cavs' is not allowed here; allowed: 'vehicles'"):
        own(tmp_path, penetration_rate=0.5, **{"roadside.source": "cavs"})


def test_a_vehicle_type_with_the_name_that_cavs_get_is_refused(tmp_path: Path) -> None:
    types = '<vType id="car"/><vType id="cav_of_car"/><route id="short" edges="ab bc"/>'
    routes = f'<routes>{types}<vehicle id="v" type="car" route="short" depart="0"/></routes>'
    with pytest.raises(
        InputError, match="file: the vehicle type 'cav_of_car' is not allowed: the type of CAVs that replace 'car' has"
    ):
        own(tmp_path, routes=routes, penetration_rate=1.0)
