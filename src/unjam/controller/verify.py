"""Is a controller undamaged, does it do what it says, and do its forms agree: `unjam verify`.

Its forms are its driver, a recorded sample (what a CAV perceived in an episode, and what the controller
answers to it), an ONNX graph and a certificate. Each part of a controller gets one line, which says how it
was checked, that it is absent, that it is a statement of the maker, or that it could not be checked here.
"""

import json
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unjam.controller.certificate import make_certificate
from unjam.controller.domain import road_description, step_mismatch
from unjam.controller.file import (
    CERTIFICATE_PART,
    GRAPH_PART,
    MANIFEST_PART,
    SAMPLE_PART,
    SIGNATURE_PART,
    WEIGHTS_PART,
    Controller,
    Floats,
    read_controller,
    read_sample,
    replay_states,
    sha256_of,
)
from unjam.controller.graph import check_graph, run_graph
from unjam.controller.manifest import PROVENANCE_ENTRIES, driver_interface, first_difference, short_text
from unjam.drivers.check import random_state
from unjam.drivers.local_state import LocalState
from unjam.drivers.registry import driver_recipe, user_code_recipes
from unjam.errors import InputError, MissingPartError
from unjam.files import parse_json, reject_damaged, to_json

REPLAY_TOLERANCE = 1e-9
"""how far the recorded accelerations may be from those of this machine [m/s2]"""
CERTIFICATE_TOLERANCE = 1e-6
"""how far a certificate's numbers may be from those of this machine"""
GRAPH_TOLERANCE = 1e-6
"""how far the graph may be from the driver [m/s2]"""
MAX_GRAPH_ROWS = 50
"""CAVs for which a graph is run at once, at most"""
RANDOM_STATE_COUNT = 200
"""random states on which graph and driver are compared, besides the maker's sample"""

CheckStatus = Literal["checked", "absent", "stated", "not checked"]


@dataclass(frozen=True)
class PartCheck:
    """What is known of one part of a controller."""

    part: str
    status: CheckStatus
    """`checked`: it was, and is right; `missing_neighbors`: the controller has no such part; `stated`: only its maker
    can know it; `not checked`: it could not be checked on this machine"""
    detail: str
    """how it was checked, or what it means that it was not"""


def verify_controller_file(path: Path | str, signer: Path | str | None = None) -> list[PartCheck]:
    """Return what is known of each part of a `.unjam` file or a run folder; only trusted code runs.

    Args:
        path: the file, or the folder.
        signer: file of the public key that must have signed it; None allows any key, and no signature.

    Raises:
        InputError: the first thing that is wrong, in one line; also where there is code that is not trusted.
        MissingPartError: a part could not be checked, as a package is not installed.
    """
    checks = check_parts(read_controller(path), signer)
    require_complete(checks)
    return checks


def require_complete(checks: list[PartCheck]) -> None:
    """Raise `MissingPartError` where a part of a controller could not be checked."""
    if missed := [f"{each.part}: not checked: {each.detail}" for each in checks if each.status == "not checked"]:
        raise MissingPartError(f"controller: {'; '.join(missed)}")


def check_parts(controller: Controller, signer: Path | str | None = None) -> list[PartCheck]:
    """Return what is known of each part of a controller; arguments and errors as `verify_controller`.

    A part that cannot be checked on this machine is no error here: its status says so.
    """
    with reject_damaged("verify"):
        signature = _check_signer(controller.signed_by, signer)
        without_sample = (
            {GRAPH_PART, CERTIFICATE_PART} & controller.parts.keys() if SAMPLE_PART not in controller.parts else ()
        )
        if without_sample:
            raise InputError(f"controller: has {min(without_sample)}, but no recorded sample to try it on")
        return [
            _describe_archive(controller),
            signature,
            _check_recipe(controller),
            _describe_code(controller),
            _describe_weights(controller),
            _check_interface(controller),
            *_describe_provenance(controller),
            _check_sample(controller),
            _check_graph(controller),
            _check_certificate(controller),
        ]


def _describe_archive(controller: Controller) -> PartCheck:
    """Return the parts of the archive; their hashes were compared as it was read."""
    parts = {name: part for name, part in controller.parts.items() if name not in (MANIFEST_PART, SIGNATURE_PART)}
    sizes = ", ".join(f"{name} {len(part):,} bytes" for name, part in parts.items())
    return PartCheck("parts", "checked", f"{sizes}: each has the SHA-256 that the manifest names")


