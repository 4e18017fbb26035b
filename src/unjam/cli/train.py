"""Trainings: one (`unjam train`), many that seek better settings (`search`), the paper's (`reproduce`)."""

from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    ExecutorOption,
    JsonOption,
    OutOption,
    TrainingOptions,
    TrainingWorkersOption,
    WorkersOption,
    find_executor,
    merge_settings,
    new_folder,
    scenario_changes,
    training_options,
    with_options,
)
from unjam.cli.output import (
    ProgressReporter,
    console,
    err_console,
    print_json,
    print_metrics,
    print_next_command,
    print_notes,
    suggest_after_training,
    suggest_resume,
)
from unjam.errors import InputError
from unjam.files import make_folder
from unjam.processes import lock_folder

if TYPE_CHECKING:
    from unjam.training.config import RunConfig

PROGRESS_LINE_INTERVAL = 5
"""iterations between two plain lines of progress where there is no terminal"""
STEP_OVERRUN_RATIO = 1.1
"""times the steps that were asked for, from which more are told of"""
EVALUATION_LABEL = "evaluating on held-out seeds"


@with_options(asked=training_options, road=scenario_changes)
def train_command(
    *,
    options: TrainingOptions,
    road: dict[str, Any],
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    resume: Annotated[
        Path | None, typer.Option(help="Go on with this run: after a stop, or with more --steps after its end.")
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
    from unjam.training.run_folder import check_config, read_config

    settings = dict(options.settings)
    if "out" in settings:
        out = Path(str(settings.pop("out")))
    changes = {**options.options, **{f"road.{key}": value for key, value in road.items()}}
    changes = {"workers": workers, **merge_settings(changes, settings)}
    if resume is not None:
        if out is not None or options.preset or options.config is not None:
            raise InputError("resume: --out, --preset and --config are not allowed beside it")
        before = read_config(resume)
        config = load_config(resume / "config.toml", changes={"steps": before.steps, **changes})
        folder = resume
    else:
        config = load_config(options.config, options.preset, changes)
        folder = new_folder(out, config.scenario)
    check_config(config)
    from unjam.measures.notes import episode_notes
    from unjam.reports.results import (  # and torch: seconds that nobody waits for a wrong word
        read_progress,
        read_results,
    )
    from unjam.reports.summary import main_finding
    from unjam.training.config import planned_steps
    from unjam.training.early_stopping import should_stop_early
    from unjam.training.evaluate import Evaluation
    from unjam.training.tensorboard import tensorboard_writer
    from unjam.training.train import train as run

    if resume is None and (steps := planned_steps(config)) > STEP_OVERRUN_RATIO * config.steps:
        err_console.print(f"note: iterations are whole: {steps:,} steps will be trained, not {config.steps:,}")
    board = tensorboard_writer(folder) if tensorboard else None
    progress = nullcontext() if json else _TrainingProgress(config, folder)
    with suggest_resume(folder, workers), progress as shown:

        def on_row(row: dict[str, Any]) -> None:
            for tell in (board, shown and shown.show_iteration):
                if tell:
                    tell(row)

        result = run(config, folder, resume is not None, on_row, shown and shown.show_evaluation)

    def result_facts(trained_run: Any) -> dict[str, Any]:
        files = {
            "folder": str(trained_run.folder),
            "controller": str(trained_run.controller),
            "report": str(result.report),
        }
        gain = asdict(trained_run.gain) if trained_run.gain else None
        means = Evaluation(trained_run.rows, {}).means()
        return {**files, "gain": gain, "drivers": means, "notes": episode_notes(trained_run.rows)}

    if json:
        roads = {name: result_facts(road) for name, road in result.tasks.items()}
        print_json({**result_facts(result), "roads": roads} if roads else result_facts(result))
        return
    for name, of in (result.tasks or {"": result}).items():
        if name:
            console.print(f"{name}:")
        print_metrics(of.rows)
        judged = read_results(of.folder)
        console.print(main_finding(judged), soft_wrap=True)
        print_notes(judged.metadata["notes"])
        err_console.print(f"controller: {of.controller}")
        steps = max(config.steps, judged.progress[-1]["environment_steps"])
        over = should_stop_early(config, read_progress(result.folder))
        suggest_after_training(of.folder, of.gain, steps, result.folder, over)
    err_console.print(f"report: {result.report}")


class _TrainingProgress(ProgressReporter):
    """Progress of training: a bar with the newest returns on a terminal, plain lines elsewhere."""

    def __init__(self, config: "RunConfig", folder: Path) -> None:
        super().__init__(f"training into {folder}", "steps", config.steps)
        self._config, self._folder = config, folder
        self._steps = config.steps
        self._validation_text, self._worst_road = "-", ""
        self._evaluated_steps: dict[tuple[str, int], int] = {}
        self._evaluation_total = 0

    def show_iteration(self, row: dict[str, Any]) -> None:
        """Show a row of progress."""
        if row["return_validation"] is not None:
            self._validation_text = f"{row['return_validation']:.0f}"
            self._worst_road = _worst_road_text(row.get("tasks", {}))
        expert = f"expert {row['return_expert']:.0f}"
        words = f"return {row['return_mean']:.0f}, validation {self._validation_text} ({expert}{self._worst_road})"
        steps = row["environment_steps"]
        self._bar.update(self._task, completed=steps, description=words)
        if self._is_plain and (row["iteration"] % PROGRESS_LINE_INTERVAL == 1 or steps >= self._steps):
            err_console.print(f"iteration {row['iteration']}: {steps:,} of {self._steps:,} steps, {words}")

    def show_evaluation(self, episode: tuple[str, int], steps: int) -> None:
        """Show how far the judgement is that follows the training."""
        from unjam.training.evaluate import evaluation_steps

        if not self._evaluated_steps:
            roads = self._config.task_configs().items()
            self._evaluation_total = sum(evaluation_steps(road, self._folder / name) for name, road in roads)
            self._label = EVALUATION_LABEL
            self._bar.reset(self._task, description=EVALUATION_LABEL, total=self._evaluation_total)
            if self._is_plain:
                err_console.print(EVALUATION_LABEL)
        self._evaluated_steps[episode] = steps
        self(sum(self._evaluated_steps.values()), self._evaluation_total)


def _worst_road_text(roads: dict[str, dict[str, Any]]) -> str:
    """Return in words on which of several roads a validation is least beyond the expert; nothing of one."""
    beyond = {road: row["return_validation"] - row["return_expert"] for road, row in roads.items()}
    if not beyond:
        return ""
    worst = min(beyond, key=beyond.__getitem__)
    return f"; least beyond it on {worst}: {beyond[worst]:+.0f}"


@with_options(asked=training_options)
def search_command(
    *,
    vary: Annotated[
        list[str] | None, typer.Option(help="What is varied: key=low..high, key=low..high:log, or key=a,b,c.")
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Trainings in all.")] = 20,
    options: TrainingOptions,
    workers: TrainingWorkersOption = DEFAULT_WORKERS,
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
    from unjam.training.search import BEST_CONFIG_FILE, check_search_space, describe_trial
    from unjam.training.search import search as run
    from unjam.training.search_space import parse_search_space

    base, space = (
        load_config(options.config, options.preset, options.options | options.settings),
        parse_search_space(vary or []),
    )
    runner = find_executor(executor)
    base = replace(base, workers=1)
    check_search_space(base, space)
    folder = new_folder(out, f"search-{Path(base.scenario).stem}")
    make_folder(folder)
    with lock_folder(folder):
        found = run(base, space, trials, folder, workers, runner, (lambda line: None) if json else err_console.print)
    best = folder / BEST_CONFIG_FILE
    if json:
        rows = [{"trial": one.number, "gain": one.gain, "last": one.last_gain, "values": one.values} for one in found]
        print_json({"folder": str(folder), "best": str(best), "trials": rows})
        return
    for one in found[:5]:
        console.print(describe_trial(one))
    untrained = sum(one.gain is not None and one.gain <= 0 for one in found)
    console.print(f"{untrained} of {len(found)} trainings kept the untrained network")
    print_next_command("train with the best", "train", "--config", best)


def reproduce_command(
    studies: Annotated[
        list[str], typer.Argument(help="Names of studies: table-1, figure-4 ..., or all.", metavar="STUDY...")
    ],
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each variant.")] = 3,
    workers: TrainingWorkersOption = DEFAULT_WORKERS,
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
    runner = find_executor(executor)
    from unjam_paper.reproduce import make_plan
    from unjam_paper.reproduce import run_plan as run
    from unjam_paper.study import StudyFolder

    plan = make_plan(studies, seeds, StudyFolder(out))
    minutes = plan.seconds(workers) / 60.0
    names = [planned.name for planned in plan.runs]
    if dry_run and json:
        print_json({"missing": names, "finished": plan.finished_count, "drives": plan.roads, "minutes": minutes})
        return
    if dry_run:
        for name in names:
            console.print(name)
    takes = f"{minutes / 60.0:.1f} hours" if minutes > 90 else f"{max(1.0, minutes):.0f} minutes"
    err_console.print(
        f"{len(names)} trainings to make, {plan.finished_count} there already; about {takes} with {workers} at once"
    )
    if dry_run:
        return
    make_folder(out)
    with lock_folder(out):
        folders = [str(folder) for folder in run(plan, workers, runner, err_console.print)]
    if json:
        print_json({"folders": folders})
        return
    for folder in folders:
        console.print(folder)
