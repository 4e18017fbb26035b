"""A population of human drivers, as `unjam fit-drivers` calibrates it.

A population is a file `NAME.json`. A population with a residual network also has a file `NAME.safetensors` in the same
folder. No code in these files is executed.
"""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib.resources import files
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from unjam import __version__
from unjam.drivers.network import Network, network_weights
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.files import INVALID_DATA_ERRORS, PACKAGED_PREFIX, atomic_write, check_parent_folder, sha256_of, to_json
from unjam.parameters import build_dataclass
from unjam.physics.arrays import Array, clip, namespace
from unjam.physics.idm import IDM_PARAMETER_NAMES, IDMParameters
from unjam.processes import lock_file

PACKAGED_POPULATIONS = Path(str(files("unjam") / "scenarios/populations"))
"""folder of the packaged populations"""
POPULATION_FORMAT = 1
WEIGHTS_SUFFIX = ".safetensors"  # suffix of the file with the residual network of a population
RESIDUAL_INPUTS = ("speed", "leader's speed minus own", "gap")
"""inputs of the residual [m/s, m/s, m]"""
MAX_POPULATION_BYTES = 64 * 2**20
"""maximum size of a file with a population [bytes]"""
POPULATION_KEYS = ("format", "unjam", "typical", "parameter_statistics", "limits", "drivers", "residual")
"""keys of the file; other keys are `metadata`"""


@dataclass(frozen=True, eq=False)
class Population:
    """Calibrated human drivers, one set of parameters each."""

    typical: IDMParameters
    """the IDM that fits all drivers best"""
    drivers: tuple[IDMParameters, ...] = field(repr=False)
    limits: tuple[float, float]
    """limits of the acceleration of all drivers [m/s2]"""
    residual: Network | None = None
    """correction of the IDM, the same for all drivers: a network from RESIDUAL_INPUTS to an acceleration [m/s2]"""
    details: tuple[dict[str, Any], ...] = field(default=(), repr=False)
    """other entries of each driver in the file"""
    metadata: dict[str, Any] = field(default_factory=dict, repr=False)
    """origin of the population"""

    @property
    def max_desired_speed(self) -> float:
        """The largest desired speed of all drivers [m/s]."""
        return max(driver.desired_speed for driver in (self.typical, *self.drivers))

    @property
    def min_time_headway(self) -> float:
        """The smallest time headway of all drivers [s]."""
        return min(driver.time_headway for driver in (self.typical, *self.drivers))

    def draw(self, count: int, generator: np.random.Generator) -> list[IDMParameters]:
        """Return `count` drivers, drawn with replacement; the parameters of a driver stay together."""
        return [self.drivers[index] for index in generator.integers(len(self.drivers), size=count)]

    def parameter_statistics(self) -> dict[str, dict[str, float]]:
        """Return mean, standard deviation and quartiles of each parameter."""
        statistics = {}
        for name in IDM_PARAMETER_NAMES:
            values = np.array([getattr(driver, name) for driver in self.drivers])
            quartiles = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
            statistics[name] = {"mean": float(values.mean()), "std": float(values.std()), "quartiles": quartiles}
        return statistics


def residual_inputs(speed: Array, leader_speed: Array, gap: Array) -> Array:
    """Return RESIDUAL_INPUTS in SI units, shape (..., 3)."""
    return namespace(gap).stack([speed, leader_speed - speed, gap], -1)


def apply_population(
    population: Population | None, acceleration: Array, speed: Array, leader_speed: Array, gap: Array
) -> Array:
    """Return IDM accelerations (n,) with the residual and the limits of a population, if any, applied [m/s2]."""
    if population is None:
        return acceleration
    if population.residual is not None:
        acceleration = acceleration + population.residual(residual_inputs(speed, leader_speed, gap))
    return clip(acceleration, *population.limits)


@contextmanager
def reserve_population(path: Path) -> Iterator[Callable[[Population], None]]:
    """Lock the file name of a new population for this process, and yield the function that writes the population.

    Raise `InputError` if a file of the population exists, both before and after the `with` block has computed it, or if
    another process has locked the name. Raise `DiskError` if the folder does not exist.
    """

    def check_new() -> None:
        if existing := [str(file) for file in (path, path.with_suffix(WEIGHTS_SUFFIX)) if os.path.lexists(file)]:
            raise InputError(f"out: {existing[0]!r} exists; allowed: a new file")

    def write_new(population: Population) -> None:
        check_new()
        write_population(path, population)

    if path.suffix != ".json":
        raise invalid_value("out", str(path), "a .json file")
    check_parent_folder(path)
    check_new()
    with lock_file(path.with_name(f".{path.name}.lock"), f"out: {str(path)!r}"):
        check_new()
        yield write_new


