"""Controllers: `unjam evaluate`, `model`, `report`, `export`, `certify`, `verify`, `keys` and `sign`."""

import logging
import os
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from unjam.cli.options import DEFAULT_WORKERS, HumansOption, JsonOption, WorkersOption, network_changes
from unjam.cli.output import ProgressReporter, console, err_console, new_table, print_json, print_metrics, print_notes
from unjam.errors import InputError, invalid_value, resume_hint
from unjam.processes import check_not_locked, continue_in_limited_child, lock_folder


def evaluate_command(
    run: Annotated[Path, Argument(help="Folder of a training run.")],
    episodes: Annotated[int, Option("--episodes", "-n", min=1, help="Test episodes per driver.")] = 20,
    humans: HumansOption = None,
    out: Annotated[Path | None, Option(help="Folder for the results.", show_default="the run's own")] = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    json: JsonOption = False,
) -> None:
    """Compare a trained controller with every expert and the human baseline on fixed test seeds.

    The evaluation and the report of the run are replaced, unless --out names another folder. Other human
    drivers (--humans) require another folder.

    Examples:

    - unjam evaluate runs/ring-001
    - unjam evaluate runs/ring-001 --episodes 50 --json
    - unjam evaluate runs/ring-001 --humans drivers.json --out runs/other-drivers
    """
    from unjam.drivers.registry import DRIVERS
    from unjam.reports.results import read_results
    from unjam.training.evaluate import evaluate_run, evaluation_steps, gain_over_expert
    from unjam.training.run_folder import check_run_files, lock_new_folder, read_config
    from unjam.worlds.worker_pool import WorkerPool

    if humans is not None and out is None:
        raise InputError("humans: it is not allowed without --out: the run keeps its own evaluation")
    config = read_config(run)
    check_run_files(run, config)
    evaluation = replace(config.evaluation, baselines=tuple(DRIVERS), episodes=episodes)
    options = {**config.scenario_options, **network_changes(humans=humans)}
    config = replace(config, scenario_options=options, evaluation=evaluation)
    if config.tasks:
        raise InputError(f"run: {str(run)!r} has several roads; allowed: the folder of one of them")
    if not (run / "controller.unjam").is_file():
        raise InputError(f"run: {str(run)!r} has no controller yet{resume_hint(run)}")
    from unjam.reports.html import write_report_page  # loads matplotlib, so only after the checks
    from unjam.reports.summary import main_finding

    total = evaluation_steps(config, run)
    target = out or run
    with lock_folder(target) if out is None else lock_new_folder(out):
        with ProgressReporter("evaluating", "steps", total) as progress, WorkerPool(workers) as pool:
            evaluation = evaluate_run(run, config, pool, progress.update, out)
        page = write_report_page([target], target / "report.html")
    results = read_results(target)
    if json:
        gain, means = gain_over_expert(config, evaluation.rows), evaluation.means()
        facts = {"run": str(run), "scenario": config.scenario, "gain": asdict(gain) if gain else None}
        drivers = [{"driver": one, "episodes": rows, "mean": means[one]} for one, rows in evaluation.rows.items()]
        print_json({**facts, "drivers": drivers, "notes": results.metadata["notes"]})
        return
    print_metrics(evaluation.rows)
    console.print(main_finding(results), soft_wrap=True)
    print_notes(results.metadata["notes"])
    err_console.print(f"report: {page}")


