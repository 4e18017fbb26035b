"""CLAIMS.md is what its generator makes of the results and the settings."""

import sys
from importlib import import_module
from typing import Any

import numpy as np
import pytest

from tests.system.conftest import ROOT
from unjam_paper.studies import STUDIES


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the generator, with the modules of the documentation."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    for name in ("claims", "differences", "people", "studies", "tables", "verdicts"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return import_module("claims")


def test_the_page_of_claims_is_that_of_the_results_with_a_row_for_each_claim(
    claims: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    tables = claims.claims_tables()
    monkeypatch.setattr(claims, "claims_tables", lambda: tables)
    assert (ROOT / "CLAIMS.md").read_text() == claims.page_text(), "run: python docs/claims.py"
    for heading, listed in claims.CLAIMS.items():
        assert len(tables[heading]) == (len(listed) or len(claims.people_claims()))
    rows = [row for table in tables.values() for row in table.to_dict("records")]
    assert {row["command"].strip("`").removeprefix("unjam reproduce ") for row in rows} <= set(STUDIES)
    unmeasured = [row for row in rows if row["verdict"] == claims.NOT_MEASURED]
    assert all(row["we get, without the filter"] == "–" for row in unmeasured)


def test_each_setting_in_which_presets_differ_has_a_row_in_the_table_of_differences(claims: Any) -> None:
    assert sys.modules[claims.differences_table.__module__].unlisted_settings() == []


@pytest.mark.parametrize(
    ("others", "verdict", "decisive"),
    [
        ({"a": [1.0, 2.0, 3.0], "b": [2.0, 3.0, 4.1]}, "held", "b"),
        ({"a": [1.0, 2.0, 3.0], "b": [9.0, 9.9, 11.0]}, "not held", "b"),
        ({"a": [6.0, 2.0, 8.0], "b": [2.0, 3.0, 4.1]}, "undecided", "a"),
        ({"a": [0.0, 0.0, 0.0]}, "held", ""),
    ],
)
def test_a_claim_is_judged_by_intervals_of_paired_differences(
    claims: Any, others: dict[str, list[float]], verdict: str, decisive: str
) -> None:
    values = {name: np.array(found) for name, found in {"own": [4.0, 5.0, 6.2], **others}.items()}
    found, numbers = claims.compare(values, "own")
    assert found == f"{verdict} (3 trainings)"
    assert f"difference{f' to {decisive}' if decisive else ''} " in numbers
    opposite, _ = claims.compare({name: -each for name, each in values.items()}, "own", larger=False)
    assert opposite == found


def test_trainings_in_two_groups_are_undecided(claims: Any) -> None:
    values = {"own": np.array([9.0, 9.1, 5.0, 5.1]), "other": np.zeros(4)}
    assert claims.compare(values, "own")[0] == "undecided (4 trainings)"
