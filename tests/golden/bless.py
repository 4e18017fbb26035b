"""Takes the trajectories of today as golden, with a line in the changelog that says why they have changed.

Run: python tests/golden/bless.py "the merge draws its vehicles from another seed"
"""

import json
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.golden.trajectories import drive_all, fingerprint, folder, hash_of, table_of  # noqa: E402
from unjam.worlds.sumo.networks import sumo_version  # noqa: E402

HEADING = "## Unreleased\n\n"


def bless(why: str) -> None:
    """Write the CSV and the hash of every case, and the line."""
    place = folder()
    place.mkdir(exist_ok=True)
    hashes = {}
    for name, episode in drive_all():
        (place / f"{name}.csv").write_text(table_of(episode))
        hashes[name] = hash_of(episode)
    for old in place.glob("*.csv"):
        if old.stem not in hashes:
            old.unlink()
    (place / "hashes.json").write_text(json.dumps(hashes, indent=1) + "\n")
    changelog = ROOT / "CHANGELOG.md"
    line = f"- Golden trajectories of SUMO {sumo_version()} ({fingerprint(hashes)}): {why}.\n"
    changelog.write_text(changelog.read_text().replace(HEADING, HEADING + line, 1))
    print(line, end="")


if __name__ == "__main__":
    if len(sys.argv) != 2 or len(sys.argv[1]) < 10:
        raise SystemExit('usage: python tests/golden/bless.py "why they have changed"')
    bless(sys.argv[1].rstrip("."))
