"""Options that several verbs share, each defined once: by itself, or in a group."""

import inspect
import os
from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from itertools import count
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from unjam.errors import InputError, invalid_value, unknown_name
from unjam.files import PACKAGED_PREFIX
from unjam.learners.settings import AGENT_NAMES
from unjam.parameters import parse_assignments
from unjam.training.executors import EXECUTORS, Executor
from unjam.trust import TRUST_CODE_OPTION, trusting_code

ScenarioArgument = Annotated[
    str, typer.Argument(help="A scenario's name (`unjam scenarios` lists them), or your own .sumocfg file.")
]
RewardOption = Annotated[
    str, typer.Option("--reward", help="Reward by name, or your own: path.py:name.", show_default="the scenario's")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="First seed.")]
ScenarioSettingsOption = Annotated[
    list[str] | None, typer.Option("--set", help="Any parameter of the scenario: key=value.")
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=1, help="Worker processes; the result does not depend on it.")
]
TrainingWorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Trainings at once.")]
ExecutorOption = Annotated[str, typer.Option(help="local, or ray: a cluster that shares the folder.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for the results.", show_default="a new one under runs/")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
HumansOption = Annotated[
    str | None,
    typer.Option(
        "--humans", help="The people on the road: a file of `unjam fit-drivers`, unjam:ngsim or unjam:astazero."
    ),
]
CavClassesOption = Annotated[
    str | None,
    typer.Option(
        help="Vehicle classes of which the share picks, on your own network: passenger,truck.",
        show_default="passenger cars",
    ),
]
BeginOption = Annotated[float | None, typer.Option(help="When your own network begins [s].")]
EndOption = Annotated[float | None, typer.Option(help="When it ends [s].")]

DEFAULT_WORKERS = os.cpu_count() or 1


def with_options(**groups: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a verb the options of whole groups.

    A group is a function whose parameters are options. They take the place of the verb's parameter of the
    group's name, which gets what the function makes of them.
    """
    members = {name: inspect.signature(group).parameters for name, group in groups.items()}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @wraps(command)
        def wrapper(**arguments: Any) -> None:
            for name, group in groups.items():
                arguments[name] = group(**{option: arguments.pop(option) for option in members[name]})
            command(**arguments)

        options = [
            option.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for name, parameter in inspect.signature(command).parameters.items()
            for option in members.get(name, {name: parameter}).values()
        ]
        wrapper.__signature__ = inspect.Signature(options)  # pyright: ignore[reportAttributeAccessIssue]
        return wrapper

    return decorate


def with_trust_option(command: Callable[..., None]) -> Callable[..., None]:
    """Give a verb the option with which it runs the Python code that folders of others name."""
    option = Annotated[bool, typer.Option(TRUST_CODE_OPTION, help="Run Python code that a folder names.")]
    signature = inspect.signature(command)
    added = inspect.Parameter("trust_code", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)

    @wraps(command)
    def wrapper(*, trust_code: bool, **arguments: Any) -> None:
        with trusting_code() if trust_code else nullcontext():
            command(**arguments)

    parameters = [*signature.parameters.values(), added]
    wrapper.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore[reportAttributeAccessIssue]
    return wrapper


def scenario_changes(
    length: Annotated[str | None, typer.Option(help="Length of the ring [m]: one, or a range like 220-270.")] = None,
    radius: Annotated[
        str | None, typer.Option(help="Radius of the figure eight [m]: one, or a range like 32-35.")
    ] = None,
    vehicles: Annotated[int | None, typer.Option(help="Number of vehicles.")] = None,
    cavs: Annotated[int | None, typer.Option(help="Number of CAVs among them.")] = None,
    warmup: Annotated[int | None, typer.Option(help="All-human simulation steps before the CAVs take over.")] = None,
    penetration_rate: Annotated[float | None, typer.Option(help="Share of CAVs, on roads with ends.")] = None,
    cav_types: Annotated[
        str | None, typer.Option(help="Vehicle types that are CAVs, on your own network: car,truck.")
    ] = None,
    cav_classes: CavClassesOption = None,
    begin: BeginOption = None,
    end: EndOption = None,
    humans: HumansOption = None,
) -> dict[str, Any]:
    """Return the changes to a scenario that the options of a road ask for."""
    asked = {
        "length": parse_range("length", length),
        "radius": parse_range("radius", radius),
        "vehicles": vehicles,
        "cavs": cavs,
        "warmup": warmup,
        "penetration_rate": penetration_rate,
        "cav_types": cav_types.split(",") if cav_types else None,
    }
    return {
        **{name: value for name, value in asked.items() if value is not None},
        **network_changes(cav_classes, begin, end, humans),
    }


def network_changes(
    cav_classes: CavClassesOption = None, begin: BeginOption = None, end: EndOption = None, humans: HumansOption = None
) -> dict[str, Any]:
    """Return the changes to a network of the user's own: eligible vehicles, time, human drivers."""
    file = humans if humans is None or humans.startswith(PACKAGED_PREFIX) else str(Path(humans).absolute())
    classes = cav_classes.split(",") if cav_classes else None
    asked = {"cav_classes": classes, "begin": begin, "end": end, "population": file}
    return {name: value for name, value in asked.items() if value is not None}


class TrainingOptions(NamedTuple):
    """What the options of a training ask for."""

    preset: str
    config: Path | None
    options: dict[str, Any]
    """keys of the configuration that have an option of their own, where it was given"""
    settings: dict[str, Any]
    """what `--set` says"""


def training_options(
    scenario: Annotated[
        str | None, typer.Argument(help="Name of the scenario; the configuration's if left out.")
    ] = None,
    preset: Annotated[
        str,
        typer.Option(help="Where to start: demo, quick, best, rings, shared-rings, everywhere, paper, paper-exact."),
    ] = "",
    config: Annotated[Path | None, typer.Option(help="TOML file with any keys of the configuration.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Any key of the configuration: key=value, trpo.gamma=0.995.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Actual simulator steps to train for.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the whole run.")] = None,
    agent: Annotated[str | None, typer.Option(help=f"Learner: {', '.join(AGENT_NAMES)}.")] = None,
    expert: Annotated[
        str | None, typer.Option(help="Driver that the residual is added to, as in drive --driver; none: no expert.")
    ] = None,
    reward: RewardOption = "",
) -> TrainingOptions:
    """Return what the options of a training ask for."""
    flags = {"scenario": scenario, "steps": steps, "seed": seed, "agent": agent, "expert": expert}
    given = {key: value for key, value in {**flags, "reward": reward or None}.items() if value is not None}
    return TrainingOptions(preset, config, given, parse_settings(settings))


MAX_NUMBER_DIGITS = 10
"""digits that a length or radius may have"""


def parse_range(name: str, text: str | None) -> tuple[int, int] | None:
    """Return (230, 230) for `230` and (220, 270) for `220-270`."""
    if text is None:
        return None
    parts = text.split("-")
    if len(parts) > 2 or not all(part.strip().isdecimal() and len(part) < MAX_NUMBER_DIGITS for part in parts):
        raise invalid_value(name, text, "metres, like 230 or 220-270")
    return int(parts[0]), int(parts[-1])


def parse_settings(texts: list[str] | None, option: str = "--set") -> dict[str, Any]:
    """Return what options like `--set key=value` say; `traffic_option` is named where one is wrong."""
    return parse_assignments(texts or [], option)


def new_folder(out: Path | None, name: str) -> Path:
    """Return the folder for new results: `out`, or the next free one under `runs/`."""
    if out is not None:
        return out
    words = Path(name).stem  # a scenario may be a file
    folders = (Path("runs") / f"{words}-{number:03d}" for number in count(1))
    return next(folder for folder in folders if not os.path.lexists(folder))


def find_executor(name: str) -> Executor:
    """Return where trainings run; raise `InputError` where there is no such executor."""
    if name not in EXECUTORS:
        raise unknown_name("executor", name, EXECUTORS)
    return name


def merge_settings(options: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return what options and `--set` ask for; raise `InputError` where both ask for the same."""
    if twice := options.keys() & settings.keys():
        raise InputError(f"--set {min(twice)}: it is not allowed beside the option for it")
    return options | settings
