"""Files of controllers: `unjam export`, `certify`, `verify`, `keys` and `sign`."""

import logging
import os
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from rich.markup import escape
from typer import Argument, Option

from unjam.cli.options import JsonOption, ScenarioSettingsOption, check_page_path, parse_settings
from unjam.cli.output import console, err_console, print_json
from unjam.controller.file import (
    PACKAGED_PREFIX,
    Controller,
    add_certificate,
    add_signature,
    check_unsigned,
    controller_file,
    read_controller,
)
from unjam.controller.verify import check_parts, require_complete
from unjam.drivers.wrappers import FilteredDriver
from unjam.errors import InputError, invalid_value
from unjam.files import atomic_write, check_parent_folder, remove
from unjam.processes import continue_in_limited_child
from unjam.scenarios import scenario_from_recipe
from unjam.training.export import (
    export_controller,
    has_default_actuator,
    measure_test_episode,
    read_exported_controller,
)
from unjam.training.run_folder import check_controller


def export_command(
    source: Annotated[str, Argument(help="Folder of a training run, or any driver as in drive --driver.")],
    out: Annotated[Path, Option("--out", help="File to write, ending in .unjam.")],
    onnx: Annotated[
        bool, Option("--onnx", help="Add the ONNX graph of the whole controller, also as a separate file.")
    ] = False,
    stable_baselines3: Annotated[
        bool, Option("--sb3", help="Write the residual as a model of Stable-Baselines3, too: a .zip file.")
    ] = False,
    scenario: Annotated[
        str, Option(help="Scenario that defines the control step and limits of a driver.", show_default="ring")
    ] = "",
    settings: ScenarioSettingsOption = None,
    json: JsonOption = False,
) -> None:
    """Write a controller into one file that contains everything to run it elsewhere.

    The manifest in the file lists the inputs with their units, the memory, and evaluation results. The file also
    contains a sample of a test episode, on which `unjam verify` compares all forms of the controller.

    Examples:

    - unjam export runs/ring-001 --out ring.unjam
    - unjam export runs/ring-001 --out ring.unjam --onnx --sb3
    - unjam export pi:window=30 --scenario merge --out pi.unjam
    - unjam export unjam:ring-best --set actuator.delay=0.4 --out my-car.unjam     (with the filter for this car)
    """
    if onnx:  # its messages do not help users
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    changes = parse_settings(settings)
    result = export_controller(source, out, onnx, scenario, stable_baselines3, changes)
    if json:
        files = {"file": result.file, "onnx": result.graph, "stable_baselines3": result.model}
        names = {name: str(file) if file else None for name, file in files.items()}
        print_json({**names, "driver": result.driver, "control_steps": result.sample_steps})
        return
    for file in filter(None, (result.file, result.graph, result.model)):
        console.print(f"{file}: {file.stat().st_size:,} bytes")
    graph = out.with_suffix(".onnx")
    is_source = source.endswith((".onnx", ".toml")) and Path(source).with_suffix(".onnx").resolve() == graph.resolve()
    if result.graph is None and graph.exists() and not is_source:
        err_console.print(f"note: {graph} is not the graph of this controller; --onnx writes the graph")
    actuator = f", {result.actuator}" if result.actuator else ""
    steps = f"{result.sample_steps:,} control steps of a test episode"
    err_console.print(f"{result.driver}{actuator}, verified on {steps}")


