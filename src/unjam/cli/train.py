"""`unjam train`: learn a residual on an expert."""

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    AskedRun,
    JsonOption,
    OutOption,
    WorkersOption,
    asked_run,
    new_folder,
    scenario_changes,
    with_options,
)
from unjam.cli.output import Counted, aside, console, metrics_table, print_json
from unjam.errors import InputError

LINE_EVERY = 5
"""iterations between two plain lines of progress where there is no terminal"""


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
    json: JsonOption = False,
) -> None:
    """Train a residual on an expert, judge it on held-out seeds, write a report.

    Examples:

      unjam train ring --preset demo

      unjam train ring --agent sac --steps 120000

      unjam train --config mixture.toml              (several roads together: its tables of tasks)

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
    changes = {**asked.flags, **{f"road.{key}": value for key, value in road.items()}, "workers": workers}
    changes |= settings
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
    from unjam.reports.story import signed  # and torch: seconds that nobody waits for a wrong word
    from unjam.training.evaluate import Evaluation
    from unjam.training.train import train as run

    with nullcontext() if json else _Progress(config.steps, folder) as shown:
        result = run(config, folder, resume is not None, shown and shown.iteration, shown and shown.judging)

    def facts(of: Any) -> dict[str, Any]:
        files = {"folder": str(of.folder), "controller": str(of.controller), "report": str(result.report)}
        gain = asdict(of.gain) if of.gain else None
        return {**files, "gain": gain, "drivers": Evaluation(of.rows, {}).means()}

    if json:
        roads = {name: facts(road) for name, road in result.roads.items()}
        print_json({**facts(result), "roads": roads} if roads else facts(result))
        return
    for name, of in (result.roads or {"": result}).items():
        if name:
            console.print(f"{name}:")
        console.print(metrics_table(of.rows))
        if of.gain is not None:
            console.print(f"return beyond the expert, held-out seeds, 95 % interval: {signed(of.gain)}")
        aside.print(f"controller: {of.controller}")
    aside.print(f"report: {result.report}")


class _Progress(Counted):
    """Progress of training: a bar with the newest returns on a terminal, plain lines elsewhere."""

    def __init__(self, steps: int, folder: Path) -> None:
        super().__init__(f"training into {folder}", "steps", steps)
        self._steps = steps
        self._validated = "-"

    def iteration(self, row: dict[str, Any]) -> None:
        """Show a row of progress."""
        if row["return_validation"] is not None:
            self._validated = f"{row['return_validation']:.0f}"
        expert = f"expert {row['return_expert']:.0f}"
        words = f"return {row['return_mean']:.0f}, validation {self._validated} ({expert})"
        if self._bar is not None:
            self._bar.update(self._task, completed=row["actual_steps"], description=words)
        elif row["iteration"] % LINE_EVERY == 1 or row["actual_steps"] >= self._steps:
            aside.print(
                f"iteration {row['iteration']}: {row['actual_steps']:,} of {self._steps:,} steps, {words}"
            )

    def judging(self, key: tuple[str, int], steps: int) -> None:
        """Say once that the training is over."""
        if self._validated != "":
            self._validated = ""
            if self._bar is not None:
                self._bar.update(self._task, description="evaluating on held-out seeds")
            else:
                aside.print("evaluating on held-out seeds")
