"""A few faults of each kind; thousands of them: `make soak`."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.faults.registry import FAULTS
from tests.test_sandbox import kept
from unjam_paper.results_file import read_part

MARKS = {True: [pytest.mark.slow], False: []}
NEEDED = {"sandbox": kept}
"""what the kernel must offer for a fault to be tried"""
SOAK = Path(__file__).parents[2] / "results" / "soak.json"


@pytest.mark.long
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[*MARKS[fault.slow], *([NEEDED[name]] if name in NEEDED else [])])
        for name, fault in FAULTS.items()
    ],
)
def test_a_fault_does_no_harm(name: str, tmp_path: Path) -> None:
    fault = FAULTS[name]
    outcome = fault.inject(fault.quick, tmp_path, np.random.default_rng(7))
    assert outcome.injected == fault.quick


def test_the_committed_soak_has_every_fault_as_often_as_required() -> None:
    document = json.loads(SOAK.read_text())
    assert document["manifest"]["packages"]["libsumo"].startswith("1.28")
    assert {row["name"]: row["injected"] for row in read_part(SOAK, "rows")} == {
        name: fault.long for name, fault in FAULTS.items()
    }
