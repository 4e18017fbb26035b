"""The result of a benchmark and its file: metrics of each road and seed, from which gains are computed."""

from dataclasses import asdict, field
from functools import cached_property
from math import isclose, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, StrictBool, StrictFloat, StrictInt, StrictStr

from unjam.benchmarks.suites import Suite, find_suite, load_references
from unjam.controller.manifest import first_difference, short_text
from unjam.errors import InputError, invalid_value, prefix_errors, unknown_name
from unjam.files import INVALID_DATA_ERRORS, atomic_write, parse_json, to_json
from unjam.measures import gain
from unjam.measures.feasibility import FEASIBLE, overall_feasibility
from unjam.measures.statistics import Estimate, estimate_crossed
from unjam.parameters import STRICT, build_dataclass, parameter_dataclass
from unjam.physics.arrays import Floats
from unjam.road_family import FAMILY
from unjam.seeds import held_out_seeds

if TYPE_CHECKING:  # imported late, so that commands start quickly
    import pandas as pd

FILE_FORMAT, DIGITS, MAX_LABEL_CHARACTERS = 1, 7, 500
"""version of files; significant digits of stored metrics; maximum length of the name of a driver"""
MAX_FILE_BYTES = 4 * 2**20  # maximum size of a file; a file with all roads has 200 kB
MAX_RELATIVE_DIFFERENCE = 1e-4  # allowed relative difference to reference values of the human baseline
TRAINING_STEPS_UNIT = "environment steps: control steps in the simulator"  # unit of `training_steps` in files
PARTS = {"all roads": ("training", "combination", "axis"), "training": ("training",), "unseen": ("combination", "axis")}
"""parts of the family of roads that are averaged, by name of the mean"""
EPISODES_PER_ROAD = 10  # episodes of each driver on each road
FAMILY_TEST_SEEDS = held_out_seeds(EPISODES_PER_ROAD)
FAMILY_METRICS = (
    *("seed", "status", "travel_time", "delay", "mean_speed", "mean_speed_second_half", "speed_limit_ratio"),
    *("outflow_veh_per_h", "fuel_ml_per_km", "required_time_gap", "has_lanes", "collisions", "min_time_gap"),
    *("cav_min_ttc", "cav_max_braking", "cut_in_max_braking", "share_short_time_gap", "override_share"),
    "human_braking_beyond_4_5",
)
Column = list[StrictFloat | StrictInt | StrictBool | StrictStr | None]
Columns = dict[str, Annotated[Column, Field(min_length=EPISODES_PER_ROAD, max_length=EPISODES_PER_ROAD)]]
"""metrics by name, a value for each test seed"""


@parameter_dataclass(frozen=True, config=STRICT)
class RoadRecord:
    """The episodes of the human baseline and of the driver on one road."""

    backend: StrictStr  # simulator of the driver's episodes
    baseline: Columns
    driver: Columns  # empty if the driver cannot drive on this road, and counts as the human baseline
    note: StrictStr = ""  # reason why the driver cannot drive on this road


