"""The human baseline on a user's network equals plain SUMO with the same files."""

import gzip
import subprocess
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from unjam.drivers import Human
from unjam.errors import InputError
from unjam.scenarios import make_scenario
from unjam.sumo_files import read_lanes
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.simulation import Simulation

FLOW = '<flow id="f" type="car" route="short" begin="0" end="90" period="6"/>'
TYPE = '<vType id="car"/>'
ROUTE = '<route id="short" edges="ab bc"/>'
NETWORK = '<net-file value="road.net.xml"/>'


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A road from a to b and two from there to c, a short one and one by way of d."""
    folder = tmp_path_factory.mktemp("network")
    places = {"a": (0, 0), "b": (300, 0), "c": (600, 0), "d": (450, 200)}
    nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, (x, y) in places.items())
    lanes = {"ab": 2, "bc": 1, "bd": 1, "dc": 1}
    edges = "".join(
        f'<edge id="{name}" from="{name[0]}" to="{name[1]}" numLanes="{count}" speed="15"/>'
        for name, count in lanes.items()
    )
    (folder / "nodes.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "edges.xml").write_text(f"<edges>{edges}</edges>")
    command = [sumo_program("netconvert"), "-n", "nodes.xml", "-e", "edges.xml", "-o", "road.net.xml"]
    subprocess.run(command, check=True, capture_output=True, cwd=folder)
    return (folder / "road.net.xml").read_text()


Speeds = dict[float, dict[str, float]]


def speeds_of_sumo(file: Path, seed: int) -> Speeds:
    """The speed of each vehicle at each time [s], as SUMO alone writes it."""
    written = file.parent / "written.xml"
    command = [sumo_program("sumo"), "-c", str(file), "--seed", str(seed), "--fcd-output", str(written)]
    subprocess.run([*command, "--precision", "6", "--no-warnings"], check=True, capture_output=True)
    return {
        float(step.attrib["time"]): {each.attrib["id"]: float(each.attrib["speed"]) for each in step.iter("vehicle")}
        for step in ElementTree.parse(written).getroot()
    }


def assert_same(file: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> tuple[Speeds, int]:
    """Assert that in all steps the same vehicles drive as fast as in SUMO alone; return speeds and seed."""
    seeds, load = list[int](), simulation.load
    with monkeypatch.context() as patch:
        patch.setattr(simulation, "load", lambda *given: (seeds.append(given[2]), load(*given)))
        road = make_scenario(str(file), {"penetration_rate": 0.3, "cav_classes": ["passenger", "bus"]})
        episode = run_episode(road, Human(), (0,), backend=SumoBackend(simulation))
    expected = speeds_of_sumo(file, seeds[0])
    begin, compared = min(expected), 0
    for time, there in expected.items():
        row = round((time - begin) / episode.control_step)
        if row < len(episode.speeds):
            found = dict(zip(episode.vehicle_ids, episode.speeds[row], strict=True))
            found = {name: speed for name, speed in found.items() if not np.isnan(speed)}
            assert found == pytest.approx(there, abs=1e-5)
            compared += 1
    assert compared >= len(expected) - 1 > 20
    return expected, seeds[0]


PLAIN = f"<routes>{TYPE}{ROUTE}{FLOW}</routes>"
SIGN = '<step time="0" speed="6"/>'
TRIPS = '<flow id="t" type="car" from="ab" to="bc" begin="0" end="90" period="5"/>'
CALIBRATED = '<flow route="short" type="car" begin="0" end="120" vehsPerHour="900" speed="9"/>'
BUS = """
<vType id="bus" vClass="bus"/><vehicle id="bus" type="bus" route="short" depart="0" line="7">
<stop busStop="stop" duration="10"/></vehicle>
<person id="p" depart="0"><stop edge="ab" duration="5"/><walk edges="ab" busStop="stop"/>
<ride to="bc" lines="7"/></person>
<container id="c" depart="1"><tranship edges="ab" arrivalPos="100"/></container>
"""
ZONED = '<flow id="t" type="car" fromTaz="west" toTaz="east" begin="0" end="90" period="5"/>'

Files = dict[str, str | bytes]
FORMS: dict[str, tuple[Files, str]] = {
    "options by their letters": ({"r.xml": PLAIN}, '<r v="r.xml"/><b value="3"/>'),
    "options by other names": ({"r.xml": PLAIN}, '<input><routes value="r.xml"/></input>'),
    "a list": (
        {"types.xml": f"<routes>{TYPE}</routes>", "my routes.xml": f"<routes>{ROUTE}{FLOW}</routes>"},
        '<route-files value=" types.xml ,\n my routes.xml"/>',
    ),
    "an environment variable": ({"deep/r.xml": PLAIN}, '<route-files value="${DEEP}/r.xml"/>'),
    "the folder of the user": ({"deep/r.xml": PLAIN}, '<route-files value="~/deep/r.xml"/>'),
    "a percent sign": ({"my r.xml": PLAIN}, '<route-files value="my%20r.xml"/>'),
    "gzip": ({"r.xml": gzip.compress(PLAIN.encode())}, '<route-files value="r.xml"/>'),
    "gzip in parts": (
        {"r.xml": gzip.compress(PLAIN[:50].encode()) + gzip.compress(PLAIN[50:].encode())},
        '<route-files value="r.xml"/>',
    ),
    "zlib": ({"r.xml": zlib.compress(PLAIN.encode())}, '<route-files value="r.xml"/>'),
    "no gzip": ({"r.xml.gz": PLAIN}, '<route-files value="r.xml.gz"/>'),
    "a byte-order mark": ({"r.xml": PLAIN.encode("utf-8-sig")}, '<route-files value="r.xml"/>'),
    "UTF-16": ({"r.xml": PLAIN.encode("utf-16")}, '<route-files value="r.xml"/>'),
    "Latin-1": (
        {"r.xml": f"<?xml version='1.0' encoding='iso-8859-1'?><!-- \xe9 -->{PLAIN}".encode("latin-1")},
        '<route-files value="r.xml"/>',
    ),
    "included files": (
        {
            "r.xml": f'<routes><include href="deep/types.xml"/>{ROUTE}<include href="flow.xml"/></routes>',
            "deep/types.xml": '<routes><include href="more/car.xml"/></routes>',
            "deep/more/car.xml": f"<routes>{TYPE}</routes>",
            "flow.xml": f"<additional>{FLOW}</additional>",
        },
        '<route-files value="r.xml"/>',
    ),
    "an additional file that includes": (
        {"a.xml": '<additional><include href="r.xml"/></additional>', "r.xml": PLAIN},
        '<additional-files value="a.xml"/>',
    ),
    "a variable speed sign in a file": (
        {
            "r.xml": PLAIN,
            "a.xml": '<add><variableSpeedSign id="v" lanes="bc_0" file="deep/v.xml"/></add>',
            "deep/v.xml": f"<vss>{SIGN}</vss>",
        },
        '<route-files value="r.xml"/><additional-files value="a.xml"/>',
    ),
    "a calibrator in a file": (
        {
            "r.xml": "<routes/>",
            "a.xml": f'<add>{TYPE}{ROUTE}<calibrator id="c" edge="ab" pos="0" file="c.xml"/>{FLOW}</add>',
            "c.xml": f"<calibrator>{CALIBRATED}</calibrator>",
        },
        '<route-files value="r.xml"/><additional-files value="a.xml"/>',
    ),
    "a rerouter": (
        {
            "r.xml": PLAIN,
            "a.xml": '<add><rerouter id="r" edges="ab" file="unused.xml"><interval begin="0" end="60">'
            '<closingReroute id="bc"/></interval></rerouter></add>',
        },
        '<route-files value="r.xml"/><additional-files value="a.xml"/>',
    ),
    "travel times of edges": (
        {
            "r.xml": f"<routes>{TYPE}{TRIPS}</routes>",
            "w.xml": '<weights><interval begin="0" end="999"><edge id="bc" traveltime="900"/></interval></weights>',
        },
        '<route-files value="r.xml"/><weight-files value="w.xml"/>',
    ),
    "types of a distribution by reference": (
        {
            "r.xml": f'<routes>{TYPE}<vType id="slow" maxSpeed="7"/><vTypeDistribution id="mix">'
            '<vType refId="car" probability="0.5"/><vType refId="slow" probability="0.5"/>'
            f"</vTypeDistribution>{ROUTE}{FLOW.replace('car', 'mix')}</routes>"
        },
        '<route-files value="r.xml"/>',
    ),
    "a distribution of routes": (
        {
            "r.xml": f"<routes>{TYPE}"
            '<routeDistribution id="short"><route id="1" edges="ab bc" probability="1"/>'
            f'<route id="2" edges="ab bd dc" probability="2"/></routeDistribution>{FLOW}</routes>'
        },
        '<route-files value="r.xml"/>',
    ),
    "trips between zones": (
        {
            "r.xml": f"<routes>{TYPE}{ZONED}</routes>",
            "a.xml": '<tazs><taz id="west" edges="ab"/><taz id="east" edges="bc"/></tazs>',
        },
        '<route-files value="r.xml"/><additional-files value="a.xml"/>',
    ),
    "a bus with passengers": (
        {
            "r.xml": f"<routes>{ROUTE}{BUS}</routes>",
            "a.xml": '<add><busStop id="stop" lane="ab_0" startPos="200" endPos="220"/></add>',
        },
        '<route-files value="r.xml"/><additional-files value="a.xml"/>',
    ),
    "an option without a value": (
        {"r.xml": PLAIN},
        '<route-files value="r.xml"/><load-state value=""/><begin value=""/>',
    ),
}
OPTIONS = {
    "begin": "0:00:05",
    "scale": "1.5",
    "step-length": "0.5",
    "default.speeddev": "0.4",
    "default.action-step-length": "2",
    "default.carfollowmodel": "IDM",
    "carfollow.model": "EIDM",
    "random-depart-offset": "9",
    "max-num-vehicles": "4",
    "default.departspeed": "5",
    "default.departlane": "random",
    "step-method.ballistic": "true",
    "thread-rngs": "3",
    "extrapolate-departpos": "true",
}
"""options that change what SUMO simulates, with values that are not its defaults"""


def write(folder: Path, network: str, files: Files, inside: str, end: float = 60.0) -> Path:
    """Write a configuration of this network and these files."""
    for name, content in {"road.net.xml": network, **files}.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    path = folder / "mine.sumocfg"
    path.write_text(f'<configuration>{NETWORK}{inside}<e value="{end:g}"/></configuration>')
    return path


@pytest.mark.parametrize("form", FORMS)
def test_files_in_every_form_that_sumo_reads_give_its_traffic(
    form: str, network: str, tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEEP", "deep")
    monkeypatch.setenv("HOME", str(tmp_path))
    path = write(tmp_path, network, *FORMS[form])
    speeds, _ = assert_same(path, simulation, monkeypatch)
    assert sum(map(len, speeds.values())) > 40


def test_a_compressed_network_below_a_variable_folder_gives_the_traffic_of_sumo(
    network: str, tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name of the network does not end in .gz, and the configuration names its folder by `${DEEP}`."""
    monkeypatch.setenv("DEEP", "deep")
    path = write(tmp_path, network, {"r.xml": PLAIN}, '<route-files value="r.xml"/>')
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep/road.net.xml").write_bytes(gzip.compress(network.encode()))
    (tmp_path / "road.net.xml").unlink()
    path.write_text(path.read_text().replace("road.net.xml", "${DEEP}/road.net.xml"))
    assert_same(path, simulation, monkeypatch)
    assert read_lanes(tmp_path / "deep/road.net.xml")


