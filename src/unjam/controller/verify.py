"""Verification of a controller (`unjam verify`): its file is undamaged, and driver, sample and graph agree."""

import secrets
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from unjam.controller import file as archive
from unjam.controller.certificate import describe_worst_cases, make_certificate
from unjam.controller.domain import road_description
from unjam.controller.file import Controller, Floats, read_controller, read_sample, replay_states
from unjam.controller.manifest import PROVENANCE_ENTRIES, driver_interface, first_difference, graph_names, short_text
from unjam.drivers.check import random_state
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_recipe, user_code_recipes
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, MissingPartError, import_optional
from unjam.files import parse_json, reject_damaged, sha256_of, to_json
from unjam.onnx_models import check_model, open_session, parse_model, run_session
from unjam.text import format_count
from unjam.tree import leaves

REPLAY_TOLERANCE = 1e-9  # allowed difference between recorded and repeated accelerations [m/s2]
CERTIFICATE_TOLERANCE = 1e-6  # allowed difference between the numbers of a certificate and of repeated simulations
GRAPH_TOLERANCE = 1e-6  # allowed difference between graph and driver [m/s2]
BATCH_TOLERANCE = 1e-9  # allowed difference between equal rows [m/s2]: rounding depends on the size of a matrix
ONNX_OPSET, ONNX_IR_VERSIONS = 20, range(10, 14)  # version of the operators, and versions of the format, of graphs
MAX_GRAPH_ROWS = 50  # largest number of CAVs in one run of a graph
RANDOM_STATE_COUNT = 200  # number of random states on which graph and driver are compared

CheckStatus = Literal["checked", "absent", "stated", "not checked"]


@dataclass(frozen=True)
class PartCheck:
    """The verification result of one part of a controller."""

    part: str
    status: CheckStatus
    """`checked`: the part is right; `absent`: the controller has no such part; `stated`: only its maker can know the
    part; `not checked`: the part could not be checked on this machine"""
    detail: str  # how the part was checked, or why it was not checked


def verify_controller_file(path: Path | str, signer: Path | str | None = None) -> list[PartCheck]:
    """Return the results for each part of a `.unjam` file or a run folder; only trusted code runs.

    `signer` is the file with the public key of the required signature. Raise `InputError` for the first error or for
    code that is not trusted, and `MissingPartError` if a package is missing.
    """
    checks = check_parts(read_controller(path), signer)
    require_complete(checks)
    return checks


def require_complete(checks: list[PartCheck]) -> None:
    """Raise `MissingPartError` if a part of a controller could not be checked."""
    if missing := [f"{check.part}: not checked: {check.detail}" for check in checks if check.status == "not checked"]:
        raise MissingPartError(f"controller: {'; '.join(missing)}")


def check_parts(controller: Controller, signer: Path | str | None = None) -> list[PartCheck]:
    """Return the results as `verify_controller_file`, also for parts that cannot be checked on this machine."""
    with reject_damaged("verify"):
        signature_check = _check_signer(controller.signed_by, signer)
        dependent_parts = {archive.GRAPH_PART, archive.CERTIFICATE_PART} & controller.parts.keys()
        if dependent_parts and archive.SAMPLE_PART not in controller.parts:
            raise InputError(f"controller: has {min(dependent_parts)}, but no recorded sample to test it on")
        unlisted_parts = archive.MANIFEST_PART, archive.SIGNATURE_PART
        sizes = [f"{name} {len(part):,} bytes" for name, part in controller.parts.items() if name not in unlisted_parts]
        part_check = PartCheck("parts", "checked", f"{', '.join(sizes)}: each has the SHA-256 that the manifest names")
        checks = [part_check, signature_check, *_check_driver(controller), *_describe_provenance(controller)]
        return [*checks, _check_sample(controller), _check_graph(controller), _check_certificate(controller)]


def _check_signer(fingerprint: str | None, signer: Path | str | None) -> PartCheck:
    result = "it fits the manifest and every other part"
    if signer is None:
        if fingerprint is None:
            detail = "its maker is unknown, and a change together with all hashes is not detected"
            return PartCheck("signature", "absent", detail)
        warning = "the owner of the key was not checked: give the maker's public key (--signer)"
        return PartCheck("signature", "checked", f"{result}, by the key {fingerprint}; {warning}")
    from unjam.controller.signature import read_public_key  # loads cryptography, which is rarely needed

    required_fingerprint = read_public_key(Path(signer))
    if fingerprint != required_fingerprint:
        problem = "it is not signed" if fingerprint is None else f"it is signed by another key, {fingerprint}"
        raise InputError(f"controller: {problem}; allowed: signed by {str(signer)!r}, {required_fingerprint}")
    return PartCheck("signature", "checked", f"{result}, by {str(signer)!r}, the key {fingerprint}")