@parameter_dataclass(frozen=True, config=STRICT)
class BenchmarkResult:
    """The result of one driver in a suite; gain, feasibility and worst road are computed from the rows of the roads."""

    suite: StrictStr
    driver: Annotated[StrictStr, Field(min_length=1, max_length=MAX_LABEL_CHARACTERS)]
    sha256: StrictStr | None
    """hash of the controller file, or else of the driver's parameters, code and weights; None: a Python object"""
    training_steps: Annotated[StrictInt, Field(ge=0)] | None
    """control steps in the simulator for training or tuning, from the driver's file or author; None: unknown"""
    manifest: dict[str, Any] = field(repr=False)
    """versions of unjam and SUMO, machine, command"""
    roads: dict[str, RoadRecord] = field(default_factory=dict, repr=False)
    """finished roads by name"""
    format: StrictInt = FILE_FORMAT

    @property
    def missing_roads(self) -> list[str]:
        """Roads of the suite that are not finished."""
        return [name for name in find_suite(self.suite).roads if name not in self.roads]

    @cached_property
    @np.errstate(over="ignore", invalid="ignore")  # files may contain all finite numbers
    def _gains(self) -> dict[str, tuple[Estimate, Floats, str]]:
        """Gain, gain by seed and verdict on feasibility, by road."""
        gains: dict[str, tuple[Estimate, Floats, str]] = {}
        for name, road in self.roads.items():
            baseline, reference = _to_rows(road.baseline), load_references()[name]["performance"]
            rows = _to_rows(road.driver) if road.driver else baseline
            verdict = overall_feasibility(rows, baseline) if road.driver else f"not driven: {road.note}"
            arguments = rows, baseline, reference
            gains[name] = gain.normalized_gain(*arguments), gain.gain_by_seed(*arguments), verdict
        return gains

    @np.errstate(over="ignore", invalid="ignore")
    def mean_gain(self, part: str = "all roads") -> Estimate:
        """Return the mean gain over the finished roads of one of `PARTS`, with its 95 % CI over roads and seeds."""
        if not isinstance(part, str) or part not in PARTS:
            raise unknown_name("part", part, PARTS)
        gains = [by_seed for name, (_, by_seed, _) in self._gains.items() if FAMILY[name].part in PARTS[part]]
        return estimate_crossed(gains, allows_bimodal=True)

    @property
    def worst_road(self) -> tuple[str, float]:
        """The road with the smallest gain, and this gain."""
        return min(self.gains().items(), key=lambda pair: pair[1])

    @property
    def feasible_count(self) -> int:
        """Number of roads on which no episode violates a limit, including roads without CAVs."""
        return sum(verdict in ("", FEASIBLE) for *_, verdict in self._gains.values())

    def gains(self) -> dict[str, float]:
        """Return the gains on the finished roads by road name."""
        return {name: estimate.mean for name, (estimate, *_) in self._gains.items()}

    def road_rows(self) -> list[dict[str, Any]]:
        """Return rows with part, gain with 95 % CI over seeds, feasibility and backend of each road; then the means."""
        rows: list[dict[str, Any]] = [
            {"road": name, "part": FAMILY[name].part, **_gain_columns(estimate), "feasible": verdict}
            | {"backend": self.roads[name].backend, "expert": load_references()[name]["expert"]}
            for name, (estimate, _, verdict) in self._gains.items()
        ]
        empty = {"part": "", "feasible": "", "backend": "", "expert": ""}
        parts = () if self.missing_roads else PARTS
        return rows + [{**empty, "road": f"mean, {part}", **_gain_columns(self.mean_gain(part))} for part in parts]

    def table(self) -> "pd.DataFrame":
        """Return `road_rows` as a table with at most 80 characters a line, without backends and experts."""
        import pandas as pd

        table = pd.DataFrame(self.road_rows()).set_index("road").drop(columns=["backend", "expert"])
        return table.round({"gain": 2, "low": 2, "high": 2})

    def summary(self) -> dict[str, Any]:
        """Return the computed results that the file contains."""
        return {"gains": self.road_rows(), "worst_road": self.worst_road, "feasible_roads": self.feasible_count}

    def document(self) -> dict[str, Any]:
        """Return the content of the file, a JSON object, with the summary if all roads are finished."""
        content = asdict(self) | {"training_steps_unit": TRAINING_STEPS_UNIT, "seeds": FAMILY_TEST_SEEDS}
        return content if self.missing_roads else {"summary": self.summary(), **content}

    def check_comparable(self) -> None:
        """Raise `InputError` if roads are missing, or if the human baseline differs from that of the suite."""
        if self.missing_roads:
            count, example = len(self.missing_roads), self.missing_roads[0]
            raise InputError(f"roads: {count} are missing ({example}, ...); allowed: a finished benchmark")
        for name, road in self.roads.items():
            performances = [gain.performance(row) for row in _to_rows(road.baseline)]
            for value, expected in zip(performances, load_references()[name]["baseline"], strict=True):
                if not isclose(value, expected, rel_tol=MAX_RELATIVE_DIFFERENCE):
                    versions = f"unjam {self.manifest.get('unjam')!s:.20}, backend {road.backend:.40}"
                    reason = f"performance of the human baseline ({versions})"
                    raise invalid_value(f"{name}: {reason}", round(value, 4), f"{expected:.4f}, as in {self.suite}")


