"""`unjam calibrate` writes a network that other commands accept."""

import json
from pathlib import Path

import pytest

from tests.system.conftest import Run
from tests.worlds.sumo.user_networks import straight

DEMAND = '<flow id="f" type="car" route="along" begin="0" end="60" period="5" departSpeed="max"/>'
ROWS = ["lane,position,begin,end,flow_veh_per_h,speed", "road_0,100,0,30,480,15", "road_0,100,30,60,600,"]
CALIBRATE = ["calibrate", "straight.sumocfg", "--detectors", "detectors.csv", "--trials", 2, "--seeds", 1]


@pytest.fixture
def files(tmp_path: Path) -> None:
    straight(tmp_path, DEMAND)
    (tmp_path / "detectors.csv").write_text("\n".join(ROWS))


@pytest.mark.slow
@pytest.mark.usefixtures("files")
def test_calibrate_writes_a_network_for_other_commands(unjam: Run, tmp_path: Path) -> None:
    ran = unjam(*CALIBRATE, "--out", "result")
    assert ran.returncode == 0, ran.stderr
    for text in ("mean GEH", "speed error (RMSE)", "original", "calibrated", "tau x "):
        assert text in ran.stdout
    assert "assess it: unjam assess result/calibrated.sumocfg" in ran.stderr
    assert {"calibrated.sumocfg", "0.rou.xml", "calibration.json"} <= {
        path.name for path in (tmp_path / "result").iterdir()
    }
    drive = ("drive", "result/calibrated.sumocfg", "--penetration-rate", "0.2", "-d", "acc", "-n", 1, "--no-report")
    driven = unjam(*drive, "--json")
    assert driven.returncode == 0, driven.stderr
    assert json.loads(driven.stdout)["drivers"][0]["episodes"][0]["status"] == "completed"
    again = unjam(*CALIBRATE, "--out", "result", "--json")  # continues, with the same result
    assert again.returncode == 0, again.stderr
    result = json.loads(again.stdout)
    assert result["file"] == "result/calibrated.sumocfg"
    assert set(result["agreement"]["geh"]) == {"original", "calibrated", "difference"}
