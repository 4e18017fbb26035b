"""Tiny trainings, one of each learner, and the hash of what each has learned.

Run: python -m tests.kernels.trainings [LEARNER ...]; prints one JSON object.
"""

import hashlib
import json
import sys
import tempfile
from pathlib import Path

import torch

from tests.training.test_run import learn_with, small_config
from unjam.road_family import NO_LATENCY
from unjam.worlds.worker_pool import WorkerPool

DATA = ("model/data/", "replay/")
"""prefixes of the training data, which are not hashed"""
LEARNERS = {
    "trpo": {"model__model_ratio": 1.0, "model__epochs": 2, "model__members": 2},
    "ppo": {"model__model_ratio": 0.0},
    "sac": {"model__model_ratio": 0.0},
}


def hashed_name(name: str) -> str:
    """Return the name of a tensor that goes into the hash: a renamed tensor keeps the one of the blessed hash."""
    return name.replace("model/", "virtual/", 1).replace("output_mask", "learned")


def hashes(learners: list[str]) -> dict[str, str]:
    """Return the hash of all that each learner has learned, its learned model included."""
    torch.set_num_threads(1)  # as a training does
    found = {}
    with tempfile.TemporaryDirectory() as folder, WorkerPool(1) as workers:
        for learner in learners:
            config = small_config(
                agent=learner,
                policy__hidden=[32, 32],
                evaluation__validation_interval=0,
                scenario_options__actuator=NO_LATENCY,
                **LEARNERS[learner],
            )
            run = learn_with(workers, Path(folder) / learner, config)
            total = hashlib.sha256()
            tensors = run.algorithm.state()[1].items()
            for name, tensor in sorted(
                (hashed_name(name), value) for name, value in tensors if not name.startswith(DATA)
            ):
                total.update(name.encode() + tensor.numpy().tobytes())
            found[learner] = total.hexdigest()[:16]
    return found


if __name__ == "__main__":
    print(json.dumps(hashes(sys.argv[1:] or list(LEARNERS)), indent=1))
