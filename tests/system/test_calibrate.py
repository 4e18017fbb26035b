"""`unjam calibrate` as a user calls it, and the verbs that drive on what it writes."""

import json
from pathlib import Path

import pytest

from tests.system.conftest import Run
from tests.worlds.sumo.user_networks import straight

PEOPLE = '<flow id="f" type="car" route="along" begin="0" end="60" period="5" departSpeed="max"/>'
ROWS = ["lane,position,begin,end,flow_veh_per_h,speed", "road_0,100,0,30,480,15", "road_0,100,30,60,600,"]
CALIBRATE = ["calibrate", "straight.sumocfg", "--detectors", "detectors.csv", "--trials", 2, "--seeds", 1]


@pytest.fixture
def files(tmp_path: Path) -> None:
    straight(tmp_path, PEOPLE)
    (tmp_path / "detectors.csv").write_text("\n".join(ROWS))


@pytest.mark.long
@pytest.mark.usefixtures("files")
def test_calibrate_writes_a_network_that_other_verbs_drive(unjam: Run, tmp_path: Path) -> None:
    ran = unjam(*CALIBRATE, "--out", "found")
    assert ran.returncode == 0, ran.stderr
    for words in ("mean GEH", "error of speed (RMSE)", "original", "calibrated", "tau x "):
        assert words in ran.stdout
    assert "assess it: unjam assess found/calibrated.sumocfg" in ran.stderr
    assert {"calibrated.sumocfg", "0.rou.xml", "calibration.json"} <= {
        path.name for path in (tmp_path / "found").iterdir()
    }
    drive = ("drive", "found/calibrated.sumocfg", "--cav-share", "0.2", "-d", "acc", "-n", 1, "--no-report")
    driven = unjam(*drive, "--json")
    assert driven.returncode == 0, driven.stderr
    assert json.loads(driven.stdout)["episodes"][0]["status"] == "completed"
    again = unjam(*CALIBRATE, "--out", "found", "--json")  # goes on, and finds the same
    assert again.returncode == 0, again.stderr
    found = json.loads(again.stdout)
    assert found["file"] == "found/calibrated.sumocfg"
    assert set(found["agreement"]["geh"]) == {"original", "calibrated", "difference"}
