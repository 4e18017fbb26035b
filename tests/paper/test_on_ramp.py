"""The table of studies on the on-ramp."""

from pathlib import Path

import numpy as np
import pytest

from unjam.files import to_json
from unjam_paper.feasible import HUMAN_LABEL, LARGER_BUDGET_LABEL, ON_RAMP_DRIVERS, ON_RAMP_TUNED_LABEL, on_ramp_study


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    generator = np.random.default_rng(0)
    times = (
        dict.fromkeys(ON_RAMP_DRIVERS, 150.0)
        | {ON_RAMP_TUNED_LABEL: 128.0, LARGER_BUDGET_LABEL: 127.0}
        | {f"best {seed}": 125.0 for seed in range(10)}
    )
    seeds = generator.normal(0.0, 10.0, 40)
    found = {
        label: {
            "feasibility": "feasible" if label != "best 3" else "time gap 0.70 s (limit 0.8 s)",
            "episodes": [
                {"travel_time": time + seed, "outflow_veh_per_h": 3900.0 - time, "min_time_gap": 0.9}
                | {"human_braking_beyond_4_5": 2.0}
                for seed in seeds + generator.normal(0.0, 1.0, 40)
            ],
        }
        for label, time in times.items()
    }
    (tmp_path / "on-ramp.json").write_text(to_json(found))
    return tmp_path


def test_all_trainings_have_one_row_with_differences_to_experts_and_baseline(folder: Path) -> None:
    table = on_ramp_study({"best": "residual"}).tables["on-ramp"](folder).set_index("driver")
    assert list(table.index) == [*ON_RAMP_DRIVERS, "residual, 10 trainings"]
    row = table.loc["residual, 10 trainings"]
    for expert, gain in ((ON_RAMP_TUNED_LABEL, -3.0), (LARGER_BUDGET_LABEL, -2.0)):
        low, high = map(float, row[f"difference to {expert} [s]"].partition("[")[2].rstrip("]").split(", "))
        assert low < gain < high < gain + 1.0
    assert row["difference to human baseline [s]"].startswith("-2")
    assert row["flow, difference to human baseline [veh/h]"].startswith("+25")
    assert row["feasible"] == "9 of 10"
    assert table.loc[LARGER_BUDGET_LABEL, "feasible"] == "yes"
    assert table.loc[ON_RAMP_TUNED_LABEL, f"difference to {ON_RAMP_TUNED_LABEL} [s]"] == "–"
    assert table.loc[HUMAN_LABEL, "min time gap [s]"] == "–"
