"""`unjam reproduce`: the paper's tables and figures, trained and drawn anew."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, ExecutorOption, JsonOption, executor_named


def reproduce(
    studies: Annotated[
        list[str], typer.Argument(help="Names of studies: table-1, figure-4 ..., or all.", metavar="STUDY...")
    ],
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each variant.")] = 3,
    workers: Annotated[int, typer.Option(min=1, help="Trainings at once.")] = DEFAULT_WORKERS,
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
    from unjam.cli.output import aside, console, print_json

    runner = executor_named(executor)
    from unjam.studies.reproduce import make_plan
    from unjam.studies.reproduce import reproduce as run
    from unjam.studies.study import StudyFolder

    plan = make_plan(studies, seeds, StudyFolder(out))
    minutes = plan.seconds(workers) / 60.0
    if dry_run:
        if json:
            missing = [run.name for run in plan.runs]
            there = {"finished": plan.finished, "drives": plan.roads, "minutes": minutes}
            print_json({"missing": missing, **there})
            return
        for planned in plan.runs:
            console.print(planned.name)
    aside.print(
        f"{len(plan.runs)} trainings to make, {plan.finished} there already; "
        f"about {_in_words(minutes)} with {workers} at once"
    )
    if dry_run:
        return
    folders = run(plan, workers, runner, aside.print)
    if json:
        print_json({"folders": [str(folder) for folder in folders]})
        return
    for folder in folders:
        console.print(str(folder))


def _in_words(minutes: float) -> str:
    return f"{minutes / 60.0:.1f} hours" if minutes > 90 else f"{max(1.0, minutes):.0f} minutes"
