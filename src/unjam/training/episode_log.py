"""Log of the episodes of an assessment, so that it can resume, or continue with more episodes."""

from pathlib import Path
from secrets import token_hex
from threading import Lock
from typing import Any

from safetensors.numpy import save

from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_recipe, is_serializable
from unjam.errors import InputError, NoCavError
from unjam.files import INVALID_DATA_ERRORS, sha256_of, to_json
from unjam.manifest import manifest
from unjam.measures.metrics import METRICS
from unjam.reports.results import replace_null
from unjam.scenarios import scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.training.fingerprint import file_hashes
from unjam.training.trial_log import RowLog

EPISODES_FILE = "episodes.jsonl"


class EpisodeLog(RowLog):
    """Rows of metrics by setup (scenario and driver) and seed."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        """Begin in a new folder, or resume with the same scenario, files and commit; else raise `InputError`."""
        request = {"scenario": scenario_recipe(scenario), "files": file_hashes((), scenario)}
        super().__init__(folder, request | {"commit": manifest()["commit"]}, EPISODES_FILE)
        self._call_id, self._lock = token_hex(16), Lock()
        self.episodes: dict[tuple[str, tuple[int, ...]], dict[str, Any]] = {}
        """rows by hash of the setup, and seed"""
        for entry in self.rows:
            try:
                row = replace_null(entry["row"])
                if not all(isinstance(row[name], int | float) for name in METRICS):
                    raise TypeError("a metric is not a number")
                self.episodes[entry["setup"], tuple(entry["seed"])] = row
            except INVALID_DATA_ERRORS:
                raise InputError(f"out: {EPISODES_FILE} in {str(folder)!r} is damaged; allowed: a new folder") from None

    def setup_hash(self, scenario: Scenario, driver: Driver) -> str:
        """Return the SHA-256 of a scenario, a driver and its weights.

        A driver that cannot be serialized has another hash in each call, because its content is unknown.
        """
        unique_recipe = f"{driver.describe()} {self._call_id} {id(driver)}"
        recipe, arrays = driver_recipe(driver) if is_serializable(driver) else (unique_recipe, {})
        return sha256_of(to_json([scenario_recipe(scenario), recipe]).encode() + save(arrays))

    def add(self, setup_hash: str, seed: tuple[int, ...], row: dict[str, Any]) -> None:
        """Add the row of an episode and write it to the disk; any thread may call this.

        The row of a failed episode is not written, because a later call may succeed.
        """
        with self._lock:
            self.episodes[setup_hash, seed] = row
            if row["status"] != "failed" or row["error"] == NoCavError.__name__:
                self.append({"setup": setup_hash, "seed": seed, "row": row})
