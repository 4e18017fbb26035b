"""A few faults of each kind do no harm; `make soak` injects thousands of them."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.faults.limits import can_run_as_others
from tests.faults.registry import FAULTS
from tests.test_sandbox import kept
from unjam_paper.results_file import read_part

MARKS = {True: [pytest.mark.slow], False: []}
REQUIREMENTS = {
    "sandbox": kept,
    "other users": pytest.mark.skipif(not can_run_as_others(), reason="needs root, and Python outside its home"),
}
"""condition under which the kernel supports a fault"""
SOAK = Path(__file__).parents[2] / "results" / "soak.json"


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[*MARKS[fault.is_slow], *([REQUIREMENTS[name]] if name in REQUIREMENTS else [])])
        for name, fault in FAULTS.items()
    ],
)
def test_a_fault_does_no_harm(name: str, tmp_path: Path) -> None:
    fault = FAULTS[name]
    outcome = fault.inject(fault.quick_count, tmp_path, np.random.default_rng(7))
    assert outcome.injected == fault.quick_count


def test_the_committed_soak_has_every_fault_as_often_as_required() -> None:
    document = json.loads(SOAK.read_text())
    assert document["manifest"]["packages"]["libsumo"].startswith("1.28")
    assert {row["name"]: row["injected"] for row in read_part(SOAK, "rows")} == {
        name: fault.long_count for name, fault in FAULTS.items()
    }
