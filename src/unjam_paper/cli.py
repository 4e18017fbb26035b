"""The command `unjam reproduce`, which unjam loads through an entry point."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli import options as opt
from unjam.cli.output import console, err_console, print_json
from unjam.files import make_folder
from unjam.processes import lock_folder


def reproduce_command(
    studies: Annotated[
        list[str], typer.Argument(help="Names of studies: table-1, figure-4 ..., or all.", metavar="STUDY...")
    ],
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Trainings of each variant, one per seed.")] = 3,
    workers: opt.TrainingWorkersOption = opt.DEFAULT_WORKERS,
    executor: opt.ExecutorOption = "local",
    out: Annotated[Path, typer.Option(help="Folder of all studies; existing trainings are reused.")] = Path(
        "runs/reproduce"
    ),
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the trainings and their estimated time; start nothing.")
    ] = False,
    json: opt.JsonOption = False,
) -> None:
    """Reproduce tables and figures of the paper: run the trainings that they need, and draw them.

    Trainings that several studies share run once. The same command continues a stopped reproduction.

    Examples:

    - unjam reproduce table-2 --seeds 5
    - unjam reproduce all --dry-run
    - unjam reproduce table-1 --executor ray --workers 64 --out /shared/unjam
    """
    from unjam_paper.reproduce import make_plan, run_plan
    from unjam_paper.study import StudyFolder

    plan = make_plan(studies, seeds, StudyFolder(out))
    minutes = plan.seconds(workers) / 60.0
    names = [run.name for run in plan.runs]
    if dry_run and json:
        counts = {"planned_trainings": names, "finished_trainings": plan.finished_count, "reference_roads": plan.roads}
        print_json({**counts, "minutes": minutes})
        return
    if dry_run:
        for name in names:
            console.print(name)
    time = f"{minutes / 60.0:.1f} hours" if minutes > 90 else f"{max(1.0, minutes):.0f} minutes"
    err_console.print(
        f"{len(names)} trainings to run, {plan.finished_count} finished; about {time} with {workers} at the same time"
    )
    if dry_run:
        return
    make_folder(out)
    with lock_folder(out):
        folders = [str(folder) for folder in run_plan(plan, workers, executor, err_console.print)]
    if json:
        print_json({"folders": folders})
        return
    for folder in folders:
        console.print(folder)