def model_command(
    run: Annotated[Path, Argument(help="Folder of a training run with a learned model.")], json: JsonOption = False
) -> None:
    """Show the errors of a run's learned model relative to the environment.

    Errors are root mean squares on episodes that no network was trained on; for comparison, the errors of the
    base model alone and the magnitude of the predicted changes. For a model of whole roads, the command compares
    the waves in model rollouts and in a recorded episode with the same start. The figures are in the run's
    report, which is replaced.

    Examples:

    - unjam model runs/ring-001
    - unjam model runs/ring-001 --json
    """
    from matplotlib import get_cachedir

    continue_in_limited_child(f"model: {run}", run, Path(get_cachedir()))
    from unjam.reports import model
    from unjam.reports.html import write_report_page
    from unjam.reports.results import read_progress
    from unjam.training.model_facts import update_model_facts
    from unjam.training.run_folder import read_config

    config = read_config(run)
    with lock_folder(run):
        facts = update_model_facts(run, config)
        is_evaluated = (run / "evaluation.json").is_file()
        report = write_report_page([run], run / "report.html") if is_evaluated else None
    if json:
        print_json({"run": str(run), "report": str(report) if report else None, **facts})
        return
    lines = [model.rollout_summary(read_progress(run))]
    if "waves" in facts:
        table = new_table(("second half of the episode",), model.WAVE_HEADINGS)
        for label, row in model.wave_rows(facts):
            table.add_row(label, *row)
    else:
        table = new_table(("root mean square", "unit"), model.error_headings(facts))
        for row in model.error_rows(facts):
            table.add_row(row["label"], row["unit"], *row["cells"])
        lines = [model.error_verdict(facts), *lines, model.bound_summary(facts)]
    console.print(table)
    for line in lines:
        console.print(line)
    err_console.print(f"report: {report}" if report else f"no report before the end of the training: --resume {run}")


