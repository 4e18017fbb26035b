"""Store the present results of the pinned kernels as the expected ones.

Run: python -m tests.kernels.bless
"""

import json
from pathlib import Path

from tests.kernels import operations, trainings

HASHES_FILE = Path(__file__).with_name("hashes.json")

if __name__ == "__main__":
    found = {"operations": operations.hashes(), "trainings": trainings.hashes(list(trainings.LEARNERS))}
    HASHES_FILE.write_text(json.dumps(found, indent=1) + "\n")
