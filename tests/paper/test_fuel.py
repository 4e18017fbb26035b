"""Fuel by two emission models."""

import json
from pathlib import Path

import pytest

from unjam_paper import fuel
from unjam_paper.fuel import EMISSION_CLASSES, FUEL_DRIVERS, FUEL_PART, fuel_table, measure_fuel


def test_idle_engines_of_one_model_burn_twice_as_much_as_those_of_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuel, "FUEL_SEEDS", 2)
    monkeypatch.setitem(FUEL_DRIVERS, "ring", ("human", "pi"))
    parts = {
        f"ring, {model}": measure_fuel("ring", emission_class, ("human", "pi"), 1)
        for model, emission_class in EMISSION_CLASSES.items()
    }
    rates = [rows[0]["idle_rate"] for rows in parts.values()]
    assert rates == pytest.approx([2.23, 1.05], abs=0.01)
    (tmp_path / f"{FUEL_PART}.json").write_text(json.dumps(parts))
    table = fuel_table("ring", tmp_path).set_index("")
    assert list(table.index) == ["human", "pi"]
    assert float(table.loc["pi", "HBEFA4, idling at 2.2 l/h"]) < float(table.loc["pi", "HBEFA4 [ml/km]"])
    assert table.loc["human", "PHEMlight, difference"] == "–"
