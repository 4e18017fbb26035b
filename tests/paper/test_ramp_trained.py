"""Does the on-ramp's page say of trainings what they are beyond tuned laws and people alone?"""

from pathlib import Path

import numpy as np
import pytest

from unjam.files import to_json
from unjam_paper.on_ramp import HUMAN_LABEL, LONGER_LABEL, ON_RAMP_DRIVERS, TUNED_LABEL, on_ramp_study


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    generator = np.random.default_rng(0)
    times = (
        dict.fromkeys(ON_RAMP_DRIVERS, 150.0)
        | {TUNED_LABEL: 128.0, LONGER_LABEL: 127.0}
        | {f"best {seed}": 125.0 for seed in range(10)}
    )
    seeds = generator.normal(0.0, 10.0, 40)
    found = {
        label: {
            "drivable": "drivable" if label != "best 3" else "follows below 0.8 s",
            "episodes": [
                {"travel_time": time + seed, "outflow_veh_per_h": 3900.0 - time, "min_time_gap": 0.9}
                | {"people_beyond_4_5": 2.0}
                for seed in seeds + generator.normal(0.0, 1.0, 40)
            ],
        }
        for label, time in times.items()
    }
    (tmp_path / "ramp.json").write_text(to_json(found))
    return tmp_path


def test_trainings_are_one_row_beside_their_expert_and_people(folder: Path) -> None:
    table = on_ramp_study({"best": "residual"}).tables["ramp"](folder).set_index("driver")
    assert list(table.index) == [*ON_RAMP_DRIVERS, "residual, 10 trainings"]
    row = table.loc["residual, 10 trainings"]
    for law, gain in ((TUNED_LABEL, -3.0), (LONGER_LABEL, -2.0)):
        low, high = map(float, row[f"beyond {law} [s]"].partition("[")[2].rstrip("]").split(", "))
        assert low < gain < high < gain + 1.0
    assert row["beyond people [s]"].startswith("-2")
    assert row["flow beyond people [veh/h]"].startswith("+25")
    assert row["drivable"] == "9 of 10"
    assert table.loc[LONGER_LABEL, "drivable"] == "yes"
    assert table.loc[TUNED_LABEL, f"beyond {TUNED_LABEL} [s]"] == "–"
    assert table.loc[HUMAN_LABEL, "smallest headway [s]"] == "–"
