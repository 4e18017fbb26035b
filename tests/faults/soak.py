"""Inject thousands of faults, and write their outcomes to results/soak.json; takes half an hour.

Run: python tests/faults/soak.py [NAME ...]
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.faults.registry import FAULTS  # noqa: E402
from unjam.errors import unknown_name  # noqa: E402
from unjam.manifest import manifest  # noqa: E402
from unjam_paper.results_file import read_part, write_results  # noqa: E402

TARGET = ROOT / "results" / "soak.json"


def soak(names: list[str]) -> None:
    """Inject the faults with these names; the rows of other faults are kept."""
    rows = {row["name"]: row for row in read_part(TARGET, "rows")} if TARGET.exists() else {}
    about = manifest()  # now: later the results themselves are a change of the tree
    for name in names:
        fault, started = FAULTS[name], time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            outcome = fault.inject(fault.long_count, Path(folder), np.random.default_rng(list(FAULTS).index(name)))
        rows[name] = {
            "name": name,
            "about": fault.description,
            "injected": outcome.injected,
            "happened": dict(sorted(outcome.happened.items())),
            "facts": outcome.facts,
            "seconds": round(time.monotonic() - started, 1),
            "commit": about["commit"],
        }
        print(json.dumps(rows[name]), flush=True)
        ordered = [rows[each] for each in FAULTS if each in rows]
        write_results(TARGET, {"manifest": about, "rows": ordered})


if __name__ == "__main__":
    for name in sys.argv[1:]:
        if name not in FAULTS:
            raise SystemExit(str(unknown_name("fault", name, FAULTS)))
    soak(sys.argv[1:] or list(FAULTS))
