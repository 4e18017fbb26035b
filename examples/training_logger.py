"""Log a training with a logger of your own, here into a database, and end the training after a time limit.

Run: python examples/training_logger.py [steps] [folder]
"""

import sqlite3
import sys
import time
from typing import Any

import unjam
from unjam.parameters import flatten_keys


class DatabaseLogger:
    """Writes all numbers of the progress into a database that several runs share."""

    def __init__(self, path: str, run: str, max_seconds: float) -> None:
        self.database, self.run, self.end = sqlite3.connect(path), run, time.monotonic() + max_seconds
        self.database.execute("CREATE TABLE IF NOT EXISTS progress (run TEXT, step INTEGER, name TEXT, value REAL)")

    def __call__(self, row: dict[str, Any]) -> bool:
        """Write a row, and return whether the training continues; called after each iteration."""
        numbers = {name: value for name, value in flatten_keys(row).items() if isinstance(value, int | float)}
        rows = [(self.run, row["environment_steps"], name, value) for name, value in numbers.items()]
        with self.database:
            self.database.executemany("INSERT INTO progress VALUES (?, ?, ?, ?)", rows)
        return time.monotonic() < self.end


if __name__ == "__main__":  # workers import this file
    steps, folder = int((*sys.argv[1:], "24000")[0]), (*sys.argv[2:], "runs/logged")[0]
    changes = {"steps": steps, "trpo.steps_per_iteration": min(steps, 12_000)}
    config = unjam.load_config(preset="demo", changes=changes)
    logger = DatabaseLogger("progress.sqlite", folder, max_seconds=3600)
    unjam.train(config, folder, on_iteration=logger)
    query = "SELECT step, value FROM progress WHERE run = ? AND name = 'return_mean' ORDER BY step"
    for step, value in logger.database.execute(query, (folder,)):
        print(f"unjam {unjam.__version__}: {step:,} steps, return {value:.0f}")