def _check_signer(actual: str | None, signer: Path | str | None) -> PartCheck:
    """Return who signed a controller; raise `InputError` where that is not `signer`."""
    over = "it fits the manifest and every other part"
    if signer is None:
        if actual is None:
            unknown = "its maker is unknown, and a change together with all hashes is not noticed"
            return PartCheck("signature", "absent", f"nothing shows who made the controller: {unknown}")
        owner = "whose key that is was not checked: give the maker's public key (--signer)"
        return PartCheck("signature", "checked", f"{over}, by the key {actual}; {owner}")
    from unjam.controller.signature import read_public_key  # it loads cryptography, which few need

    wanted = read_public_key(Path(signer))
    if actual != wanted:
        how = "it is not signed" if actual is None else f"it is signed by another key, {actual}"
        raise InputError(f"controller: {how}; allowed: signed by {str(signer)!r}, {wanted}")
    return PartCheck("signature", "checked", f"{over}, by {str(signer)!r}, the key {actual}")


def _check_recipe(controller: Controller) -> PartCheck:
    """Compare the recipe of the manifest with that of the driver which was made of it."""
    said, found = controller.manifest["driver"], _json_roundtrip(driver_recipe(controller.driver)[0])
    _require_same("manifest", first_difference(said, found, allows_missing=True, name="driver"))
    left_out = first_difference(said, found)
    defaults = "; what it leaves out has this version's default" if left_out else ""
    driver = controller.driver.describe()
    return PartCheck("driver", "checked", f"{driver}: made of its recipe, nothing of which was ignored{defaults}")


def _describe_code(controller: Controller) -> PartCheck:
    """Return which Python code a controller runs; hash and trust were checked before it was read."""
    files = sorted({each["path"] for each in user_code_recipes(controller.manifest["driver"])})
    if not files:
        return PartCheck("code", "absent", "the controller is data: none of it is Python code")
    named = ", ".join(short_text(path) for path in files)
    unchanged = "it is trusted here, with the SHA-256 that the manifest names; what it imports or does is not"
    return PartCheck("code", "checked", f"{named}: {unchanged} checked")


def _describe_weights(controller: Controller) -> PartCheck:
    """Return that there are weights; their shapes and values were checked as the driver was made."""
    part, arrays = controller.parts[WEIGHTS_PART], controller.driver.weights()
    if not arrays:
        return PartCheck("weights", "absent", f"the driver has no network; SHA-256 {sha256_of(part)}")
    fit = "finite, of the shapes that the driver needs, none left over"
    return PartCheck("weights", "checked", f"{len(arrays)} arrays, {fit}; SHA-256 {sha256_of(part)}")


def _check_interface(controller: Controller) -> PartCheck:
    """Compare what the manifest says of the driver with what the driver says of itself."""
    found = _json_roundtrip(driver_interface(controller.driver, controller.manifest.get("action_limit")))
    said = {name: controller.manifest[name] for name in found}
    _require_same("manifest", first_difference(said, found))
    return PartCheck("manifest", "checked", f"{', '.join(found)}: as the driver describes itself")


def _describe_provenance(controller: Controller) -> list[PartCheck]:
    """Return what only the maker of a controller can know."""
    manifest = controller.manifest
    stated = [name for name in PROVENANCE_ENTRIES if name in manifest]
    if not stated:
        return [PartCheck("origin", "absent", "the manifest does not say where the controller comes from")]
    nobody = "the maker's statement: nothing in the file can prove it"
    checks = [
        PartCheck("origin", "stated", f"{', '.join(stated)}, and unjam {short_text(manifest['unjam'])}: {nobody}")
    ]
    if road := road_description(manifest):
        once = {"simulation_step": manifest.get("time_step", 0.0), "steps_per_control_step": 1}
        other = step_mismatch(controller.driver, once) if "time_step" in manifest else ""
        checks.append(PartCheck("road", "stated", f"made for the {road}{other and f'; the driver {other}'}"))
    return checks


def _check_sample(controller: Controller) -> PartCheck:
    """Compare the driver with the recorded sample."""
    if SAMPLE_PART not in controller.parts:
        why = "a run folder and `unjam tune` record none"
        return PartCheck("sample", "absent", f"no recorded accelerations to repeat; {why}, `unjam export` does")
    states, recorded = read_sample(controller.parts[SAMPLE_PART])
    answers = replay_states(controller.driver, states, _action_limit(controller))
    off = _max_error("its driver", answers, recorded, REPLAY_TOLERANCE)
    again = f"the driver repeats them within {off:.1e} m/s2 (allowed {REPLAY_TOLERANCE:g})"
    return PartCheck("sample", "checked", f"{len(recorded):,} decisions: {again}; their states are the maker's")


