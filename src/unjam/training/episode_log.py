"""Log of the episodes of an assessment, with which it resumes, or continues with more episodes."""

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
    """Rows of metrics by scenario and driver, and by seed."""

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        """Begin in a new folder, or resume with the same scenario, files and version; `InputError` for others."""
        request = {"scenario": scenario_recipe(scenario), "files": file_hashes((), scenario)}
        super().__init__(folder, request | {"commit": manifest()["commit"]}, EPISODES_FILE)
        self._call, self._lock = token_hex(16), Lock()
        self.episodes: dict[tuple[str, tuple[int, ...]], dict[str, Any]] = {}
        """rows by the hash of a setup and the seed"""
        for entry in self.rows:
            try:
                row = replace_null(entry["row"])
                if not all(isinstance(row[name], int | float) for name in METRICS):
                    raise TypeError("a metric is no number")
                self.episodes[entry["setup"], tuple(entry["seed"])] = row
            except INVALID_DATA_ERRORS:
                raise InputError(f"out: {EPISODES_FILE} in {str(folder)!r} is damaged; allowed: a new folder") from None

    def setup_hash(self, scenario: Scenario, driver: Driver) -> str:
        """Return the SHA-256 of a scenario, a driver and its weights.

        The content of a driver that no other process can build is unknown: its hash differs in each call.
        """
        is_known = is_serializable(driver)
        recipe, arrays = driver_recipe(driver) if is_known else (f"{driver.describe()} {self._call} {id(driver)}", {})
        return sha256_of(to_json([scenario_recipe(scenario), recipe]).encode() + save(arrays))

    def add(self, setup: str, seed: tuple[int, ...], row: dict[str, Any]) -> None:
        """Add the row of an episode, from any thread; it is on the disk when this returns.

        A failed one is not: its cause may be mended in a later call.
        """
        with self._lock:
            self.episodes[setup, seed] = row
            if row["status"] != "failed" or row["error"] == NoCavError.__name__:
                self.append({"setup": setup, "seed": seed, "row": row})