@pytest.mark.parametrize("name", OPTIONS)
def test_options_that_change_the_traffic_change_it_as_in_sumo(
    name: str, network: str, tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    files: Files = {"r.xml": f"<routes>{TYPE}{ROUTE}{FLOW}{TRIPS}</routes>"}
    inside = '<route-files value="r.xml"/>'
    plain = write(tmp_path / "plain", network, files, inside)
    option = f'<processing><{name} value="{OPTIONS[name]}"/></processing>'
    path = write(tmp_path / "changed", network, files, inside + option)
    speeds, seed = assert_same(path, simulation, monkeypatch)
    assert speeds != speeds_of_sumo(plain, seed)


def test_a_changed_included_file_is_copied_again(
    network: str, tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, inside = FORMS["included files"]
    path = write(tmp_path, network, files, inside)
    before, _ = assert_same(path, simulation, monkeypatch)
    (tmp_path / "deep/more/car.xml").write_text(TYPE.replace("/>", ' maxSpeed="3"/>'))
    after, _ = assert_same(path, simulation, monkeypatch)
    assert max(max(each.values(), default=0) for each in after.values()) <= 3 + 1e-6
    assert before != after


def test_an_episode_without_vehicles_is_an_error(network: str, tmp_path: Path, sumo: SumoBackend) -> None:
    files: Files = {"r.xml": f"<routes>{TYPE}{ROUTE}{FLOW.replace('90', '9')}</routes>"}
    path = write(tmp_path, network, files, '<route-files value="r.xml"/><begin value="20"/>')
    with pytest.raises(InputError, match="no vehicle entered before 60 s; the first departs at 0 s; use --begin 0"):
        run_episode(make_scenario(str(path), {"penetration_rate": 0.3}), Human(), (0,), backend=sumo)
