"""What a run is worth: `unjam evaluate` and `unjam model` measure it anew, `unjam report` shows it."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, HumansOption, JsonOption, WorkersOption
from unjam.cli.output import aside, console, counting_steps, metrics_table, new_table, print_json
from unjam.errors import InputError


def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder of a training run.")],
    episodes: Annotated[
        int, typer.Option("--episodes", "-n", min=1, help="Held-out episodes per driver.")
    ] = 20,
    humans: HumansOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the results.", show_default="the run's own")
    ] = None,
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
    from unjam.reports.html import write_report
    from unjam.reports.story import signed
    from unjam.training.evaluate import among, comparison, judge
    from unjam.training.folder import read_config
    from unjam.training.train import TrainResult, gain_of
    from unjam.worlds.workers import Workers

    if humans is not None and out is None:
        raise InputError("humans: it is not allowed without --out: the run keeps its own evaluation")
    config = among(read_config(run), humans)
    if config.tasks:
        raise InputError(f"run: {str(run)!r} is of several roads; allowed: the folder of one of them")
    if not (run / "controller.unjam").is_file():
        raise InputError(f"run: {str(run)!r} has no controller yet; go on with: unjam train --resume {run}")
    total = len(comparison(config, run, list(DRIVERS))) * episodes * config.make_scenario().horizon
    with counting_steps("evaluating", total) as steps, Workers(workers) as pool:
        found = judge(run, config, pool, list(DRIVERS), episodes, steps, out)
    result = TrainResult(out or run, found.rows, gain_of(config, found.rows))
    write_report([result.folder], result.report)
    if json:
        gain, means = asdict(result.gain) if result.gain else None, found.means()
        drivers = [
            {"driver": driver, "episodes": rows, "mean": means[driver]} for driver, rows in found.rows.items()
        ]
        print_json({"run": str(run), "scenario": config.scenario, "gain": gain, "drivers": drivers})
        return
    console.print(metrics_table(found.rows))
    if result.gain is not None:
        console.print(f"return beyond the expert, 95 % interval: {signed(result.gain)}")
    aside.print(f"report: {result.report}")


def model(
    run: Annotated[Path, typer.Argument(help="Folder of a training run with a virtual environment.")],
    json: JsonOption = False,
) -> None:
    """Show where the virtual environment of a run agrees with the actual one, and where it does not.

    All errors are root mean squares on episodes that no network learned from, beside those of the base alone
    and beside how much there was to predict. The pictures are in the run's report, which is written anew.

    Examples:

      unjam model runs/ring-001

      unjam model runs/ring-001 --json
    """
    from unjam.reports.html import write_report
    from unjam.reports.model import bound_of, cells, error_rows, headings, trust_of, verdict_of
    from unjam.reports.results import read_progress
    from unjam.training.folder import read_config
    from unjam.training.model_facts import newest_model_facts

    facts = newest_model_facts(run, read_config(run))
    ended = (run / "evaluation.json").is_file()
    report = write_report([run], run / "report.html") if ended else None
    if json:
        print_json({"run": str(run), "report": str(report) if report else None, **facts})
        return
    table = new_table(("root mean square", "unit"), headings(facts))
    for row in error_rows(facts):
        table.add_row(row["number"], row["unit"], *cells(row))
    console.print(table)
    for line in (verdict_of(facts), trust_of(read_progress(run)), bound_of(facts)):
        console.print(line)
    aside.print(f"report: {report}" if report else f"no report before the training has ended: --resume {run}")


def report(
    folders: Annotated[list[Path], typer.Argument(help="Folders of results: of training runs, or of drive.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="The page to write.", show_default="report.html in the folder"),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write the report of a folder of results, or of several compared: one HTML page that needs no network.

    Examples:

      unjam report runs/ring-001

      unjam report runs/ring-001 runs/ring-002 --out compared.html
    """
    from unjam.reports.html import write_report

    target = out or (folders[0] / "report.html" if len(folders) == 1 else Path("comparison.html"))
    written = write_report(folders, target)
    if json:
        print_json({"report": str(written), "folders": [str(folder) for folder in folders]})
    else:
        console.print(str(written))