def write_population(path: Path, population: Population) -> None:
    """Write a population to `path`, and its residual network into the same folder."""
    residual = None
    if population.residual is not None:
        weights = save(network_weights(population.residual))
        weights_file = path.with_suffix(WEIGHTS_SUFFIX)
        sha256 = sha256_of(weights)
        residual = {"file": weights_file.name, "sha256": sha256, "authority": population.residual.authority}
        atomic_write(weights_file, weights)
    details = population.details or ({},) * len(population.drivers)
    content = {
        "format": POPULATION_FORMAT,
        "unjam": __version__,
        "typical": asdict(population.typical),
        "parameter_statistics": population.parameter_statistics(),
        "limits": list(population.limits),
        "residual": residual,
        **population.metadata,
        "drivers": [{**detail, **asdict(driver)} for detail, driver in zip(details, population.drivers, strict=True)],
    }
    atomic_write(path, to_json(content, indent=1))


def population_file(name: Path | str) -> Path:
    """Return the file of a population, in the package or by path; raise `InputError` if the package has none."""
    if not str(name).startswith(PACKAGED_PREFIX):
        return Path(name)
    known = {f"{PACKAGED_PREFIX}{path.stem}": path for path in sorted(PACKAGED_POPULATIONS.glob("*.json"))}
    if name not in known:
        raise unknown_name("population", str(name), known)
    return known[str(name)]


def read_population(name: Path | str) -> Population:
    """Return the population of a file or of the package; raise `InputError` if it is missing, damaged or invalid."""
    path = population_file(name)
    if not os.path.exists(path):
        raise InputError(f"population: {str(path)!r} does not exist")
    if not os.path.isfile(path):  # reading a device might never end
        raise invalid_value("population", str(path), "a file of `unjam fit-drivers`")
    status = path.stat()
    return _read_population_file(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=8)
def _read_population_file(path: Path, modified_ns: int, size: int) -> Population:
    """Return the population of a file, cached until the file changes, because every episode needs it."""
    if size > MAX_POPULATION_BYTES:
        raise InputError(f"population {path.name}: {size} bytes are not allowed; allowed: <= {MAX_POPULATION_BYTES}")
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != POPULATION_FORMAT:
            raise InputError(f"population {path.name}: format {content['format']!r} is unknown")
        entries = content["drivers"]
        drivers = tuple(
            build_dataclass(
                IDMParameters, {key: entry[key] for key in IDM_PARAMETER_NAMES}, f"population.drivers.{index}"
            )
            for index, entry in enumerate(entries)
        )
        if not drivers:
            raise InputError(f"population {path.name}: it has no drivers")
        low, high = (_finite_number(limit, "limits") for limit in content["limits"])
        if not low < 0.0 < high:
            raise ValueError(f"limits: [{low:g}, {high:g}] are not allowed; allowed: one below and one above 0")
        return Population(
            typical=build_dataclass(IDMParameters, content["typical"], "population.typical"),
            drivers=drivers,
            limits=(low, high),
            residual=_read_residual(path, content["residual"]),
            details=tuple({key: entry[key] for key in entry if key not in IDM_PARAMETER_NAMES} for entry in entries),
            metadata={key: value for key, value in content.items() if key not in POPULATION_KEYS},
        )
    except INVALID_DATA_ERRORS as error:
        reason = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise InputError(f"population {path.name}: not a population: {reason}") from None


def _finite_number(value: Any, key: str) -> float:
    if type(value) not in (int, float) or not isfinite(value):
        raise ValueError(f"{key}: {value!r:.60} is not allowed; allowed: a finite number")
    return float(value)


def _read_residual(path: Path, entry: dict[str, Any] | None) -> Network | None:
    if entry is None:
        return None
    weights_file = path.parent / Path(str(entry["file"])).name  # a file in another folder is not read
    if weights_file.stat().st_size > MAX_POPULATION_BYTES:
        raise InputError(f"population {path.name}: its residual network is too large")
    weights = weights_file.read_bytes()
    if sha256_of(weights) != entry["sha256"]:
        raise InputError(f"population {path.name}: damaged: {weights_file.name} does not have the hash in {path.name}")
    arrays = load(weights)
    layers = ((arrays[f"{index}.weight"], arrays[f"{index}.bias"]) for index in range(len(arrays) // 2))
    network = Network(tuple(layers), _finite_number(entry["authority"], "authority"))
    if network.input_size != len(RESIDUAL_INPUTS):
        raise InputError(f"population {path.name}: {network.input_size} inputs are not allowed; allowed: 3")
    return network
