"""Trainings: one (`unjam train`), many that seek better settings (`search`), the paper's (`reproduce`)."""

from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    AskedRun,
    ExecutorOption,
    JsonOption,
    OutOption,
    TrainingsOption,
    WorkersOption,
    asked_run,
    executor_named,
    new_folder,
    scenario_changes,
    together,
    with_options,
)
from unjam.cli.output import (
    Counted,
    after_training,
    aside,
    console,
    print_json,
    print_metrics,
    print_notes,
    resumable,
    say_next,
)
from unjam.errors import InputError
from unjam.files import make_folder
from unjam.processes import owned

if TYPE_CHECKING:
    from unjam.training.config import RunConfig

LINE_EVERY = 5
"""iterations between two plain lines of progress where there is no terminal"""
MUCH_MORE = 1.1
"""times the steps that were asked for, from which more are told of"""
JUDGING = "evaluating on held-out seeds"


@with_options(asked=asked_run, road=scenario_changes)
def train(
    *,
    asked: AskedRun,
    road: dict[str, Any],
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on with this run: after a stop, or with more --steps after its end."),
    ] = None,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Write curves for: tensorboard --logdir FOLDER.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Train a residual on an expert, judge it on held-out seeds, write a report.

    Examples:

      unjam train ring --preset demo

      unjam train ring --agent sac --steps 120000

      unjam train --config mixture.toml              (several roads together: its tables of tasks)

      unjam train ring-jammed --expert follower-stopper --steps 500000 --seed 3

      unjam train ring --expert my_driver.py:gentle --reward my_reward.py:calm

      unjam train ring --expert runs/ring-001        (a trained controller as the expert)

      unjam train ring --humans drivers.json --set virtual.base=population

      unjam train --resume runs/ring-001 --steps 2000000
    """
    from unjam.training.config import load_config
    from unjam.training.folder import check_possible, read_config

    settings = dict(asked.settings)
    if "out" in settings:
        out = Path(str(settings.pop("out")))
    changes = {**asked.flags, **{f"road.{key}": value for key, value in road.items()}}
    changes = {"workers": workers, **together(changes, settings)}
    if resume is not None:
        if out is not None or asked.preset or asked.file is not None:
            raise InputError("resume: --out, --preset and --config are not allowed beside it")
        before = read_config(resume)
        config = load_config(resume / "config.toml", changes={"steps": before.steps, **changes})
        folder = resume
    else:
        config = load_config(asked.file, asked.preset, changes)
        folder = new_folder(out, config.scenario)
    check_possible(config)
    from unjam.measures.notes import notes_of_rows
    from unjam.reports.results import (  # and torch: seconds that nobody waits for a wrong word
        read_progress,
        read_results,
    )
    from unjam.reports.story import lead_of
    from unjam.training.config import steps_to_train
    from unjam.training.evaluate import Evaluation
    from unjam.training.stopping import ends_early
    from unjam.training.tensorboard import tensorboard_into
    from unjam.training.train import train as run

    if resume is None and (steps := steps_to_train(config)) > MUCH_MORE * config.steps:
        aside.print(f"note: iterations are whole: {steps:,} steps will be trained, not {config.steps:,}")
    board = tensorboard_into(folder) if tensorboard else None
    progress = nullcontext() if json else _Progress(config, folder)
    with resumable(folder, workers), progress as shown:

        def row_written(row: dict[str, Any]) -> None:
            for tell in (board, shown and shown.iteration):
                if tell:
                    tell(row)

        result = run(config, folder, resume is not None, row_written, shown and shown.judging)

    def facts(of: Any) -> dict[str, Any]:
        files = {"folder": str(of.folder), "controller": str(of.controller), "report": str(result.report)}
        gain = asdict(of.gain) if of.gain else None
        means = Evaluation(of.rows, {}).means()
        return {**files, "gain": gain, "drivers": means, "notes": notes_of_rows(of.rows)}

    if json:
        roads = {name: facts(road) for name, road in result.roads.items()}
        print_json({**facts(result), "roads": roads} if roads else facts(result))
        return
    for name, of in (result.roads or {"": result}).items():
        if name:
            console.print(f"{name}:")
        print_metrics(of.rows)
        judged = read_results(of.folder)
        console.print(lead_of(judged), soft_wrap=True)
        print_notes(judged.about["notes"])
        aside.print(f"controller: {of.controller}")
        steps = max(config.steps, judged.progress[-1]["actual_steps"])
        over = ends_early(config, read_progress(result.folder))
        after_training(of.folder, of.gain, steps, result.folder, over)
    aside.print(f"report: {result.report}")


class _Progress(Counted):
    """Progress of training: a bar with the newest returns on a terminal, plain lines elsewhere."""

    def __init__(self, config: "RunConfig", folder: Path) -> None:
        super().__init__(f"training into {folder}", "steps", config.steps)
        self._config, self._folder = config, folder
        self._steps = config.steps
        self._validated, self._worst = "-", ""
        self._judged: dict[tuple[str, int], int] = {}
        self._to_judge = 0

    def iteration(self, row: dict[str, Any]) -> None:
        """Show a row of progress."""
        if row["return_validation"] is not None:
            self._validated = f"{row['return_validation']:.0f}"
            self._worst = _worst_of(row.get("tasks", {}))
        expert = f"expert {row['return_expert']:.0f}"
        words = f"return {row['return_mean']:.0f}, validation {self._validated} ({expert}{self._worst})"
        steps = row["actual_steps"]
        self._bar.update(self._task, completed=steps, description=words)
        if self._plain and (row["iteration"] % LINE_EVERY == 1 or steps >= self._steps):
            aside.print(f"iteration {row['iteration']}: {steps:,} of {self._steps:,} steps, {words}")

    def judging(self, episode: tuple[str, int], steps: int) -> None:
        """Show how far the judgement is that follows the training."""
        from unjam.training.evaluate import steps_to_judge

        if not self._judged:
            roads = self._config.roads().items()
            self._to_judge = sum(steps_to_judge(road, self._folder / name) for name, road in roads)
            self._label = JUDGING
            self._bar.reset(self._task, description=JUDGING, total=self._to_judge)
            if self._plain:
                aside.print(JUDGING)
        self._judged[episode] = steps
        self(sum(self._judged.values()), self._to_judge)


def _worst_of(roads: dict[str, dict[str, Any]]) -> str:
    """Return in words on which of several roads a validation is least beyond the expert; nothing of one."""
    beyond = {road: row["return_validation"] - row["return_expert"] for road, row in roads.items()}
    if not beyond:
        return ""
    worst = min(beyond, key=beyond.__getitem__)
    return f"; least beyond it on {worst}: {beyond[worst]:+.0f}"


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
    from unjam.training.search import BEST, check_space, words_of_trial
    from unjam.training.search import search as run
    from unjam.training.space import space_of

    base, space = load_config(asked.file, asked.preset, asked.flags | asked.settings), space_of(vary or [])
    runner = executor_named(executor)
    base = replace(base, workers=1)
    check_space(base, space)
    folder = new_folder(out, f"search-{Path(base.scenario).stem}")
    make_folder(folder)
    with owned(folder):
        found = run(
            base, space, trials, folder, workers, runner, (lambda line: None) if json else aside.print
        )
    best = folder / BEST
    if json:
        rows = [
            {"trial": one.number, "gain": one.gain, "last": one.last, "values": one.values} for one in found
        ]
        print_json({"folder": str(folder), "best": str(best), "trials": rows})
        return
    for one in found[:5]:
        console.print(words_of_trial(one))
    untrained = sum(one.gain is not None and one.gain <= 0 for one in found)
    console.print(f"{untrained} of {len(found)} trainings kept the untrained network")
    say_next("train with the best", "train", "--config", best)


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
        print_json({"missing": names, "finished": plan.finished, "drives": plan.roads, "minutes": minutes})
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
    make_folder(out)
    with owned(out):
        folders = [str(folder) for folder in run(plan, workers, runner, aside.print)]
    if json:
        print_json({"folders": folders})
        return
    for folder in folders:
        console.print(folder)
