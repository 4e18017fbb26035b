"""Options that several verbs share, each defined once."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.errors import InputError, wrong_name
from unjam.learners.settings import AGENTS
from unjam.parameters import parse_assignments
from unjam.training.executors import EXECUTORS, Executor

ScenarioArgument = Annotated[
    str, typer.Argument(help="A scenario's name (`unjam scenarios` lists them), or your own .sumocfg file.")
]
RewardOption = Annotated[
    str,
    typer.Option(
        "--reward", help="Reward by name, or your own: path.py:name.", show_default="the scenario's"
    ),
]
EpisodesOption = Annotated[int, typer.Option("--episodes", "-n", min=1, help="Number of episodes.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="First seed.")]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=1, help="Worker processes; the result does not depend on it.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results.", show_default="a new one under runs/")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
LengthOption = Annotated[
    str | None, typer.Option("--length", help="Length of the ring [m]: one, or a range like 220-270.")
]
RadiusOption = Annotated[
    str | None, typer.Option("--radius", help="Radius of the figure eight [m]: one, or a range like 32-35.")
]
VehiclesOption = Annotated[int | None, typer.Option("--vehicles", help="Number of vehicles.")]
CavsOption = Annotated[int | None, typer.Option("--cavs", help="Number of CAVs among them.")]
CavShareOption = Annotated[
    float | None,
    typer.Option("--cav-share", help="Share of CAVs among the vehicles of your own network."),
]
CavTypesOption = Annotated[
    str | None,
    typer.Option("--cav-types", help="Vehicle types that are CAVs, on your own network: car,truck."),
]
HumansOption = Annotated[
    Path | None,
    typer.Option("--humans", help="Calibrated drivers, of `unjam fit-drivers`: the people on the road."),
]
OwnScenarioArgument = Annotated[
    str | None, typer.Argument(help="Name of the scenario; the configuration's if left out.")
]
PresetOption = Annotated[str, typer.Option(help="Named starting point: demo, best, paper.")]
ConfigOption = Annotated[Path | None, typer.Option(help="TOML file with any keys of the configuration.")]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option("--set", help="Any key of the configuration: key=value, trpo.gamma=0.995."),
]
StepsOption = Annotated[int | None, typer.Option(min=1, help="Actual simulator steps to train for.")]
RunSeedOption = Annotated[int | None, typer.Option(min=0, help="Seed of the whole run.")]
AgentOption = Annotated[str | None, typer.Option(help=f"Learner: {', '.join(AGENTS)}.")]
ExpertOption = Annotated[
    str | None,
    typer.Option(help="Driver that the residual is added to, as in drive --driver; none: no expert."),
]
ExecutorOption = Annotated[str, typer.Option(help="local, or ray: a cluster that shares the folder.")]
WarmupOption = Annotated[
    int | None, typer.Option("--warmup", help="All-human simulation steps before the CAVs take over.")
]

DEFAULT_WORKERS = os.cpu_count() or 1


def road_changes(
    length: str | None,
    radius: str | None,
    vehicles: int | None,
    cavs: int | None,
    warmup: int | None,
    cav_share: float | None,
    cav_types: str | None,
    humans: Path | None = None,
) -> dict[str, Any]:
    """Return the changes to a scenario that the road options ask for."""
    asked = {
        "length": parse_range("length", length),
        "radius": parse_range("radius", radius),
        "vehicles": vehicles,
        "cavs": cavs,
        "warmup": warmup,
        "cav_share": cav_share,
        "cav_types": cav_types.split(",") if cav_types else None,
        "population": str(humans.absolute()) if humans else None,
    }
    return {name: value for name, value in asked.items() if value is not None}


def parse_range(name: str, text: str | None) -> tuple[int, int] | None:
    """Return (230, 230) for `230` and (220, 270) for `220-270`."""
    if text is None:
        return None
    parts = text.split("-")
    if len(parts) > 2 or not all(part.strip().isdigit() for part in parts):
        raise InputError(f"{name}: {text!r} is not allowed; allowed: metres, like 230 or 220-270")
    return int(parts[0]), int(parts[-1])


def assignments(texts: list[str] | None) -> dict[str, Any]:
    """Return what `--set key=value` options say."""
    return parse_assignments(texts or [], "--set")


def run_changes(
    scenario: str | None,
    steps: int | None,
    seed: int | None,
    agent: str | None,
    expert: str | None,
    reward: str,
) -> dict[str, Any]:
    """Return what the flags of a training say, where they were given, as changes to its configuration."""
    flags = {"scenario": scenario, "steps": steps, "seed": seed, "agent": agent, "expert": expert}
    given = {key: value for key, value in flags.items() if value is not None}
    return {**given, "reward": reward} if reward else given


def new_folder(out: Path | None, name: str) -> Path:
    """Return the folder for new results: `out`, or the next free one under `runs/`."""
    if out is not None:
        return out
    words, number = Path(name).stem, 1  # a scenario may be a file
    while (Path("runs") / f"{words}-{number:03d}").exists():
        number += 1
    return Path("runs") / f"{words}-{number:03d}"


def executor_named(name: str) -> Executor:
    """Return where trainings run; raise `InputError` where there is no such executor."""
    for executor in EXECUTORS:
        if executor == name:
            return executor
    raise wrong_name("executor", name, EXECUTORS)