def report_command(
    folders: Annotated[list[Path], Argument(help="Folders of results: of training runs, or of drive.")],
    out: Annotated[
        Path | None,
        Option("--out", help="The page.", show_default="report.html in the folder, or comparison.html here"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write the report of a folder of results, or a comparison of several: one HTML page that works offline.

    Examples:

    - unjam report runs/ring-001
    - unjam report runs/ring-001 runs/ring-002 --out compared.html
    """
    from matplotlib import get_cachedir

    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"report: {str(folder)!r} is not a folder; allowed: one with results")
    target = out or (folders[0] / "report.html" if len(folders) == 1 else Path("comparison.html"))
    _check_page_path(target)
    continue_in_limited_child(f"report: {', '.join(map(str, folders))}", target.absolute().parent, Path(get_cachedir()))
    from unjam.reports.html import write_report_page

    if target.parent in folders:
        check_not_locked(target.parent)
    page = write_report_page(folders, target)
    if json:
        print_json({"report": str(page), "folders": [str(folder) for folder in folders]})
    else:
        console.print(str(page))


def _check_page_path(path: Path) -> None:
    """Raise `InputError` unless the path is that of a page, so that no other file is overwritten."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise invalid_value("out", str(path), "a file that ends in .html")


def export_command(
    source: Annotated[str, Argument(help="Folder of a training run; or any driver, as in drive --driver.")],
    out: Annotated[Path, Option("--out", help="The file to write; ends in .unjam.")],
    onnx: Annotated[
        bool, Option("--onnx", help="Add the ONNX graph of the whole controller, also as a separate file.")
    ] = False,
    scenario: Annotated[
        str, Option(help="Scenario that defines control step and limits of a plain driver.", show_default="ring")
    ] = "",
    json: JsonOption = False,
) -> None:
    """Write a controller into one file with all that is needed to run it elsewhere.

    Its manifest lists inputs in order and with units, memory, and evaluation results. It contains a sample of a
    test episode, on which `unjam verify` compares all forms of the controller.

    Examples:

    - unjam export runs/ring-001 --out ring.unjam
    - unjam export runs/ring-001 --out ring.unjam --onnx
    - unjam export pi:window=30 --scenario merge --out pi.unjam
    """
    from unjam.training.export import export_controller

    if onnx:  # messages of the exporter are of no use to users
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    result = export_controller(source, out, onnx, scenario)
    if json:
        files = {"file": str(result.file), "onnx": str(result.graph) if result.graph else None}
        print_json({**files, "driver": result.driver, "control_steps": result.sample_steps})
        return
    for file in filter(None, (result.file, result.graph)):
        console.print(f"{file}: {file.stat().st_size:,} bytes")
    if result.graph is None and (older := out.with_suffix(".onnx")).exists():
        err_console.print(f"{older} is older: it is not the graph of this controller; --onnx writes that one")
    err_console.print(f"{result.driver}, verified on {result.sample_steps:,} control steps of a test episode")


def certify_command(
    file: Annotated[Path, Argument(help="An exported .unjam file; the certificate is added to it.")],
    out: Annotated[
        Path | None, Option("--out", help="The page to write.", show_default="next to the file, ending in .html")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Certify a controller: proven properties, worst cases, comfort, string stability, operating domain.

    Leaders brake to a standstill from every state of its sample, an adversarial leader searches for contact,
    and others oscillate at all frequencies. The certificate becomes a part of the file, which `unjam verify`
    checks again; a signed file is refused.

    Example:

    - unjam certify ring.unjam
    """
    from unjam.controller.certificate import make_certificate
    from unjam.controller.file import add_certificate, check_unsigned, controller_file, read_controller
    from unjam.drivers.wrappers import FilteredDriver
    from unjam.files import check_parent_folder

    if out is not None:
        _check_page_path(out)
    controller, file = read_controller(file), controller_file(file)
    target = out or file.with_suffix(".html")
    check_parent_folder(target)
    check_unsigned(controller)
    from unjam.reports.certificate import write_certificate_page  # loads matplotlib

    certificate = make_certificate(controller)
    add_certificate(file, controller, certificate)
    assert isinstance(controller.driver, FilteredDriver)  # only such drivers are certified
    write_certificate_page(file.name, controller.driver, certificate, target)
    if json:
        print_json({"file": str(file), "page": str(target), "certificate": certificate})
        return
    worst = certificate["worst_cases"]
    tests = f"{worst['steps']:,} steps behind braking and adversarial leaders: {worst['contacts']} contacts"
    console.print(f"{tests}, min gap {worst['min_gap']:.2f} m", soft_wrap=True)
    err_console.print(f"page: {target}")


def verify_command(
    file: Annotated[Path, Argument(help="A .unjam file, or the folder of a training run.")],
    signer: Annotated[
        Path | None, Option(help="Public key (.pub) of the required signer.", show_default="any, or no signature")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check each part of a controller: hashes, signature, driver, and that its forms agree on its sample.

    Each line shows that a part was checked and how, that it is absent, or that only its maker states it. Exit
    code 2 and one line if something is wrong, or if a folder names Python code that is not trusted; exit code 3
    if a part could not be checked because a package is not installed.

    Examples:

    - unjam verify ring.unjam
    - unjam verify ring.unjam --signer maker.pub     (signed with this key, or exit code 2)
    - unjam verify runs/mine --trust-code            (its expert is a Python file that you trust)
    """
    from rich.markup import escape

    continue_in_limited_child(f"controller: {str(file)!r}")
    from unjam.controller.file import read_controller
    from unjam.controller.verify import check_parts, require_complete

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
    name: Annotated[Path, Argument(help="Path of both files without their suffix.")], json: JsonOption = False
) -> None:
    """Make a key pair to sign controllers with: NAME.key, which you keep secret, and NAME.pub for others.

    Existing files are never overwritten. Anyone with NAME.key can sign in your name: it has no password, and only
    you can read it.

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
    file: Annotated[Path, Argument(help="A .unjam file; the signature is added to it.")],
    key: Annotated[Path, Option(help="Private key (.key) of `unjam keys`.")],
    overwrite: Annotated[bool, Option("--replace", help="Replace the signature of another key.")] = False,
    json: JsonOption = False,
) -> None:
    """Sign a controller, so that others can verify its maker, and that nothing in it has changed since.

    The signature becomes a part of the file, which every reader checks. Sign last: a signed file cannot be
    certified.

    Examples:

    - unjam sign ring.unjam --key maker.key
    - unjam verify ring.unjam --signer maker.pub
    """
    from unjam.controller.file import add_signature, read_controller
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
