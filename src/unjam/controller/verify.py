"""Is a controller whole, is it what it says, and do its forms agree: `unjam verify`.

Its forms are its driver, a recorded sample (what a CAV perceived in an episode, and what the controller
answers to it) and an ONNX graph, which is looked at before it is run.
"""

import json
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from unjam.controller.certificate import certificate_of
from unjam.controller.domain import road_of
from unjam.controller.file import (
    ANSWER,
    CERTIFICATE,
    FORMAT,
    GRAPH,
    MANIFEST,
    SAMPLE,
    SIGNATURE,
    WEIGHTS,
    Controller,
    Floats,
    description,
    read_controller,
    read_sample,
    replay,
)
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError, MissingPartError
from unjam.files import reading, to_json
from unjam.tree import leaves

REPEATS_TO = 1e-9
"""how far the recorded accelerations may be from those of this machine [m/s2]"""
CERTIFIED_TO = 1e-6
"""how far a certificate's numbers may be from those of this machine"""
PARITY = 1e-6
"""how far the graph may be from the driver [m/s2]"""
OPERATORS = {
    *("Abs", "Add", "And", "Cast", "Clip", "Concat", "Constant", "Cos", "Div", "Equal", "Expand", "Floor"),
    *("Gather", "GatherElements", "GatherND", "Gemm", "Greater", "GreaterOrEqual", "Identity", "IsNaN"),
    *("Less", "LessOrEqual", "MatMul", "Max", "Min", "Mod", "Mul", "Neg", "Not", "Or", "Pow", "Relu"),
    *("Reciprocal", "ReduceMean"),
    *("Reshape", "ScatterElements", "Shape", "Sin", "Slice", "Sqrt", "Squeeze", "Sub", "Tanh", "Transpose"),
    *("Unsqueeze", "Where"),
}
"""all that the graph of a controller is made of: arithmetic, without loops and without files"""


@dataclass(frozen=True)
class Verified:
    """What was found of one thing that a controller was checked for."""

    name: str
    found: str


def verify_controller(path: Path | str, signer: Path | str | None = None) -> list[Verified]:
    """Return what was checked of a `.unjam` file, or of a run folder; no code runs that is not trusted.

    Args:
        path: the file, or the folder.
        signer: file of the public key that must have signed it; None where anybody may have, or nobody.

    Raises:
        InputError: the first thing that is wrong, in one line; also where there is code that is not trusted.
    """
    return verify(read_controller(path), signer)


def verify(controller: Controller, signer: Path | str | None = None) -> list[Verified]:
    """Return what was checked of a controller that was read; arguments and errors as `verify_controller`."""
    with reading("verify"):
        return _verified(controller, signer)


def _verified(controller: Controller, signer: Path | str | None) -> list[Verified]:
    signature = _check_signer(controller.signed_by, signer)
    driver, manifest = controller.driver, controller.manifest
    parts = {name: part for name, part in controller.parts.items() if name not in (MANIFEST, SIGNATURE)}
    sizes = ", ".join(f"{name} {len(part):,} bytes" for name, part in parts.items())
    weights = f"finite, of the shapes that the driver needs; SHA-256 {manifest['sha256'][WEIGHTS]}"
    verified = [
        Verified("parts", f"{sizes}; each has the hash that the manifest names"),
        Verified("signature", signature),
        Verified("driver", driver.describe()),
        *([Verified("road", f"made for the {road}")] if (road := road_of(manifest)) else []),
        Verified("weights", weights),
    ]
    if manifest["format"] > 1:
        for key, value in description(driver, manifest.get("action_limit")).items():
            named_otherwise = key == "memory" and manifest["format"] < FORMAT
            if manifest.get(key) != value and not named_otherwise:
                said, allowed = _short(manifest.get(key)), _short(value)
                raise InputError(f"controller: its manifest says of {key}: {said}; allowed: {allowed}")
        seen = "what it observes, remembers and answers is what its driver does"
        verified.append(Verified("manifest", seen))
    if SAMPLE in parts:
        verified += _check_sample(controller)
    elif GRAPH in parts or CERTIFICATE in parts:
        raise InputError("controller: has a graph or a certificate, but no recorded sample to try it on")
    if CERTIFICATE in parts:
        verified.append(Verified("certificate", _check_certificate(controller)))
    return verified


def _check_signer(found: str | None, signer: Path | str | None) -> str:
    """Return what is told of who signed a controller; raise `InputError` where it was not `signer`."""
    if signer is None:
        known = "compare that with what its maker told you, or give a public key (--signer)"
        return "none: who made it is not said" if found is None else f"of the key {found}: {known}"
    from unjam.controller.signature import read_public_key  # which takes its time, and few need

    wanted = read_public_key(Path(signer))
    if found != wanted:
        how = "it is not signed" if found is None else f"it is signed by another key, {found}"
        raise InputError(f"controller: {how}; allowed: signed by {str(signer)!r}, {wanted}")
    return f"of {str(signer)!r}, the key {found}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 200 else f"{text[:200]}..."


