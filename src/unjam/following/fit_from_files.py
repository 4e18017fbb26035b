"""Fit drivers: from files of recorded trajectories to a population. `unjam fit-drivers`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from unjam.errors import InputError, wrong
from unjam.files import check_folder
from unjam.following.fit_drivers import FitDriversSettings, fit_drivers
from unjam.following.loaders import Reading, read_pairs
from unjam.following.pairs import Pair
from unjam.manifest import manifest
from unjam.parameters import build, nested
from unjam.scenarios.population import Population

FILTERS = ("kind", "split", "driver")
"""what trajectories can be chosen by"""


@dataclass(frozen=True)
class FittedDrivers:
    """A population, and what it was made from."""

    population: Population
    words: list[str]
    """what was read and what was not"""

    def facts(self) -> dict[str, Any]:
        """Return what matters about it, as JSON."""
        population = self.population
        fit = {key: value for key, value in population.about["fit"].items() if key != "settings"}
        return {"drivers": len(population.drivers), "spread": population.spread(), **fit}

    def verdict(self) -> list[str]:
        """Return in words how near the drivers come to the recorded gaps."""
        fit, details = self.population.about["fit"], self.population.details
        errors = [one["gap_error"] for one in details]
        lines = [
            f"error of the simulated gap: one IDM for all {fit['together']['gap_error']:.2f} m, "
            f"each driver's own {np.mean(errors):.2f} m on average"
        ]
        collided = sum(one["collided"] > 0 for one in details)
        if collided:
            lines.append(f"{collided} drivers use up their gap in the simulation")
        if "residual_gap_errors" in fit:
            before, best = fit["residual_gap_errors"][0], min(fit["residual_gap_errors"])
            made = "kept" if fit["residual_is_better"] else "of no use, left out"
            lines.append(f"residual: {made}: {before:.2f} m without, {best:.2f} m with, on other drivers")
        return lines


def fit_from_files(
    files: Sequence[Path],
    changes: dict[str, Any],
    format: str = "",
    cut_bad: bool = False,
    driver: tuple[str, ...] = (),
    only: dict[str, str] | None = None,
    out: Path | None = None,
    told: Callable[[int, int], None] | None = None,
) -> FittedDrivers:
    """Return the population of the drivers in files.

    Args:
        files: of one format and one time step.
        changes: to `FitDriversSettings`; keys may have dots.
        format: of `unjam.following.loaders.FORMATS`; empty: told from the columns.
        cut_bad: whether bad rows are cut out instead of refused.
        driver: columns of a plain table that together name the driver.
        only: which trajectories, by a name in FILTERS.
        out: where the population will be written; checked before anything is calibrated.
        told: told how many drivers are done, and of how many.

    Raises:
        InputError: a file, a row or a setting is wrong, or no trajectory is chosen.
        DiskError: the folder of `out` is not there.
    """
    if out is not None:
        if out.suffix != ".json":
            raise wrong("out", str(out), "a .json file")
        check_folder(out)
    settings = build(FitDriversSettings, nested(changes), "")
    pairs: list[Pair] = []
    words = []
    for file in files:
        found = read_pairs(file, format, Reading(cut_bad=cut_bad, driver=driver))
        words += [f"{file.name}: {line}" for line in found.words()]
        prefix = f"{file.stem}-" if len(files) > 1 else ""
        pairs += [replace(pair, name=prefix + pair.name, driver=prefix + pair.driver) for pair in found.pairs]
    pairs = _chosen(pairs, only or {})
    population = fit_drivers(pairs, settings, told)
    about = {**population.about, "data": [file.name for file in files], "only": only or {}}
    made = manifest()
    made["command"] = [
        Path(word).name if "/" in word else word for word in made["command"]
    ]  # it is given away
    return FittedDrivers(replace(population, about={**about, "manifest": made}), words)


def _chosen(pairs: list[Pair], only: dict[str, str]) -> list[Pair]:
    for name, value in only.items():
        if name not in FILTERS:
            raise wrong("only", name, ", ".join(FILTERS))
        there = sorted({str(getattr(pair, name)) for pair in pairs})
        pairs = [pair for pair in pairs if getattr(pair, name) == value]
        if not pairs:
            raise InputError(f"only: no trajectory has {name} {value!r}; there are: {', '.join(there)}")
    return pairs