def _check_graph(controller: Controller) -> PartCheck:
    """Compare the graph with the recorded sample, and with the driver on states that no maker can choose."""
    if GRAPH_PART not in controller.parts:
        return PartCheck("graph", "absent", "no ONNX graph; `unjam export --onnx` draws one")
    part, driver = controller.parts[GRAPH_PART], controller.driver
    states, recorded = read_sample(controller.parts[SAMPLE_PART])
    try:
        check_graph(part, driver)
        off = _max_error("its graph", run_graph(part, driver, states), recorded, GRAPH_TOLERANCE)
        drawn = _random_states(part, states)
        answers = replay_states(driver, drawn, _action_limit(controller))
        counts = 1, 2, 3 + secrets.randbelow(MAX_GRAPH_ROWS - 2)  # of which no maker can know
        off_drawn = max(
            _max_error("its graph", run_graph(part, driver, drawn, rows), answers, GRAPH_TOLERANCE, "random state")
            for rows in counts
        )
    except MissingPartError as error:
        return PartCheck("graph", "not checked", str(error))
    found = (
        f"within {off:.1e} m/s2 of the sample and {off_drawn:.1e} of the driver on {RANDOM_STATE_COUNT} random states"
    )
    found += f", for {', '.join(map(str, counts))} CAVs at once"
    return PartCheck("graph", "checked", f"arithmetic alone; {found} (allowed {GRAPH_TOLERANCE:g})")


def _random_states(part: bytes, states: LocalState) -> LocalState:
    """Return random states, the same for the same graph; what none are drawn of is as in the sample."""
    generator = np.random.default_rng(int(sha256_of(part), 16))
    drawn, rows = (
        random_state(generator, RANDOM_STATE_COUNT, optional_fields=True),
        generator.integers(len(states.speed), size=RANDOM_STATE_COUNT),
    )
    return LocalState(
        *(
            values if values is None else values[rows] if random is None else random
            for values, random in zip(states, drawn, strict=True)
        )
    )


def _check_certificate(controller: Controller) -> PartCheck:
    """Try the controller again, and compare with its certificate number by number."""
    if CERTIFICATE_PART not in controller.parts:
        return PartCheck("certificate", "absent", "no worst cases were tried; `unjam certify` does")
    said = parse_json(controller.parts[CERTIFICATE_PART])
    found = _json_roundtrip(make_certificate(controller))
    _require_same("certificate", first_difference(said, found, CERTIFICATE_TOLERANCE))
    worst = found["worst_cases"]
    tried = f"{worst['steps']:,} steps behind leaders that brake and attack, {worst['contacts']} contacts"
    gap = f"smallest gap {worst['min_gap']:.2f} m"
    return PartCheck("certificate", "checked", f"{tried}, {gap}: tried again with this driver, as certified")


def _action_limit(controller: Controller) -> float:
    """Return how large an acceleration may be [m/s2]."""
    low, high = (controller.manifest["action"][end] for end in ("low", "high"))
    if low is None or high is None:
        raise InputError("controller: has a recorded sample, but its manifest names no bounds of its action")
    return max(-low, high)


def _json_roundtrip(value: Any) -> Any:
    """Return a document as it is once it was written and read."""
    return json.loads(to_json(value))


def _require_same(part: str, difference: tuple[str, Any, Any] | None) -> None:
    """Raise `InputError` where a document says something else than is found."""
    if difference is not None:
        name, said, found = difference
        allowed = f"{short_text(said)}; allowed: {short_text(found)}"
        raise InputError(f"controller: its {part} says of {name or 'itself'}: {allowed}")


def _max_error(form: str, actual: Floats, recorded: Floats, tolerance: float, step_label: str = "step") -> float:
    """Return how far accelerations are from those wanted [m/s2]; raise `InputError` above the tolerance."""
    off = np.abs(actual - recorded)
    if not (off <= tolerance).all():  # NaN is not either
        step = int(np.argmax(~(off <= tolerance)))
        place = f"{step_label} {step}" if step_label != "step" else f"step {step} of its sample"
        raise InputError(
            f"controller: {place}: {form} answers {actual[step]:.9g} m/s2; "
            f"allowed: {recorded[step]:.9g} to {tolerance:g}"
        )
    return float(off.max())