def _check_sample(controller: Controller) -> list[Verified]:
    """Compare the driver, and the graph where there is one, with the recorded sample."""
    low, high = (controller.manifest["action"][end] for end in ("low", "high"))
    if low is None or high is None:
        raise InputError("controller: has a recorded sample, but its manifest names no bounds of its action")
    limit = max(-low, high)
    states, recorded = read_sample(controller.parts[SAMPLE])
    answers = replay(controller.driver, states, limit)
    verified = [Verified("sample", _compare("its driver", answers, recorded, REPEATS_TO))]
    if GRAPH in controller.parts and controller.manifest["format"] < FORMAT:
        verified.append(Verified("graph", "not run: an older version of unjam made it, with other names"))
    elif GRAPH in controller.parts:
        try:
            check_graph(controller.parts[GRAPH], controller.driver)
            found = run_graph(controller.parts[GRAPH], controller.driver, states)
        except MissingPartError as error:
            return [*verified, Verified("graph", f"not run: {error}")]
        verified.append(Verified("graph", _compare("its graph", found, recorded, PARITY)))
    return verified


def _check_certificate(controller: Controller) -> str:
    """Try the controller again, and compare with its certificate number by number."""
    said = json.loads(controller.parts[CERTIFICATE])
    found = json.loads(to_json(certificate_of(controller)))
    for name, (written, again) in _numbers(said, found).items():
        if not (again == written or abs(again - written) <= CERTIFIED_TO * max(1.0, abs(again))):
            raise InputError(f"controller: its certificate says of {name}: {written}; allowed: {again}")
    worst = found["worst"]
    return (
        f"{worst['steps']:,} steps behind leaders that brake and attack, {worst['contacts']} contacts, "
        f"smallest gap {worst['smallest_gap']:.2f} m: as certified"
    )


def _numbers(said: Any, found: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Return all leaves of two JSON trees, by name; raise `InputError` where they are not alike."""
    if isinstance(found, dict) and isinstance(said, dict) and said.keys() == found.keys():
        pairs = [(said[key], found[key], f"{name}.{key}".strip(".")) for key in found]
    elif isinstance(found, list) and isinstance(said, list) and len(said) == len(found):
        pairs = [(one, two, f"{name}[{i}]") for i, (one, two) in enumerate(zip(said, found, strict=True))]
    elif isinstance(found, int | float) and isinstance(said, int | float):
        return {name: (said, found)}
    else:
        raise InputError(f"controller: its certificate says of {name or 'itself'}: {_short(said)}")
    return {key: pair for one, two, below in pairs for key, pair in _numbers(one, two, below).items()}


def _compare(who: str, found: np.ndarray, recorded: np.ndarray, tolerance: float) -> str:
    off = np.abs(found - recorded)
    if not (off <= tolerance).all():  # NaN is not either
        step = int(np.argmax(~(off <= tolerance)))
        raise InputError(
            f"controller: step {step} of its sample: {who} answers {found[step]:.9g} m/s2; "
            f"allowed: {recorded[step]:.9g} to {tolerance:g}"
        )
    return f"{len(found):,} decisions, {who} within {off.max(initial=0.0):.1e} m/s2 of what was recorded"


def graph_names(driver: Driver) -> tuple[list[str], list[str]]:
    """Return the names of a graph's inputs (state, memory) and outputs (acceleration, memory after it)."""
    remembered = [name for name, _ in leaves(driver.initial_memory(1))]
    inputs = [*driver.perceives, *(f"memory.{name}" for name in remembered)]
    return inputs, [ANSWER, *(f"next.{name}" for name in remembered)]


def check_graph(part: bytes, driver: Driver) -> None:
    """Raise `InputError` unless a graph has a controller's inputs and outputs, and only arithmetic between.

    Raises:
        MissingPartError: onnx is not installed.
    """
    onnx = needed("onnx")
    try:
        model = onnx.load_model_from_string(part)
    except Exception as error:  # protobuf's own kinds of error
        raise InputError(f"graph: cannot be read: {error}") from None
    graph, wanted = model.graph, graph_names(driver)
    found = [value.name for value in graph.input], [value.name for value in graph.output]
    if found != wanted:
        raise InputError(f"graph: inputs and outputs {found} are not allowed; allowed: {wanted}")
    if model.functions or graph.sparse_initializer:
        raise InputError("graph: functions and sparse weights are not allowed")
    tensors = list(graph.initializer)
    for node in graph.node:
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            raise InputError(f"graph: operator {node.op_type!r} is not allowed; allowed: arithmetic")
        tensors += [attribute.t for attribute in node.attribute if attribute.HasField("t")]
    if any(tensor.external_data or tensor.data_location for tensor in tensors):
        raise InputError("graph: weights in another file are not allowed")


def run_graph(part: bytes, driver: Driver, states: LocalState) -> Floats:
    """Return what a checked graph answers when it perceives `states` one after the other [m/s2].

    It begins with the first memory of `driver`, whose graph it is; all arrays have the shape (T,).

    Raises:
        InputError: onnxruntime refuses it.
        MissingPartError: onnxruntime is not installed.
    """
    runtime = needed("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    (inputs, _), answers = graph_names(driver), np.zeros(len(states.speed))
    memory: list[Any] = [rows for _, rows in leaves(driver.initial_memory(1))]
    try:
        session = runtime.InferenceSession(part, options, providers=["CPUExecutionProvider"])
        for step in range(len(answers)):
            now = states.at(slice(step, step + 1))
            seen = [getattr(now, name) for name in driver.perceives]
            acceleration, *memory = session.run(None, dict(zip(inputs, [*seen, *memory], strict=True)))
            answers[step] = acceleration[0]
    except Exception as error:  # the runtime's own kinds of error
        raise InputError(f"graph: cannot be run: {error}") from None
    return answers


def needed(name: str) -> Any:
    """Return a package that only graphs need; raise `MissingPartError` where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise MissingPartError(f"{name} is not installed; install it: pip install 'unjam[train]'") from None
