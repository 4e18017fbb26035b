"""`unjam train` runs one training, and `unjam search` runs many trainings to find better settings."""

import time
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from unjam.cli import options as opt
from unjam.cli import output
from unjam.cli.output import console, err_console, print_json
from unjam.errors import InputError
from unjam.measures.notes import episode_notes
from unjam.reports.results import read_progress, read_results
from unjam.text import format_count, format_duration
from unjam.training.config import RunConfig, load_config, planned_steps
from unjam.training.evaluate import Evaluation, duration_note, evaluation_steps
from unjam.training.run_folder import check_config, lock_new_folder, make_new_folder, read_config, removing_if_empty
from unjam.training.trial_log import REQUEST_FILE

if TYPE_CHECKING:
    from unjam.training.train import TrainResult

PROGRESS_LINES, MAX_SILENCE = 20, 600.0
"""without a terminal: number of lines of progress at regular steps, and maximum time between two lines [s]"""
STEP_OVERRUN_RATIO = 1.1
"""ratio of planned to requested steps above which a note is printed; all iterations are complete"""
EVALUATION_LABEL = "evaluating on test seeds"


@opt.with_options(options=opt.training_options, changes=opt.scenario_changes)
def train_command(
    *,
    options: opt.TrainingOptions,
    changes: dict[str, Any],
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    resume: Annotated[
        Path | None, Option(help="Continue this run after it was stopped, or with more --steps after its end.")
    ] = None,
    tensorboard: Annotated[
        bool, Option("--tensorboard", help="Write curves for: tensorboard --logdir FOLDER.")
    ] = False,
    show_all: opt.AllMetricsOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Train a residual on an expert, evaluate it on test seeds, and write a report.

    Examples:

    - unjam train ring --preset demo
    - unjam train ring --agent sac --steps 120000
    - unjam train --config mixture.toml              (several roads together: its tables of tasks)
    - unjam train ring-jammed --expert follower-stopper --steps 500000 --seed 3
    - unjam train ring --expert my_driver.py:gentle --reward my_reward.py:calm
    - unjam train ring --expert runs/ring-001        (a trained controller as the expert)
    - unjam train ring --humans drivers.json --set model.base=population
    - unjam train --resume runs/ring-001 --steps 2000000
    """
    config_file, preset, settings = options
    if "out" in settings:
        out = Path(str(settings.pop("out")))
    scenario_options = {f"scenario_options.{key}": value for key, value in changes.items()}
    changes = {"workers": workers, **opt.merge_settings(scenario_options, settings)}
    if resume is not None:
        if out is not None or preset or config_file is not None:
            raise InputError("resume: --out, --preset and --config are not allowed together with it")
        config = load_config(resume / "config.toml", changes={"steps": read_config(resume).steps, **changes})
        folder = resume
    else:
        config = load_config(config_file, preset, changes)
        folder = opt.new_folder(out, config.scenario)
    check_config(config)
    # These import torch, which takes seconds; errors in the arguments are reported earlier.
    from unjam.reports.summary import main_finding
    from unjam.training.tensorboard import tensorboard_writer
    from unjam.training.train import train

    if resume is None:
        with removing_if_empty(folder):  # refuses a folder with files before the plan is printed
            make_new_folder(folder, f", or --resume {folder}")
        if (steps := planned_steps(config)) > STEP_OVERRUN_RATIO * config.steps:
            err_console.print(f"note: iterations are complete: {steps:,} steps will be trained, not {config.steps:,}")
    err_console.print(f"training {_plan_text(config)}, into {folder}", soft_wrap=True)
    write_curves = tensorboard_writer(folder) if tensorboard else None
    progress = nullcontext() if json else _TrainingProgress(config, folder)
    same_workers = [] if workers == opt.DEFAULT_WORKERS else ["--workers", workers]
    with output.suggest_resume(folder / "config.toml", "train", "--resume", folder, *same_workers), progress as display:

        def on_row(row: dict[str, Any]) -> None:
            for callback in (write_curves, display and display.show_iteration):
                if callback:
                    callback(row)

        result = train(config, folder, resume is not None, on_row, display and display.show_evaluation)
    if json:
        facts_by_task = {name: _result_facts(task_result, result) for name, task_result in result.tasks.items()}
        print_json(_result_facts(result, result) | ({"roads": facts_by_task} if facts_by_task else {}))
        return
    for name, task_result in (result.tasks or {"": result}).items():
        if name:
            console.print(f"{name}:")
        results = read_results(task_result.folder)
        output.print_wrapped(main_finding(results))
        output.print_results(task_result.rows, show_all, first_metrics=["return"])
        output.print_notes(results.metadata["notes"])
        err_console.print(f"controller: {task_result.controller}")
        steps = max(config.steps, results.progress[-1]["environment_steps"])
        is_finished = config.evaluation.should_stop_early(read_progress(result.folder))
        output.suggest_after_training(task_result.folder, task_result.gain, steps, result.folder, is_finished)
    err_console.print(f"report: {result.report}")


def _result_facts(task: "TrainResult", run: "TrainResult") -> dict[str, Any]:
    """Return the results of a task of a run for JSON; a run without tasks is its own task."""
    return {
        **{"folder": str(task.folder), "controller": str(task.controller), "report": str(run.report)},
        "gain": asdict(task.gain) if task.gain else None,
        "drivers": Evaluation(task.rows, {}).means(),
        "notes": episode_notes(task.rows),
    }


class _TrainingProgress(output.ProgressReporter):
    """Shows the progress of a training: a bar with the latest returns on a terminal, elsewhere plain lines."""

    def __init__(self, config: "RunConfig", folder: Path) -> None:
        self._config, self._folder, self._steps = config, folder, planned_steps(config)
        super().__init__(f"training into {folder}", "steps", self._steps)
        self._validation_text, self._worst_road = "-", ""
        self._init_time = self._last_line = time.monotonic()
        self._first_report: tuple[int, float] | None = None  # steps and time
        self._next_line_steps = 0.0

    def show_iteration(self, row: dict[str, Any]) -> None:
        """Show the progress after an iteration, from its row of metrics."""
        if row["return_validation"] is not None:
            self._validation_text = f"{row['return_validation']:.0f} at {row['environment_steps']:,}"
            self._worst_road = _worst_road_text(row.get("tasks", {}))
        expert = f"expert {row['return_expert']:.0f}"
        text = f"return {row['return_mean']:.0f}, validation {self._validation_text} ({expert}{self._worst_road})"
        steps, total = row["environment_steps"], self._steps
        self._bar.update(self._task, completed=steps, description=text)
        now = time.monotonic()
        remaining = self._remaining_time_text(row["iteration"], steps, now)
        if self._is_plain and (steps >= min(self._next_line_steps, total) or now - self._last_line > MAX_SILENCE):
            interval = total / PROGRESS_LINES
            self._next_line_steps, self._last_line = interval * (1 + steps // interval), now
            line = f"iteration {row['iteration']}: {steps:,} of {total:,} steps, {text}{remaining}"
            err_console.print(line, soft_wrap=True)

    def _remaining_time_text(self, iteration: int, steps: int, now: float) -> str:
        """Return the expected remaining time of the training; empty at the end and while it is unknown."""
        total = self._steps
        if self._first_report is None:
            self._first_report = (0, self._init_time) if iteration == 1 else (steps, now)  # else resumed
        first_steps, first_time = self._first_report
        if not first_steps < steps < total:
            return ""
        return f", {format_duration((total - steps) * (now - first_time) / (steps - first_steps))} left"

    def show_evaluation(self, episode: tuple[str, int], steps: int) -> None:
        """Show the progress of an episode in the evaluation after the training."""
        if not self._done:
            configs = self._config.task_configs().items()
            self._total = sum(evaluation_steps(config, self._folder / name) for name, config in configs)
            self._label = EVALUATION_LABEL
            self._bar.reset(self._task, description=EVALUATION_LABEL, total=self._total)
            if self._is_plain:
                err_console.print(EVALUATION_LABEL)
        self.update(episode, steps)


def _plan_text(config: "RunConfig") -> str:
    """Return a line on the plan of a training: learner, expert, roads and steps."""
    tasks = config.task_configs().values()
    roads = f"{len(tasks)} roads" if len(tasks) > 1 else Path(config.scenario).name
    policy = f"{config.agent} without an expert" if config.expert == "none" else f"{config.agent} on {config.expert}"
    ratio = config.model.model_ratio
    model = f"{ratio:g} steps of the learned model for each of them" if ratio else "without a learned model"
    durations = "; ".join(dict.fromkeys(filter(None, map(duration_note, tasks))))
    return f"{policy}: {roads}, {config.steps:,} environment steps, {model}{durations and f', {durations}'}"


def _worst_road_text(roads: dict[str, dict[str, Any]]) -> str:
    """Return a text on the road with the smallest difference of validation to expert; empty for a single road."""
    if not roads:
        return ""
    differences = {road: row["return_validation"] - row["return_expert"] for road, row in roads.items()}
    worst = min(differences, key=differences.__getitem__)
    return f"; smallest difference on {worst}: {differences[worst]:+.0f}"


@opt.with_options(options=opt.training_options)
def search_command(
    *,
    vary: Annotated[
        list[str] | None, Option(help="Settings to vary: key=low..high, key=low..high:log, or key=a,b,c.")
    ] = None,
    trials: Annotated[int, Option(min=1, help="Total number of trainings.")] = 20,
    options: opt.TrainingOptions,
    workers: opt.TrainingWorkersOption = opt.DEFAULT_WORKERS,
    executor: opt.ExecutorOption = "local",
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Search for better settings of a training with Optuna; each trial is a training.

    Trials are compared on validation seeds, never on test seeds. The best settings are written to best.toml, for
    `unjam train --config`. To continue a stopped search, repeat the command with the same --out.

    Examples:

    - unjam search ring --steps 60000 --vary trpo.target_kl=0.003..0.1:log --vary policy.action_duration=0.1..2.0
    - unjam search merge --agent ppo --vary expert=acc,bcm,lacc --trials 30 --workers 8 --out runs/search
    - unjam search ring --vary policy.exploration_std=0.05..0.5 --executor ray --workers 64 --out /shared/search
    """
    from unjam.training.search import BEST_CONFIG_FILE, check_search_space, describe_trial, search
    from unjam.training.search_space import parse_search_space

    base = replace(load_config(*options), workers=1)
    space = parse_search_space(vary or [])
    check_search_space(base, space)
    folder = opt.new_folder(out, f"search-{Path(base.scenario).stem}")
    on_message = (lambda line: None) if json else err_console.print
    if not json:
        plan = f"{format_count(trials, 'training')}, {workers} at once, into {folder}; each: {_plan_text(base)}"
        err_console.print(f"searching {', '.join(space)} in {plan}", soft_wrap=True)
    resume = output.suggest_resume(folder / REQUEST_FILE, *output.arguments_without("--out"), "--out", folder)
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), resume:
        results = search(base, space, trials, folder, workers, executor, on_message)
    best = folder / BEST_CONFIG_FILE
    if json:
        rows = [
            {"trial": trial.number, "gain": trial.gain, "last_gain": trial.last_gain, "values": trial.values}
            for trial in results
        ]
        print_json({"folder": str(folder), "best": str(best), "trials": rows})
        return
    for trial in results[:5]:
        console.print(describe_trial(trial))
    untrained = sum(trial.gain is not None and trial.gain <= 0 for trial in results)
    console.print(f"{untrained} of {format_count(len(results), 'training')} kept the untrained network")
    if any(trial.gain is not None and trial.gain > 0 for trial in results):
        output.print_next_command("train with the best", "train", "--config", best)
    else:
        err_console.print("no gain is shown with any of these settings: vary others, or train longer (--steps)")
