"""Prints how long an iteration takes with whole roads imagined and without, interleaved on one machine.

Usage: seconds.py > seconds.json; some minutes, on a machine that does nothing else.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median

from unjam.manifest import manifest
from unjam.studies.imagined import compared_with
from unjam.studies.study import PlannedRun
from unjam.training.train import train

ROUNDS, ITERATIONS = 3, 5

seconds: dict[str, list[float]] = {name: [] for name in compared_with("best")}
planned = {name: PlannedRun("ring", name, 0).config for name in compared_with("best")}
for seed in range(ROUNDS):
    for name, config in planned.items():
        unjudged = replace(config.evaluation, every=0, episodes=1)
        steps = ITERATIONS * config.learner.batch_steps
        config = replace(config, seed=seed, steps=steps, evaluation=unjudged)
        with tempfile.TemporaryDirectory() as place:
            folder = train(config, Path(place) / "run").folder
            rows = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
        seconds[name] += [sum(row["seconds"].values()) for row in rows[1:]]  # the first warms up

found = {
    name: {
        "steps": config.steps,
        "iterations": config.steps // config.learner.batch_steps,
        "seconds_of_an_iteration": round(median(seconds[name]), 3),
    }
    for name, config in planned.items()
}
print(json.dumps({**manifest(), "found": found}, indent=1))
