"""The speeds in the documentation are those of results/speed.json, the output of `unjam bench --json`."""

import json
from pathlib import Path

import pytest

from unjam.training.speed import ENVIRONMENT_PART, SLOTS_PART

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/environments.md").read_text()
PARTS = {part["name"]: part for part in json.loads((ROOT / "results/speed.json").read_text())["parts"]}
ASYNC = "Gymnasium's async vector environment of 2 rings in SUMO"
ROWS = {
    "1,024 rings, `exact=False`": "vector environment of 1,024 rings",
    "4,096 rings, `exact=False`": "vector environment of 4,096 rings",
    "1,024 rings": "vector environment of 1,024 rings, exact",
}
"""rows of the table, and names of vector environments"""


@pytest.mark.parametrize("row", ROWS)
def test_ratios_of_vector_environments_are_those_measured(row: str) -> None:
    name = ROWS[row]
    times, share = PARTS[f"{name}, compared with SUMO"]["ratio"], PARTS[name]["ratio"]
    assert f"| {row} | {times:.0f} times | {share:.2f} |" in PAGE


def test_ratios_of_other_environments_are_those_measured() -> None:
    for row, name in {", `exact=False`": "", "": ", exact"}.items():
        part = PARTS[f"vector environment of 256 on-ramps{name}"]
        assert part["reference"] == SLOTS_PART
        assert f"| 256 on-ramps with slots{row} | {part['ratio']:.1f} times `env.step` with slots |" in PAGE
    assert f"| {PARTS[ASYNC]['ratio']:.2f} times | |" in PAGE
    assert f"| {PARTS['ring: env.step over TraCI']['ratio']:.2f} times | |" in PAGE
    assert f"{PARTS[ENVIRONMENT_PART]['ratio']:.2f} of the speed of SUMO alone" in PAGE
