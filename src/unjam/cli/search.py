"""Many trainings: `unjam search` finds settings that learn better, `unjam reproduce` makes the paper anew."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    AskedRun,
    ExecutorOption,
    JsonOption,
    OutOption,
    TrainingsOption,
    asked_run,
    executor_named,
    new_folder,
    with_options,
)
from unjam.cli.output import aside, console, print_json


@with_options(asked=asked_run)
def search(
    *,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="What is varied: key=low..high, key=low..high:log, or key=a,b,c."),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Trainings in all.")] = 20,
    asked: AskedRun,
    workers: TrainingsOption = DEFAULT_WORKERS,
    executor: ExecutorOption = "local",
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Search for settings that learn better: many trainings, proposed by Optuna.

    Trials are judged by their validations, never by the held-out seeds. After a stop the same command goes
    on; the best settings are in best.toml, for `unjam train --config`.

    Examples:

      unjam search ring --steps 60000 --vary trpo.target_kl=0.003..0.1:log --vary policy.hold=0.1..2.0

      unjam search merge --agent ppo --vary expert=acc,bcm,lacc --trials 30 --workers 8 --out runs/search

      unjam search ring --vary policy.exploration_std=0.05..0.5 --executor ray --workers 64 --out /shared/it
    """
    from unjam.training.config import load_config
    from unjam.training.search import BEST, check_space, space_of
    from unjam.training.search import search as run

    base, space = load_config(asked.file, asked.preset, asked.flags | asked.settings), space_of(vary or [])
    runner = executor_named(executor)
    base = replace(base, workers=1)
    check_space(base, space)
    folder = new_folder(out, f"search-{Path(base.scenario).stem}")
    found = run(base, space, trials, folder, workers, runner, (lambda line: None) if json else aside.print)
    best = folder / BEST
    if json:
        rows = [{"trial": one.number, "gain": one.gain, "values": one.values} for one in found]
        print_json({"folder": str(folder), "best": str(best), "trials": rows})
        return
    for one in found[:5]:
        values = ", ".join(f"{key}={value}" for key, value in one.values.items())
        gain = "failed" if one.gain is None else f"{one.gain:+.1f}"
        console.print(f"trial {one.number}: {gain} beyond the expert, validation seeds: {values}")
    console.print(f"train with the best: unjam train --config {best}", soft_wrap=True)


def reproduce(
    studies: Annotated[
        list[str], typer.Argument(help="Names of studies: table-1, figure-4 ..., or all.", metavar="STUDY...")
    ],
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each variant.")] = 3,
    workers: TrainingsOption = DEFAULT_WORKERS,
    executor: ExecutorOption = "local",
    out: Annotated[Path, typer.Option(help="Folder of all studies; what is there already is used.")] = Path(
        "runs/reproduce"
    ),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the trainings and the time they take; start nothing.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Reproduce tables and figures of the paper: train what they need, and draw them.

    Trainings that several studies share are made once. After a stop the same command goes on.

    Examples:

      unjam reproduce table-2 --seeds 5

      unjam reproduce all --dry-run

      unjam reproduce table-1 --executor ray --workers 64 --out /shared/unjam
    """
    runner = executor_named(executor)
    from unjam.studies.reproduce import make_plan
    from unjam.studies.reproduce import reproduce as run
    from unjam.studies.study import StudyFolder

    plan = make_plan(studies, seeds, StudyFolder(out))
    minutes = plan.seconds(workers) / 60.0
    names = [planned.name for planned in plan.runs]
    if dry_run and json:
        there = {"finished": plan.finished, "drives": plan.roads, "minutes": minutes}
        print_json({"missing": names, **there})
        return
    if dry_run:
        for name in names:
            console.print(name)
    takes = f"{minutes / 60.0:.1f} hours" if minutes > 90 else f"{max(1.0, minutes):.0f} minutes"
    aside.print(
        f"{len(names)} trainings to make, {plan.finished} there already; about {takes} with {workers} at once"
    )
    if dry_run:
        return
    folders = [str(folder) for folder in run(plan, workers, runner, aside.print)]
    if json:
        print_json({"folders": folders})
        return
    for folder in folders:
        console.print(folder)
