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
    values = {name: np.array(series) for name, series in {"own": [4.0, 5.0, 6.2], **others}.items()}
    judged, numbers = claims.compare_values(values, "own")
    assert judged == f"{verdict} (3 trainings)"
    assert f"difference{f' to {decisive}' if decisive else ''} " in numbers
    opposite, _ = claims.compare_values({name: -series for name, series in values.items()}, "own", larger=False)
    assert opposite == judged


def test_trainings_in_two_groups_are_undecided(claims: Any) -> None:
    values = {"own": np.array([9.0, 9.1, 5.0, 5.1]), "other": np.zeros(4)}
    assert claims.compare_values(values, "own")[0] == "undecided (4 trainings)"


def test_two_groups_of_compared_values_leave_a_verdict_open_only_if_the_differences_have_both_signs(
    claims: Any,
) -> None:
    groups = np.array([-41.6, -32.1, -35.6, 11.7, 11.9, 8.4, 10.7, -1.6, -2.1, 1.6])
    own = np.array([8.7, 8.4, 10.4, 10.7, 7.6, 8.0, 7.9, 11.3, 7.4, 9.0])
    assert claims.compare_values({"own": own, "other": groups}, "own")[0] == "undecided (10 trainings)"
    assert claims.compare_values({"own": groups + own, "other": groups}, "own")[0] == "held (10 trainings)"


def test_a_method_that_is_hardly_better_than_its_expert_holds_by_the_expert(claims: Any) -> None:
    version = claims.Version(has_filter=False)
    on_test_seeds = claims.larger_return("proposed-ring", "ring", "proposed", "trpo")(version)
    assert "PI has 99 %" in on_test_seeds[1]
    assert on_test_seeds[0].endswith(claims.BY_EXPERT)
    at_first = claims.curve_extreme("table-1-ring", "ring", claims.VALIDATED, "return", claims.FIRST)(version)
    assert at_first[0].startswith(claims.HELD)
    assert at_first[0].endswith(claims.BY_EXPERT)


def test_returns_that_rise_only_in_training_are_said_to_rise_by_less_exploration(claims: Any) -> None:
    version = claims.Version(has_filter=False)
    trained, validated = (
        claims.late_change("table-1-ring", "ring", "proposed", quantity, "return", larger=True)(version)[0]
        for quantity in claims.RETURNS
    )
    assert trained.endswith(claims.BY_EXPLORATION)
    assert validated.startswith(claims.UNDECIDED)


@pytest.mark.parametrize("has_filter", [True, False])
def test_the_settings_to_the_letter_have_a_verdict_on_each_road(claims: Any, has_filter: bool) -> None:
    listed = [claim for group in claims.CLAIMS.values() for claim in group if claim.study.startswith("to-the-letter")]
    verdicts = {(claim.road, claim.assess(claims.Version(has_filter))[0]) for claim in listed}
    assert {road for road, _ in verdicts} == set(claims.PAPER_ROADS)
    assert ("figure-eight", f"held (5 trainings){claims.BY_EXPERT}") in verdicts


def test_a_stated_multiple_of_a_time_is_judged_for_each_learner(claims: Any) -> None:
    version = claims.Version(has_filter=False)
    verdicts = [claims.training_time(*claim)(version)[0] for claim in (("trpo", 1.37), ("ppo", 0.954), ("sac", 0.954))]
    assert verdicts == ["not held (3 rounds)", "undecided (3 rounds)", "held (3 rounds)"]
