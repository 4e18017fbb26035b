"""`unjam train`: learn a residual on an expert."""

from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    AgentOption,
    CavShareOption,
    CavsOption,
    CavTypesOption,
    ConfigOption,
    ExpertOption,
    HumansOption,
    JsonOption,
    LengthOption,
    OutOption,
    OwnScenarioArgument,
    PresetOption,
    RadiusOption,
    RewardOption,
    RunSeedOption,
    SettingsOption,
    StepsOption,
    VehiclesOption,
    WarmupOption,
    WorkersOption,
    assignments,
    new_folder,
    road_changes,
    run_changes,
)
from unjam.errors import InputError

LINE_EVERY = 5
"""iterations between two plain lines of progress where there is no terminal"""


def train(
    scenario: OwnScenarioArgument = None,
    preset: PresetOption = "",
    config: ConfigOption = None,
    settings: SettingsOption = None,
    steps: StepsOption = None,
    seed: RunSeedOption = None,
    agent: AgentOption = None,
    expert: ExpertOption = None,
    reward: RewardOption = "",
    length: LengthOption = None,
    radius: RadiusOption = None,
    vehicles: VehiclesOption = None,
    cavs: CavsOption = None,
    warmup: WarmupOption = None,
    cav_share: CavShareOption = None,
    cav_types: CavTypesOption = None,
    humans: HumansOption = None,
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

      unjam train ring-jammed --expert follower-stopper --steps 500000 --seed 3

      unjam train ring --expert my_driver.py:gentle --reward my_reward.py:calm

      unjam train ring --expert runs/ring-001        (a trained controller as the expert)

      unjam train ring --humans drivers.json --set virtual.base=population

      unjam train --resume runs/ring-001 --steps 2000000
    """
    from unjam.training.config import load_config
    from unjam.training.folder import check_possible, read_config

    changes = run_changes(scenario, steps, seed, agent, expert, reward)
    changes |= {
        f"road.{key}": value
        for key, value in road_changes(
            length, radius, vehicles, cavs, warmup, cav_share, cav_types, humans
        ).items()
    }
    changes |= {"workers": workers}
    for key, value in assignments(settings).items():
        if key == "out":
            out = Path(str(value))
        else:
            changes[key] = value

    if resume is not None:
        if out is not None or preset or config is not None:
            raise InputError("resume: --out, --preset and --config are not allowed beside it")
        before = read_config(resume)
        made = load_config(resume / "config.toml", changes={"steps": before.steps, **changes})
        folder = resume
    else:
        made = load_config(config, preset, changes)
        folder = new_folder(out, made.scenario)
    check_possible(made)
    from unjam.training.train import train as run  # torch: seconds that nobody waits for a wrong word

    with nullcontext() if json else _Progress(made.steps, folder) as shown:
        result = run(made, folder, resume is not None, shown and shown.iteration, shown and shown.judging)
    _print_result(result, json)


class _Progress:
    """Progress of training: a bar with the newest returns on a terminal, plain lines elsewhere."""

    def __init__(self, steps: int, folder: Path) -> None:
        from unjam.cli.output import aside, bar

        self._console = aside
        self._steps = steps
        self._folder = folder
        self._bar = bar() if aside.is_terminal else None
        self._validated = "-"

    def __enter__(self) -> "_Progress":
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task(f"training into {self._folder}", total=self._steps)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def iteration(self, row: dict[str, Any]) -> None:
        """Show a row of progress."""
        if row["return_validation"] is not None:
            self._validated = f"{row['return_validation']:.0f}"
        expert = f"expert {row['return_expert']:.0f}"
        words = f"return {row['return_mean']:.0f}, validation {self._validated} ({expert})"
        if self._bar is not None:
            self._bar.update(self._task, completed=row["actual_steps"], description=words)
        elif row["iteration"] % LINE_EVERY == 1 or row["actual_steps"] >= self._steps:
            self._console.print(
                f"iteration {row['iteration']}: {row['actual_steps']:,} of {self._steps:,} steps, {words}"
            )

    def judging(self, key: tuple[str, int], steps: int) -> None:
        """Say once that the training is over."""
        if self._validated != "":
            self._validated = ""
            if self._bar is not None:
                self._bar.update(self._task, description="evaluating on held-out seeds")
            else:
                self._console.print("evaluating on held-out seeds")


def _print_result(result: Any, json: bool) -> None:
    from unjam.cli.output import aside, console, metrics_table, print_json
    from unjam.measures.statistics import summarise
    from unjam.reports.story import signed

    def facts(of: Any) -> dict[str, Any]:
        return {
            "folder": str(of.folder),
            "controller": str(of.controller),
            "report": str(result.report),
            "gain": asdict(of.gain) if of.gain else None,
            "drivers": {
                driver: {name: found.mean for name, found in summarise(rows).items()}
                for driver, rows in of.rows.items()
            },
        }

    if json:
        roads = {name: facts(road) for name, road in result.roads.items()}
        print_json({**facts(result), "roads": roads} if roads else facts(result))
        return
    for name, road in (result.roads or {"": result}).items():
        if name:
            console.print(f"{name}:")
        console.print(metrics_table(road.rows))
        if road.gain is not None:
            console.print(f"return beyond the expert, held-out seeds, 95 % interval: {signed(road.gain)}")
        aside.print(f"controller: {road.controller}")
    aside.print(f"report: {result.report}")
