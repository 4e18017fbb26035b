"""`unjam evaluate`: judge a trained run on held-out seeds, beside every expert and all-human traffic."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, HumansOption, JsonOption, WorkersOption
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
    from unjam.cli.output import aside, console, counting_steps, metrics_table, print_json
    from unjam.drivers.registry import DRIVERS
    from unjam.measures.statistics import summarise
    from unjam.reports.html import write_report
    from unjam.reports.story import signed
    from unjam.training.folder import read_config
    from unjam.training.judge import among, comparison, judge
    from unjam.training.train import TrainResult, gain_of
    from unjam.worlds.workers import Workers

    if humans is not None and out is None:
        raise InputError("humans: it is not allowed without --out: the run keeps its own evaluation")
    config = among(read_config(run), humans)
    if config.tasks:
        raise InputError(f"run: {str(run)!r} is of several roads; allowed: its folder of one of them")
    if not (run / "controller.unjam").is_file():
        raise InputError(f"run: {str(run)!r} has no controller yet; go on with: unjam train --resume {run}")
    total = len(comparison(config, run, list(DRIVERS))) * episodes * config.make_scenario().horizon
    with counting_steps("evaluating", total) as steps, Workers(workers) as pool:
        found = judge(run, config, pool, list(DRIVERS), episodes, steps, out)
    result = TrainResult(out or run, found.rows, gain_of(config, found.rows))
    write_report([result.folder], result.report)
    if json:
        gain = asdict(result.gain) if result.gain else None
        drivers = [
            {
                "driver": driver,
                "episodes": rows,
                "mean": {name: entry.mean for name, entry in summarise(rows).items()},
            }
            for driver, rows in found.rows.items()
        ]
        print_json({"run": str(run), "scenario": config.scenario, "gain": gain, "drivers": drivers})
        return
    console.print(metrics_table(found.rows))
    if result.gain is not None:
        console.print(f"return beyond the expert, 95 % interval: {signed(result.gain)}")
    aside.print(f"report: {result.report}")