def certify_command(
    file: Annotated[
        Path, Argument(help="Exported .unjam file, to which the certificate is added; or a packaged controller.")
    ],
    out: Annotated[
        Path | None, Option("--out", help="HTML file to write.", show_default="the name of the file with .html")
    ] = None,
    settings: Annotated[
        list[str] | None, Option("--set", help="Setting of the road of a packaged controller: actuator.delay=0.4.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Certify a controller: proven properties, worst cases, comfort, string stability, operating domain.

    In the tests, leaders brake to a standstill from every state of the sample, an adversarial leader searches
    for contact, and leaders oscillate at many frequencies. The certificate becomes a part of the file, and
    `unjam verify` checks it. A signed file is refused. A packaged controller is not modified: it is tested with
    the safety filter and the actuator of its road.

    Examples:

    - unjam certify ring.unjam
    - unjam certify unjam:ring-tuned
    - unjam certify unjam:ring-best --set actuator.delay=0.4     (with the filter for this car)
    """
    from unjam.controller.certificate import (
        describe_string_stability,
        describe_worst_cases,
        falls_behind,
        make_certificate,
    )

    if out is not None:
        check_page_path(out)
    is_packaged = str(file).startswith(PACKAGED_PREFIX)
    if settings and not is_packaged:
        raise invalid_value("set", settings[0], "a packaged controller, or a file of unjam export --set")
    changes = parse_settings(settings)
    controller = _read_packaged_for_car(str(file), changes) if is_packaged else read_controller(file)
    check_controller(file, "certify")
    file = controller_file(file)
    target = out or (Path(file.name) if is_packaged else file).with_suffix(".html")
    check_parent_folder(target)
    check_unsigned(controller)
    from unjam.reports.certificate import is_certificate_page, write_certificate_page  # loads matplotlib

    if out is None and os.path.lexists(target) and not is_certificate_page(target):
        raise InputError(f"out: {str(target)!r} exists and is no certificate; allowed: --out with the page to write")

    certificate = make_certificate(controller)
    assert isinstance(controller.driver, FilteredDriver)  # only such drivers are certified
    verdict = describe_string_stability(certificate, controller.driver)
    previous_page = target.read_bytes() if target.is_file() else None
    # If the page cannot be written, the controller must stay unchanged.
    write_certificate_page(file.name, controller.driver, certificate, verdict, target)
    if not is_packaged:
        try:
            add_certificate(file, controller, certificate)
        except BaseException:  # else the page shows a certificate that the controller does not contain
            remove(target) if previous_page is None else atomic_write(target, previous_page)
            raise
    if json:
        print_json({"file": str(file), "page": str(target), "certificate": certificate})
        return
    console.print(verdict)
    for point in certificate["string_stability"]:
        gain = f"gain {max(point['gains']):.3f} at {point['peak_frequency']:.3g} Hz"
        console.print(f"  at {point['speed']:g} m/s: {'falls behind its leader' if falls_behind(point) else gain}")
    console.print(describe_worst_cases(certificate, controller.driver))
    if is_packaged:
        row = measure_test_episode(controller)
        console.print(f"a test episode of {row['steps']:,} control steps in this car: {row['feasibility']}")
    err_console.print(f"page: {target}")


def _read_packaged_for_car(name: str, settings: dict[str, Any]) -> Controller:
    """Return a packaged controller with the safety filter and the car of its road, and a sample for this car."""
    controller = read_controller(Path(name))
    recipe = controller.manifest.get("scenario")
    if recipe is None:
        raise invalid_value("file", name, "a controller for one road: it selects its controller by the road")
    has_default_car = has_default_actuator(scenario_from_recipe(recipe))
    if isinstance(controller.driver, FilteredDriver) and has_default_car and not settings:
        return controller
    return read_exported_controller(name, settings)


def verify_command(
    file: Annotated[Path, Argument(help=".unjam file, or folder of a training run.")],
    signer: Annotated[
        Path | None, Option(help="Public key (.pub) of the required signer.", show_default="any, or no signature")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check each part of a controller: hashes, signature, driver, and agreement of its forms on its sample.

    Each line gives the status of a part: checked and how, absent, or stated by the author and not verifiable. The
    exit code is 2 if a check fails or a folder names Python code that is not trusted, and 3 if a check needs a package
    that is not installed.

    Examples:

    - unjam verify ring.unjam
    - unjam verify ring.unjam --signer maker.pub     (signed with this key, or exit code 2)
    - unjam verify runs/mine --trust-code            (its expert is a Python file that you trust)
    """
    continue_in_limited_child(f"controller: {str(file)!r}")
    controller = read_controller(file)
    checks = check_parts(controller, signer)
    if json:
        signatures = {"signed_by": controller.signed_by, "signer": None if signer is None else str(signer)}
        is_complete = all(check.status != "not checked" for check in checks)
        print_json({"file": str(file), "ok": is_complete, **signatures, "parts": [asdict(check) for check in checks]})
    else:
        colors = {"checked": "green", "not checked": "red", "absent": "yellow", "stated": "cyan"}
        for check in checks:
            status = f"[{colors[check.status]}]{check.status}[/]"
            console.print(f"{status} {check.part}: {escape(check.detail)}", markup=True)
    require_complete(checks)


def keys_command(
    name: Annotated[Path, Argument(help="Path of the two files to write, without suffix.")], json: JsonOption = False
) -> None:
    """Make a key pair to sign controllers: NAME.key, which you must keep secret, and NAME.pub for others.

    Existing files are not overwritten. The key has no password: only your user can read it, and anyone with a copy
    can sign in your name.

    Example:

    - unjam keys maker
    """
    from unjam.controller.signature import make_keys

    keys = make_keys(name)
    if json:
        print_json({"private": str(keys.private), "public": str(keys.public), "fingerprint": keys.fingerprint})
        return
    console.print(f"{keys.private}: keep it secret", soft_wrap=True)
    console.print(f"{keys.public}: for verification by others; fingerprint {keys.fingerprint}", soft_wrap=True)


def sign_command(
    file: Annotated[Path, Argument(help=".unjam file, to which the signature is added.")],
    key: Annotated[Path, Option(help="Private key (.key) of `unjam keys`.")],
    overwrite: Annotated[bool, Option("--replace", help="Replace a signature with another key.")] = False,
    json: JsonOption = False,
) -> None:
    """Sign a controller, so that others can verify its author and that the file has not been changed.

    The signature becomes a part of the file, and is checked whenever the file is read. Certify before signing: a
    signed file cannot be certified.

    Examples:

    - unjam sign ring.unjam --key maker.key
    - unjam verify ring.unjam --signer maker.pub
    """
    from unjam.controller.signature import fingerprint_of, read_private_key

    if os.path.isdir(file):
        raise invalid_value("file", str(file), "a .unjam file")
    private, controller = read_private_key(key), read_controller(file)
    fingerprint, previous = fingerprint_of(private.public_key()), controller.signed_by
    if previous not in (None, fingerprint) and not overwrite:
        allowed = f"a file without the signature of another key (it is signed by {previous}); or --replace"
        raise invalid_value("file", str(file), allowed)
    add_signature(file, controller, private)
    if json:
        print_json({"file": str(file), "fingerprint": fingerprint, "previous_fingerprint": previous})
        return
    console.print(f"{file}: signed by {fingerprint}", soft_wrap=True)
    if os.name == "posix" and key.stat().st_mode & 0o077:
        err_console.print(f"note: other users of this machine can read {key}: chmod 600", soft_wrap=True)