def to_columns(rows: gain.EpisodeRows) -> dict[str, list[Any]]:
    """Return rows of metrics as columns for the file, with seven significant digits; NaN becomes null."""

    def round_value(value: Any) -> Any:
        return (float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None) if type(value) is float else value

    return {name: [round_value(row[name]) for row in rows] for name in FAMILY_METRICS[1:] if rows}


def _to_rows(columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    """Return the rows of columns of a file, with their test seeds; null becomes NaN."""
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    return [
        {"seed": seed} | {name: nan if value is None else value for name, value in row.items()}
        for seed, row in zip(FAMILY_TEST_SEEDS, rows, strict=False)  # no rows if the driver cannot drive
    ]


def _gain_columns(estimate: Estimate) -> dict[str, float]:
    return {"gain": estimate.mean, "low": estimate.low, "high": estimate.high}


def write_result(path: Path, result: BenchmarkResult) -> None:
    """Write a result as a file, with one line for each road."""
    document = result.document()
    roads = document.pop("roads")
    lines = ",\n".join(f"{to_json(name)}: {to_json(road)}" for name, road in roads.items())
    head = ",\n".join(f"{to_json(key)}: {to_json(value)}" for key, value in document.items())
    atomic_write(path, f'{{{head},\n"roads": {{\n{lines}\n}}}}\n')


def read_result(path: Path) -> BenchmarkResult:
    """Return the result in a file; no code in the file is executed.

    Raise `InputError` if the file is no result of a suite of this version, or is inconsistent.
    """
    with prefix_errors(f"{path}: "):
        try:
            if not path.is_file():
                reason = "it is not a file" if path.exists() else "there is no such file"
                raise InputError(f"{reason}; allowed: a file of `unjam benchmark`")
            if path.stat().st_size > MAX_FILE_BYTES:
                raise InputError(f"it is too large; allowed: at most {MAX_FILE_BYTES:,} bytes")
            content = parse_json(path.read_bytes())
            if not isinstance(content, dict) or content.get("format") != FILE_FORMAT:
                raise ValueError(f"format: it is not {FILE_FORMAT}")
            seeds, summary, _ = (content.pop(name, None) for name in ("seeds", "summary", "training_steps_unit"))
        except INVALID_DATA_ERRORS as error:
            raise InputError(f"it is not a result of `unjam benchmark`: {error}") from None
        result = build_dataclass(BenchmarkResult, content, "result")
        _check_roads(result, find_suite(result.suite))
        if seeds != list(map(list, FAMILY_TEST_SEEDS)):
            raise InputError(f"seeds: they are not those of {result.suite}")
        expected = None if result.missing_roads else parse_json(to_json(result.summary()))
        if difference := first_difference(expected, summary, MAX_RELATIVE_DIFFERENCE):
            name, computed, stored = difference
            allowed = f"{short_text(computed)}, which follows from the rows"
            raise InputError(f"summary.{name}: {short_text(stored)} is not allowed; allowed: {allowed}")
        return result


def _check_roads(result: BenchmarkResult, suite: Suite) -> None:
    """Raise `InputError` if a road or metric is unknown, a metric is missing, or a text is in place of a number."""
    for name, road in result.roads.items():
        if name not in suite.roads:
            raise InputError(f"roads: {name[:50]!r} is not in {suite.name}")
        for columns in (road.baseline, road.driver) if road.driver else (road.baseline,):
            if unmatched := sorted(columns.keys() ^ set(FAMILY_METRICS[1:])):
                raise InputError(f"roads.{name}: the metric {unmatched[0]:.50} is missing or unknown")
            for key, values in columns.items():
                is_text = key == "status"
                if invalid := [value for value in values if isinstance(value, str) is not is_text]:
                    raise invalid_value(f"roads.{name}.{key}", invalid[0], "texts" if is_text else "numbers")