def _check_driver(controller: Controller) -> Iterator[PartCheck]:
    """Yield the results for the driver, its code, its weights, and its description in the manifest."""
    driver, manifest = controller.driver, controller.manifest
    recipe, arrays = driver_recipe(driver)
    stated_recipe, actual_recipe = manifest["driver"], parse_json(to_json(recipe))
    _require_same("manifest", first_difference(stated_recipe, actual_recipe, allows_missing=True, name="driver"))
    has_defaults = first_difference(stated_recipe, actual_recipe) is not None
    defaults = "; missing parameters have the defaults of this version" if has_defaults else ""
    yield PartCheck("driver", "checked", f"{driver.describe()}: built from all entries of its recipe{defaults}")
    if files := sorted({part["path"] for part in user_code_recipes(stated_recipe)}):
        detail = "trusted here, with the SHA-256 that the manifest names; its imports and its actions are not checked"
        yield PartCheck("code", "checked", f"{', '.join(short_text(path) for path in files)}: {detail}")
    else:
        yield PartCheck("code", "absent", "the controller is data, and contains no Python code")
    sha256 = sha256_of(controller.parts[archive.WEIGHTS_PART])
    if arrays:
        detail = f"{format_count(len(arrays), 'array')}, finite, of the required shapes, none superfluous"
        yield PartCheck("weights", "checked", f"{detail}; SHA-256 {sha256}")
    else:
        yield PartCheck("weights", "absent", f"the driver has no network; SHA-256 {sha256}")
    interface = parse_json(to_json(driver_interface(driver, manifest.get("action_limit"))))
    _require_same("manifest", first_difference({name: manifest[name] for name in interface}, interface))
    yield PartCheck("manifest", "checked", f"{', '.join(interface)}: equal to the interface of the driver")


def _describe_provenance(controller: Controller) -> list[PartCheck]:
    manifest = controller.manifest
    entries = [name for name in PROVENANCE_ENTRIES if name in manifest]
    if not entries:
        return [PartCheck("origin", "absent", "the manifest does not contain the origin of the controller")]
    names = f"{', '.join(entries)}, and unjam {short_text(manifest['unjam'])}"
    checks = [PartCheck("origin", "stated", f"{names}: the maker's statement: nothing in the file can prove it")]
    if road := road_description(manifest):
        step = manifest.get("time_step")
        others = [] if step is None else controller.driver.requirements().other_time_steps(step)
        mismatch = f"; a part of the driver has a time_step of {others[0]:g} s, not {step:g} s" if others else ""
        checks.append(PartCheck("road", "stated", f"made for the {road}{mismatch}"))
    return checks


def _check_sample(controller: Controller) -> PartCheck:
    if archive.SAMPLE_PART not in controller.parts:
        reason = "run folders and `unjam tune` record none, `unjam export` does"
        return PartCheck("sample", "absent", f"no recorded accelerations to repeat; {reason}")
    states, recorded = read_sample(controller.parts[archive.SAMPLE_PART])
    accelerations = replay_states(controller.driver, states, _action_limit(controller))
    error = _max_error("its driver", accelerations, recorded, REPLAY_TOLERANCE, "step {} of its sample")
    detail = f"the driver repeats them within {error:.1e} m/s2 (allowed {REPLAY_TOLERANCE:g})"
    return PartCheck("sample", "checked", f"{len(recorded):,} control steps: {detail}; their states are the maker's")


def _check_graph(controller: Controller) -> PartCheck:
    """Compare the graph with the recorded sample, and with the driver on states that no maker can choose."""
    if archive.GRAPH_PART not in controller.parts:
        return PartCheck("graph", "absent", "no ONNX graph; `unjam export --onnx` adds one")
    part, driver = controller.parts[archive.GRAPH_PART], controller.driver
    states, recorded = read_sample(controller.parts[archive.SAMPLE_PART])
    try:
        check_graph(part, driver)
        graph_accelerations = run_graph(part, driver, states)
        sample_error = _max_error("its graph", graph_accelerations, recorded, GRAPH_TOLERANCE, "step {} of its sample")
        random_states = _random_states(part, states)
        expected = replay_states(driver, random_states, _action_limit(controller))
        row_counts = 1, 2, 3 + secrets.randbelow(MAX_GRAPH_ROWS - 2)  # no maker can know the last one
        results = (run_graph(part, driver, random_states, rows) for rows in row_counts)
        error = max(_max_error("its graph", result, expected, GRAPH_TOLERANCE, "random state {}") for result in results)
    except MissingPartError as missing:
        return PartCheck("graph", "not checked", str(missing))
    detail = f"within {sample_error:.1e} m/s2 of the sample and {error:.1e} of the driver"
    detail += f" on {RANDOM_STATE_COUNT} random states, for {', '.join(map(str, row_counts))} CAVs at once"
    return PartCheck("graph", "checked", f"pure arithmetic; {detail} (allowed {GRAPH_TOLERANCE:g})")


