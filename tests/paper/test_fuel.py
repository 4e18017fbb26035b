"""Fuel by two emission models."""

from pathlib import Path

import pytest

from unjam_paper import fuel
from unjam_paper.fuel import EMISSION_CLASSES, FUEL, FUEL_DRIVERS, fuel_table, measure_fuel
from unjam_paper.results_file import read_part, write_part
from unjam_paper.study import StudyFolder


@pytest.mark.long
def test_idle_engines_of_one_model_burn_twice_as_much_as_those_of_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuel, "FUEL_SEEDS", 2)
    monkeypatch.setitem(FUEL_DRIVERS, "ring", ("human", "pi"))
    for model, emission_class in EMISSION_CLASSES.items():
        write_part(tmp_path, f"ring, {model}", measure_fuel("ring", emission_class, ("human", "pi"), 1))
    rates = [read_part(tmp_path, f"ring, {model}")[0]["idle_rate"] for model in EMISSION_CLASSES]
    assert rates == pytest.approx([2.23, 1.05], abs=0.01)
    assert set(FUEL.make_parts(StudyFolder(tmp_path), 1)) >= {f"ring, {model}" for model in EMISSION_CLASSES}
    table = fuel_table("ring", tmp_path).set_index("")
    assert list(table.index) == ["human", "pi"]
    assert float(table.loc["pi", "HBEFA4, idling at 2.2 l/h"]) < float(table.loc["pi", "HBEFA4 [ml/km]"])
    assert table.loc["human", "PHEMlight, difference"] == "–"
