"""What a run is worth: `unjam evaluate`, `unjam model`, `unjam report`; and shipped: `export_command`, `verify_command`."""

import logging
import warnings
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, HumansOption, JsonOption, WorkersOption, scenario_changes
from unjam.cli.output import console, err_console, new_table, print_json, print_metrics, print_notes, report_steps
from unjam.errors import InputError, invalid_value, resume_hint
from unjam.processes import check_not_locked, continue_in_limited_child, lock_folder


def evaluate_command(
    run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Held-out episodes per driver.")] = 20,
    humans: HumansOption = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results.", show_default="the run's own")] = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    json: JsonOption = False,
) -> None:
    """Judge a trained controller beside every expert and all-human traffic, on fixed held-out seeds.

    The run's evaluation and report are written anew; with --out into another folder. Among other people
    (--humans) it has to be another.

    Examples:

      unjam evaluate runs/ring-001

      unjam evaluate runs/ring-001 --episodes 50 --json

      unjam evaluate runs/ring-001 --humans drivers.json --out runs/among-others
    """
    from unjam.drivers.registry import DRIVERS
    from unjam.reports.results import read_results
    from unjam.training.evaluate import evaluate_run, evaluation_steps, test_gain
    from unjam.training.run_folder import check_run_files, lock_new_folder, read_config
    from unjam.worlds.worker_pool import WorkerPool

    if humans is not None and out is None:
        raise InputError("humans: it is not allowed without --out: the run keeps its own evaluation")
    config = read_config(run)
    check_run_files(run, config)
    config = replace(config, road={**config.scenario_options, **scenario_changes(humans=humans)})
    if config.tasks:
        raise InputError(f"run: {str(run)!r} is of several roads; allowed: the folder of one of them")
    if not (run / "controller.unjam").is_file():
        raise InputError(f"run: {str(run)!r} has no controller yet{resume_hint(run)}")
    from unjam.reports.html import write_report_page  # draws: so late that what is wrong is told at once
    from unjam.reports.summary import main_finding

    total = evaluation_steps(config, run, list(DRIVERS), episodes)
    target = out or run
    with lock_folder(target) if out is None else lock_new_folder(out):
        with report_steps("evaluating", total) as steps, WorkerPool(workers) as pool:
            found = evaluate_run(run, config, pool, list(DRIVERS), episodes, steps, out)
        page = write_report_page([target], target / "report.html")
    if json:
        beyond, means = test_gain(config, found.rows), found.means()
        gain = asdict(beyond) if beyond else None
        drivers = [{"driver": one, "episodes": rows, "mean": means[one]} for one, rows in found.rows.items()]
        about = {"run": str(run), "scenario": config.scenario, "gain": gain}
        print_json({**about, "drivers": drivers, "notes": read_results(target).metadata["notes"]})
        return
    print_metrics(found.rows)
    judged = read_results(target)
    console.print(main_finding(judged), soft_wrap=True)
    print_notes(judged.metadata["notes"])
    err_console.print(f"report: {page}")


def model_command(
    run: Annotated[Path, typer.Argument(help="Folder of a training run with a virtual environment.")],
    json: JsonOption = False,
) -> None:
    """Show where the virtual environment of a run agrees with the actual one, and where it does not.

    All errors are root mean squares on episodes that no network learned from, beside those of the base alone
    and beside how much there was to predict. Of whole roads it shows what waves they have, beside an actual
    one from whose start they were imagined. The pictures are in the run's report, which is written anew.

    Examples:

      unjam model runs/ring-001

      unjam model runs/ring-001 --json
    """
    from matplotlib import get_cachedir

    continue_in_limited_child(f"model: {run}", run, Path(get_cachedir()))
    from unjam.reports import model as of_model
    from unjam.reports.html import write_report_page
    from unjam.reports.results import read_progress
    from unjam.training.model_facts import update_model_facts
    from unjam.training.run_folder import read_config

    config = read_config(run)
    with lock_folder(run):
        facts = update_model_facts(run, config)
        ended = (run / "evaluation.json").is_file()
        report = write_report_page([run], run / "report.html") if ended else None
    if json:
        print_json({"run": str(run), "report": str(report) if report else None, **facts})
        return
    lines = [of_model.rollout_summary(read_progress(run))]
    if "waves" in facts:
        table = new_table(("the road's second half",), of_model.WAVE_HEADINGS)
        for label, row in of_model.wave_rows(facts):
            table.add_row(label, *row)
    else:
        table = new_table(("root mean square", "unit"), of_model.error_headings(facts))
        for row in of_model.error_rows(facts):
            table.add_row(row["number"], row["unit"], *of_model.error_cells(row))
        lines = [of_model.error_verdict(facts), *lines, of_model.bound_summary(facts)]
    console.print(table)
    for line in lines:
        console.print(line)
    err_console.print(f"report: {report}" if report else f"no report before the training has ended: --resume {run}")


