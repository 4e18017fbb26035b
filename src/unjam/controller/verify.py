"""Is a controller whole, is it what it says, and do its forms agree: `unjam verify`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.archive import GRAPH, MANIFEST, SAMPLE, WEIGHTS
from unjam.controller.file import Controller, read_controller
from unjam.controller.graph import check_graph, run_graph
from unjam.controller.manifest import description
from unjam.controller.sample import read_sample, replay
from unjam.drivers.registry import describe
from unjam.errors import InputError, MissingPartError

REPEATS_TO = 1e-9
"""how far the recorded accelerations may be from those of this machine [m/s2]"""
PARITY = 1e-6
"""how far the graph may be from the driver [m/s2]"""


@dataclass(frozen=True)
class Verified:
    """What was found of one thing that a controller was checked for."""

    name: str
    found: str


def verify_controller(path: Path | str) -> list[Verified]:
    """Return what was checked of a `.unjam` file; nothing of it is executed.

    Raises:
        InputError: the first thing that is wrong, in one line.
    """
    controller = read_controller(path)
    driver, manifest, parts = controller.driver, controller.manifest, controller.parts
    sizes = ", ".join(f"{name} {len(part):,} bytes" for name, part in parts.items() if name != MANIFEST)
    verified = [
        Verified("parts", f"{sizes}; each has the hash that the manifest names"),
        Verified("driver", describe(driver)),
        Verified(
            "weights", f"finite, of the shapes that the driver needs; SHA-256 {manifest['sha256'][WEIGHTS]}"
        ),
    ]
    if manifest["format"] > 1:
        _check_description(controller)
        seen = "what it observes, remembers and answers"
        verified.append(Verified("manifest", f"{seen} is what its driver does"))
    if SAMPLE in parts:
        verified += _check_sample(controller)
    elif GRAPH in parts:
        raise InputError("controller: has a graph, but no recorded sample to compare it on")
    return verified


def _check_description(controller: Controller) -> None:
    manifest = controller.manifest
    for key, value in description(controller.driver, manifest.get("action_limit")).items():
        if manifest.get(key) != value:
            said = _short(manifest.get(key))
            raise InputError(f"controller: its manifest says of {key}: {said}; allowed: {_short(value)}")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def _check_sample(controller: Controller) -> list[Verified]:
    """Compare the driver, and the graph where there is one, with the recorded sample."""
    limit = controller.manifest["action"]["high"]
    if limit is None:
        raise InputError("controller: has a recorded sample, but its manifest names no bounds of its action")
    states, recorded = read_sample(controller.parts[SAMPLE])
    answers = replay(controller.driver, states, limit)
    words = _compare("its driver", answers, recorded, REPEATS_TO)
    verified = [Verified("sample", words)]
    if GRAPH in controller.parts:
        try:
            check_graph(controller.parts[GRAPH], controller.driver)
            found = run_graph(controller.parts[GRAPH], controller.driver, states)
        except MissingPartError as error:
            return [*verified, Verified("graph", f"not run: {error}")]
        verified.append(Verified("graph", _compare("its graph", found, recorded, PARITY)))
    return verified


def _compare(who: str, found: np.ndarray, recorded: np.ndarray, tolerance: float) -> str:
    off = np.abs(found - recorded)
    if not (off <= tolerance).all():  # NaN is not either
        step = int(np.argmax(~(off <= tolerance)))
        raise InputError(
            f"controller: step {step} of its sample: {who} answers {found[step]:.9g} m/s2; "
            f"allowed: {recorded[step]:.9g} to {tolerance:g}"
        )
    return f"{len(found):,} decisions, {who} within {off.max(initial=0.0):.1e} m/s2 of what was recorded"
