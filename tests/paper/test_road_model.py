"""The table of environment steps that a road model saves."""

import json
from pathlib import Path

from unjam_paper.comparison import compared_variants, road_model_study


def test_returns_are_compared_after_multiples_of_the_steps(tmp_path: Path) -> None:
    steps, ends = [12_000.0, 756_000.0], [[2000.0], [2000.0], [2000.0]]
    few = {"steps": steps, "return_validation": [[*end, 2063.0] for end in ends]}
    road_model = {"steps": steps, "return_validation": [[*end, 2126.0] for end in ends]}
    many = {"steps": [96_000.0, 6_000_000.0], "return_validation": [[1000.0, value] for value in (2e3, 2e3, 2e3)]}
    double = {"steps": [24_000.0, 1_512_000.0], "return_validation": [[*end, 2100.0] for end in ends]}
    curves = dict(zip(compared_variants("best"), (road_model, few, double, many), strict=True))
    (tmp_path / "curves.json").write_text(json.dumps({"ring": curves}))
    table = road_model_study("ring", "best").tables["efficiency"](tmp_path).set_index("")
    assert table.loc["unjam residual, few steps and road model", "750,000"] == "2125"
    assert table.loc["unjam residual, few steps", "1,500,000"] == "–"
    assert table.loc["unjam residual, all steps", "380,000"] == "–"  # before the first validation
    prefix = "with the model, difference to “unjam residual"
    assert table.loc[f"{prefix}, few steps” after as many", "380,000"] == "+31"
    assert table.loc[f"{prefix}, double steps” after 2 times as many", "750,000"] == "+26"
    assert table.loc[f"{prefix}, all steps” after 3 times as many", "750,000"].startswith("+7")


def test_on_the_on_ramp_both_sizes_of_iterations_are_compared_with_the_model(tmp_path: Path) -> None:
    steps = [28_800.0, 57_600.0, 86_400.0]
    curves = {
        "ramp-road-model": {"steps": steps[:1], "return_validation": [[-2450.0]] * 3},
        "ramp-few": {"steps": steps, "return_validation": [[-2760.0, -2660.0, -2620.0]] * 3},
        "ramp-small": {"steps": steps, "return_validation": [[-2710.0, -2610.0, -2560.0]] * 3},
    }
    (tmp_path / "curves.json").write_text(json.dumps({"on-ramp": curves}))
    table = road_model_study("on-ramp", "ramp").tables["efficiency"](tmp_path).set_index("")
    differences = table["28,800"].tail(6)
    assert list(differences) == ["+310", "+210", "+170", "+260", "+160", "+110"]
    assert differences.index[5] == (
        "with the model, difference to “unjam residual, few steps in small iterations” after 3 times as many"
    )