def report_command(
    folders: Annotated[list[Path], typer.Argument(help="Folders of results: of training runs, or of drive.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="The page.", show_default="report.html in it, or comparison.html here")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write the report of a folder of results, or of several compared: one HTML page that needs no network.

    Examples:

      unjam report runs/ring-001

      unjam report runs/ring-001 runs/ring-002 --out compared.html
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
    written = write_report_page(folders, target)
    if json:
        print_json({"report": str(written), "folders": [str(folder) for folder in folders]})
    else:
        console.print(str(written))


def _check_page_path(path: Path) -> None:
    """Raise `InputError` unless a path is that of a page: nothing else is written over."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise invalid_value("out", str(path), "a file that ends in .html")


def export_command(
    source: Annotated[str, typer.Argument(help="Folder of a training run; or any driver, as in drive --driver.")],
    out: Annotated[Path, typer.Option("--to", help="The file to write; ends in .unjam.")],
    onnx: Annotated[
        bool, typer.Option("--onnx", help="Add the ONNX graph of the whole controller, and write it beside.")
    ] = False,
    scenario: Annotated[
        str, typer.Option(help="Road whose time step and bounds a driver by itself gets.", show_default="ring")
    ] = "",
    json: JsonOption = False,
) -> None:
    """Write a controller into one file with all that is needed to run it elsewhere.

    Its manifest says what it observes, in which order and units, what it remembers, and how far it may be
    trusted. A sample of a held-out episode goes with it, on which `unjam verify` compares.

    Examples:

      unjam export runs/ring-001 --to ring.unjam

      unjam export runs/ring-001 --to ring.unjam --onnx

      unjam export pi:window=30 --scenario merge --to pi.unjam
    """
    from unjam.training.export import export_controller

    if onnx:  # what the exporter says of itself is of no use to users
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    done = export_controller(source, out, onnx, scenario)
    if json:
        files = {"file": str(done.file), "onnx": str(done.graph) if done.graph else None}
        print_json({**files, "driver": done.driver, "decisions": done.sample_steps})
        return
    for written in filter(None, (done.file, done.graph)):
        console.print(f"{written}: {written.stat().st_size:,} bytes")
    if done.graph is None and (older := out.with_suffix(".onnx")).exists():
        err_console.print(f"{older} was there before: it is not the graph of this controller; --onnx draws that one")
    err_console.print(f"{done.driver}, verified on {done.sample_steps:,} decisions of a held-out episode")


def certify_command(
    file: Annotated[Path, typer.Argument(help="A .unjam file that was exported; it gets the certificate.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="The page to write.", show_default="beside the file, ending in .html")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Certify a controller: what is proven of it, worst cases, comfort, strings of vehicles, its domain.

    Leaders brake to standstill from every state of its sample, an adversary looks for contact, and others
    sway at all frequencies. The certificate becomes a part of the file, which `unjam verify` tries again; a
    file that is signed already is refused.

    Example:

      unjam certify ring.unjam
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
    from unjam.reports.certificate import write_certificate_page  # draws, too

    found = make_certificate(controller)
    add_certificate(file, controller, found)
    assert isinstance(controller.driver, FilteredDriver)  # nothing else is certified
    write_certificate_page(file.name, controller.driver, found, target)
    if json:
        print_json({"file": str(file), "page": str(target), "certificate": found})
        return
    worst = found["worst"]
    tried = f"{worst['steps']:,} steps behind leaders that brake and attack: {worst['contacts']} contacts"
    console.print(f"{tried}, smallest gap {worst['min_gap']:.2f} m", soft_wrap=True)
    err_console.print(f"page: {target}")


def verify_command(
    file: Annotated[Path, typer.Argument(help="A .unjam file, or the folder of a training run.")],
    signer: Annotated[
        Path | None, typer.Option(help="Public key (.pub) that must have signed it.", show_default="anybody, or nobody")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check each part of a controller: hashes, signature, driver, and that its forms agree on its sample.

    Each line says that a part was checked and how, that it is absent, or that only its maker states it. Exit
    code 2 and one line where something is wrong, or where a folder names Python code that is not trusted;
    exit code 3 where a part could not be checked, as a package is not installed.

    Examples:

      unjam verify ring.unjam

      unjam verify ring.unjam --signer maker.pub     (signed by this key, or exit code 2)

      unjam verify runs/mine --trust-code            (its expert is a Python file that you trust)
    """
    from rich.markup import escape

    continue_in_limited_child(f"controller: {str(file)!r}")
    from unjam.controller.file import read_controller
    from unjam.controller.verify import check_parts, require_complete

    controller = read_controller(file)
    checks = check_parts(controller, signer)
    if json:
        wanted = None if signer is None else str(signer)
        who = {"signed_by": controller.signed_by, "signer": wanted}
        ok = all(each.status != "not checked" for each in checks)
        print_json({"file": str(file), "ok": ok, **who, "parts": [asdict(each) for each in checks]})
    else:
        colors = {"checked": "green", "not checked": "red", "absent": "yellow", "stated": "cyan"}
        for each in checks:
            status = f"[{colors[each.status]}]{each.status}[/]"
            console.print(f"{status} {each.part}: {escape(each.detail)}", markup=True)
    require_complete(checks)