def check_graph(part: bytes, driver: Driver) -> None:
    """Raise `InputError` unless a graph has the inputs and outputs of a controller and only arithmetic between them."""
    model = parse_model(part)
    check_model(model, len(part), range(ONNX_OPSET, ONNX_OPSET + 1), ONNX_IR_VERSIONS)
    graph, expected_names = model.graph, graph_names(driver)
    actual_names = [value.name for value in graph.input], [value.name for value in graph.output]
    if actual_names != expected_names:
        raise InputError(f"graph: inputs and outputs {actual_names} are not allowed; allowed: {expected_names}")
    types = {value.type.tensor_type.elem_type for value in (*graph.input, *graph.output)}
    if types != {import_optional("onnx").TensorProto.DOUBLE}:
        raise InputError("graph: inputs and outputs of another type are not allowed; allowed: float64")


def run_graph(part: bytes, driver: Driver, states: LocalState, rows: int = 1) -> Floats:
    """Return the accelerations of a checked graph for consecutive `states` [m/s2], all of shape (T,).

    The graph runs for `rows` CAVs with the same observation at once. Raise `InputError` if onnxruntime refuses the
    graph or the CAVs get different accelerations, and `MissingPartError` without onnxruntime.
    """
    (inputs, _), session, accelerations = graph_names(driver), open_session(part), list[Floats]()
    fields, memory = driver.requirements().input_fields, [array for _, array in leaves(driver.initial_memory(rows))]
    for step in range(len(states.speed)):
        row_states = states.select(np.full(rows, step))
        arrays = [*(getattr(row_states, name) for name in fields), *memory]
        acceleration, *memory = run_session(session, None, dict(zip(inputs, arrays, strict=True)))
        accelerations.append(acceleration)
    for acceleration in accelerations:
        if acceleration.shape != (rows,) or not (np.abs(acceleration - acceleration[0]) <= BATCH_TOLERANCE).all():
            raise InputError(f"graph: {rows} CAVs with the same observation get different answers")
    return np.array([acceleration[0] for acceleration in accelerations])


def _random_states(part: bytes, sample: LocalState) -> LocalState:
    """Return random states, equal for equal graphs; fields without random values have values of the sample."""
    generator = np.random.default_rng(int(sha256_of(part), 16))
    state = random_state(generator, RANDOM_STATE_COUNT, optional_fields=True)
    rows = generator.integers(len(sample.speed), size=RANDOM_STATE_COUNT)
    pairs = zip(sample, state, strict=True)
    return LocalState(*(old if old is None else old[rows] if new is None else new for old, new in pairs))


def _check_certificate(controller: Controller) -> PartCheck:
    if archive.CERTIFICATE_PART not in controller.parts:
        return PartCheck("certificate", "absent", "no worst cases were simulated; `unjam certify` does it")
    stated = parse_json(controller.parts[archive.CERTIFICATE_PART])  # before the simulations: it may be damaged
    actual = parse_json(to_json(make_certificate(controller)))
    _require_same("certificate", first_difference(stated, actual, CERTIFICATE_TOLERANCE))
    worst_cases = describe_worst_cases(actual, cast(FilteredDriver, controller.driver))
    return PartCheck("certificate", "checked", f"{worst_cases}: the same in repeated simulations")


def _action_limit(controller: Controller) -> float:
    """Return the largest absolute acceleration [m/s2]."""
    low, high = (controller.manifest["action"][end] for end in ("low", "high"))
    if low is None or high is None:
        raise InputError("controller: has a recorded sample, but its manifest names no bounds of its action")
    return max(-low, high)


def _require_same(part: str, difference: tuple[str, Any, Any] | None) -> None:
    """Raise `InputError` for a result of `first_difference`, unless it is None."""
    if difference is not None:
        name, stated, actual = difference
        entry = f"{part}.{name}" if name else part
        raise InputError(f"controller: {entry}: {short_text(stated)} is not allowed; allowed: {short_text(actual)}")


def _max_error(source: str, actual: Floats, expected: Floats, tolerance: float, location: str) -> float:
    """Return the largest difference of accelerations [m/s2]; raise `InputError` if it exceeds the tolerance."""
    errors = np.abs(actual - expected)
    if not (errors <= tolerance).all():  # also for NaN
        row = int(np.argmax(~(errors <= tolerance)))
        answer_text, allowed = f"{source} answers {actual[row]:.9g} m/s2", f"{expected[row]:.9g} to {tolerance:g}"
        raise InputError(f"controller: {location.format(row)}: {answer_text}; allowed: {allowed}")
    return float(errors.max())
