"""Compares trainings that two machines made: python results/repeated/compare.py FOLDER OTHER > repeated.json.

Each folder holds runs by name. Of each that both have: the machines, and how many iterations of both say the
same of everything but the time they took, up to the last that both have made.
"""

import json
import sys
from pathlib import Path
from typing import Any


def machine(run: Path) -> dict[str, Any]:
    """Return what made a run."""
    about = json.loads((run / "manifest.json").read_text())
    return {
        "processor": about["kernels"]["processor"],
        "system": about["machine"]["system"],
        "commit": about["commit"],
    }


def iterations(run: Path) -> list[dict[str, Any]]:
    """Return what a run says of each iteration, without the time it took."""
    found = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    return [{name: value for name, value in each.items() if name != "seconds"} for each in found]


def compared(one: Path, other: Path) -> dict[str, Any]:
    """Return how far two runs are the same."""
    both = list(zip(iterations(one), iterations(other), strict=False))
    return {
        "machines": [machine(one), machine(other)],
        "iterations": len(both),
        "actual_steps": both[-1][0]["actual_steps"],
        "virtual_steps": sum(each["virtual_steps"] for each, _ in both),
        "different": sum(a != b for a, b in both),
    }


if __name__ == "__main__":
    here, there = map(Path, sys.argv[1:])
    names = sorted(str(found.parent.relative_to(here)) for found in here.rglob("progress.jsonl"))
    common = [name for name in names if (there / name / "progress.jsonl").is_file()]
    print(json.dumps({name: compared(here / name, there / name) for name in common}, indent=1))
