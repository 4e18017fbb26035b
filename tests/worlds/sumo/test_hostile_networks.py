"""Files of others that want SUMO to write, to listen or to read elsewhere: it simulates, and nothing more."""

import gzip
import json
import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import psutil
import pytest

import unjam
from tests.worlds.sumo.user_networks import game, straight
from tests.worlds.test_record import fingerprint
from unjam.drivers import IDM
from unjam.scenarios import make_scenario
from unjam.scenarios.user_network import _log_once
from unjam.sumo_files import PASSED_OPTIONS, is_passed_option, read_sumo_files
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend
from unjam.worlds.sumo.networks import sumo_program
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.worker_pool import EpisodeTask, WorkerPool

COLUMN = "".join(
    f'<vehicle id="{number}" type="{"van" if number % 3 == 1 else "car"}" route="along" depart="0" '
    f'departPos="{place}" departSpeed="10"/>'
    for number, place in enumerate((400, 340, 310, 180, 60))
)
WRITING = """
<additional xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
  <edgeData id="a" file="CANARY" period="1"/>
  <laneData id="b" file="CANARY" period="1"/>
  <e1Detector id="c" lane="road_0" pos="500" period="1" file="CANARY"/>
  <inductionLoop id="d" lane="road_0" pos="500" period="1" file="CANARY"/>
  <instantInductionLoop id="e" lane="road_0" pos="500" file="CANARY"/>
  <laneAreaDetector id="f" lane="road_0" pos="400" endPos="600" period="1" file="CANARY"/>
  <entryExitDetector id="g" period="1" file="CANARY">
    <detEntry lane="road_0" pos="300"/><detExit lane="road_0" pos="500"/>
  </entryExitDetector>
  <vTypeProbe id="h" type="" period="1" file="CANARY"/>
  <routeProbe id="i" edge="road" period="1" file="CANARY"/>
  <timedEvent type="SaveTLSStates" source="all" dest="CANARY"/>
  <calibrator id="j" edge="road" pos="0" output="CANARY">
    <flow begin="0" end="60" speed="20"/>
  </calibrator>
  <include href="more.add.xml"/>
</additional>
"""
NESTED = '<additional><edgeData id="nested" file="CANARY" period="1"/></additional>'
SPIES = """
<vType id="spy">
  <param key="has.ssm.device" value="true"/><param key="device.ssm.file" value="CANARY"/>
  <param key="device.toc.file" value="CANARY"/>
</vType>
"""
SPIED = """
<vehicle id="s" type="spy" route="along" depart="1"/>
"""
OPTIONS = (
    *("tripinfo-output", "summary", "fcd-output", "netstate-dump", "vehroute-output", "collision-output"),
    *("emission-output", "statistic-output", "log", "message-log", "error-log", "save-configuration"),
    *("save-template", "save-state.files", "device.ssm.file", "device.toc.file", "device.rerouting.output"),
    *("edgedata-output", "pedestrian.jupedsim.py"),
)
CONTENT = "as it was"


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A road: every file of it writes to `canary`, and its configuration opens a port."""
    path, canary = straight(tmp_path, COLUMN), tmp_path / "canary"
    canary.write_text(CONTENT)
    demand = tmp_path / "demand.rou.xml"
    demand.write_text(
        demand.read_text().replace("<route ", f"{SPIES}<route ", 1).replace("</routes>", f"{SPIED}</routes>")
    )
    network = tmp_path / "road.net.xml"
    inside = '<e1Detector id="n" lane="road_0" pos="9" period="1" file="CANARY"/></net>'
    network.write_text(network.read_text().replace("</net>", inside))
    (tmp_path / "outputs.add.xml").write_text(WRITING)
    (tmp_path / "more.add.xml").write_text(NESTED)
    wanted = "".join(f'<{name} value="CANARY"/>' for name in OPTIONS)
    wanted += '<additional-files value="outputs.add.xml"/><remote-port value="PORT"/><num-clients value="1"/>'
    wanted += '<save-state.times value="1,2"/><device.ssm.probability value="1"/>'
    path.write_text(path.read_text().replace("</configuration>", f"{wanted}</configuration>"))
    for file in (demand, network, tmp_path / "outputs.add.xml", tmp_path / "more.add.xml", path):
        file.write_text(file.read_text().replace("CANARY", str(canary)).replace("PORT", "45871"))
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def listening() -> list[int]:
    return [one.laddr.port for one in psutil.Process().net_connections() if one.status == "LISTEN"]


def test_nothing_is_written_and_nothing_listens(
    hostile: Path, tmp_path: Path, simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)  # outputs may have names of their own
    before = contents(tmp_path)
    scenario = make_scenario(str(hostile), {"penetration_rate": 0.5, "horizon": 100})
    episode = run_episode(scenario, IDM(), (0,), backend=SumoBackend(simulation))
    assert listening() == []
    simulation.close()  # outputs are written at the end at last
    assert (episode.status, episode.control_steps) == ("completed", 100)
    assert (tmp_path / "canary").read_text() == CONTENT
    assert contents(tmp_path) == before


def test_nothing_is_written_in_a_worker(hostile: Path, tmp_path: Path) -> None:
    before = contents(tmp_path)
    scenario = make_scenario(str(hostile), {"penetration_rate": 0.5, "horizon": 100})
    with WorkerPool(1) as workers:
        (episode,) = workers.run([EpisodeTask(scenario, IDM(), (0,))])
    assert episode.status == "completed"
    assert contents(tmp_path) == before


def test_dropped_items_are_reported_once_in_one_line(hostile: Path, caplog: pytest.LogCaptureFixture) -> None:
    _log_once.cache_clear()
    for _ in range(2):
        make_scenario(str(hostile), {"penetration_rate": 0.5})
    (line,) = [record.getMessage() for record in caplog.records]
    words = r"straight\.sumocfg: left out because they only write or listen: option tripinfo-output, .* and \d+ more"
    assert re.fullmatch(words, line)
    dropped = read_sumo_files(hostile).dropped_items
    assert {"option remote-port", "file of e1Detector", "edgeData", "parameter device.ssm.file"} <= {*dropped}


@pytest.mark.long
def test_dropped_items_are_in_results_and_report(hostile: Path, tmp_path: Path) -> None:
    road, out = {"horizon": 20, "penetration_rate": 0.5}, tmp_path / "out"
    found = unjam.drive(str(hostile), ["human"], 1, scenario_options=road, workers=1, out=out)
    (note,) = [each for each in found.notes if "left out" in each]
    assert note.startswith("straight.sumocfg: left out because they only write or listen: option tripinfo-output")
    assert note in json.loads((out / "evaluation.json").read_text())["notes"]
    assert "left out because they only write or listen" in (out / "report.html").read_text()


def test_harmless_files_are_read_without_a_copy_or_message(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    found = read_sumo_files(straight(tmp_path, COLUMN))
    make_scenario(str(found.path), {"penetration_rate": 0.5})
    assert (found.dropped_items, found.replaced_options, found.copy_sources, caplog.records) == ((), (), {}, [])


@pytest.mark.long
def test_dropped_outputs_change_no_vehicle(tmp_path: Path, sumo: SumoBackend) -> None:
    plain, noted = (tmp_path / name for name in ("plain", "noted"))
    episodes = []
    for folder in (plain, noted):
        folder.mkdir()
        path = straight(folder, COLUMN)
        if folder is noted:
            path.write_text(path.read_text().replace("<end ", '<additional-files value="outputs.add.xml"/><end '))
            (folder / "more.add.xml").write_text(NESTED)
            without = re.sub("<calibrator.*</calibrator>", "", WRITING, flags=re.DOTALL)
            (folder / "outputs.add.xml").write_text(without.replace("CANARY", str(tmp_path / "canary")))
        scenario = make_scenario(str(path), {"penetration_rate": 0.5, "horizon": 200})
        episode = run_episode(scenario, IDM(), (0,), backend=sumo)
        episodes.append(replace(episode, warnings=()))  # detectors warn of vehicles that miss them
    assert fingerprint(episodes[0]) == fingerprint(episodes[1])
    assert not (tmp_path / "canary").exists()


@pytest.mark.long
def test_options_and_files_that_only_simulate_are_used(tmp_path: Path, sumo: SumoBackend) -> None:
    path = straight(tmp_path, COLUMN)
    scenario = make_scenario(str(path), {"cav_types": ["van"], "horizon": 200})
    fast = run_episode(scenario, IDM(), (0,), backend=sumo)
    sign = '<variableSpeedSign id="v" lanes="road_0"><step time="0" speed="11"/></variableSpeedSign>'
    (tmp_path / "slow.add.xml").write_text(f"<additional>{sign}</additional>")
    inside = "<additional-files value='slow.add.xml'/><time-to-teleport value='50'/><end "
    path.write_text(path.read_text().replace("<end ", inside))
    assert read_sumo_files(path).options == {"end": "60.0", "time-to-teleport": "50"}
    slow = run_episode(scenario, IDM(), (0,), backend=sumo)
    assert np.nanmean(slow.speeds) < 12 < np.nanmean(fast.speeds)


@pytest.mark.long
def test_folders_with_blanks_and_commas_give_the_same_traffic(tmp_path: Path, sumo: SumoBackend) -> None:
    episodes = []
    for name in ("plain", "with a blank, a comma; and $HOME"):
        (tmp_path / name).mkdir()
        scenario = make_scenario(str(straight(tmp_path / name, COLUMN)), {"penetration_rate": 0.5, "horizon": 50})
        episode = run_episode(scenario, IDM(), (0,), backend=sumo)
        episodes.append(replace(episode, warnings=()))  # detectors warn of vehicles that miss them
    assert fingerprint(episodes[0]) == fingerprint(episodes[1])


@pytest.mark.long
def test_compressed_and_strangely_encoded_files_are_copied(tmp_path: Path, sumo: SumoBackend) -> None:
    path = straight(tmp_path, COLUMN)
    scenario = make_scenario(str(path), {"penetration_rate": 0.5, "horizon": 50})
    plain = run_episode(scenario, IDM(), (0,), backend=sumo)
    demand, network = tmp_path / "demand.rou.xml", tmp_path / "road.net.xml"
    demand.write_bytes(f"<?xml version='1.0' encoding='utf-16'?>{demand.read_text()}".encode("utf-16"))
    (tmp_path / "road.net.xml.gz").write_bytes(gzip.compress(network.read_bytes()))
    path.write_text(path.read_text().replace("road.net.xml", "road.net.xml.gz"))
    assert read_sumo_files(path).copy_sources.keys() == {demand, tmp_path / "road.net.xml.gz"}
    assert fingerprint(run_episode(scenario, IDM(), (0,), backend=sumo)) == fingerprint(plain)


@pytest.mark.parametrize("name", ["default namespace", "signal that writes", "swarm that writes"])
def test_hidden_outputs_are_found(name: str, tmp_path: Path) -> None:
    path = straight(tmp_path, COLUMN)
    (tmp_path / "hidden.add.xml").write_text(
        {
            "default namespace": '<additional xmlns="u:x"><edgeData id="a" file="CANARY"/></additional>',
            "signal that writes": '<add><tlLogic><param key="file" value="x"/></tlLogic></add>',
            "swarm that writes": '<add><tlLogic><param key="SWARMLOG" value="x"/></tlLogic></add>',
        }[name]
    )
    path.write_text(path.read_text().replace("<end ", '<additional-files value="hidden.add.xml"/><end '))
    found = read_sumo_files(path)
    assert found.copy_sources.keys() == {tmp_path / "hidden.add.xml"}
    assert found.dropped_items in (("edgeData",), ("parameter file",), ("parameter SWARMLOG",))


def test_an_option_value_that_looks_like_an_option_is_a_value(tmp_path: Path, sumo: SumoBackend) -> None:
    path = straight(tmp_path, COLUMN)
    sly = "<scale-suffix value='--log=canary'/><end "
    path.write_text(path.read_text().replace("<end ", sly))
    before = contents(tmp_path)
    scenario = make_scenario(str(path), {"penetration_rate": 0.5, "horizon": 20})
    assert run_episode(scenario, IDM(), (0,), backend=sumo).status == "completed"
    assert contents(tmp_path) == before
    assert not Path("canary").exists()


def test_no_option_that_is_passed_names_a_file_or_is_an_output(tmp_path: Path) -> None:
    template = tmp_path / "template.xml"
    subprocess.run([sumo_program("sumo"), "--save-template", str(template)], check=True, capture_output=True)
    known = set()
    for group in ElementTree.parse(template).getroot():
        for option in group:
            known.add(option.tag)
            if is_passed_option(option.tag):
                assert option.get("type") != "FILE", option.tag
                assert group.tag not in ("output", "report", "traci_server", "gui_only"), option.tag
    assert known >= PASSED_OPTIONS


def test_sumos_games_run_without_their_outputs(tmp_path: Path, sumo: SumoBackend) -> None:
    path = game(tmp_path, "cross")
    before = contents(tmp_path)
    scenario = make_scenario(str(path), {"penetration_rate": 0.3, "horizon": 50})
    assert read_sumo_files(path).dropped_items == ("edgeData", "osgFile of vType", "timedEvent")
    assert run_episode(scenario, IDM(), (0,), backend=sumo).status == "completed"
    assert contents(tmp_path) == before
    assert not {"netstate.xml", "tlsstate.xml"} & set(os.listdir())
