"""Options that several commands share."""

import atexit
import inspect
import os
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from functools import wraps
from itertools import count
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from unjam.errors import InputError, invalid_value
from unjam.files import PACKAGED_PREFIX, claim_folder, remove_if_empty
from unjam.learners.settings import AGENT_NAMES
from unjam.parameters import parse_assignments
from unjam.training.executors import Executor
from unjam.trust import TRUST_CODE_OPTION, trusting_code

ScenarioArgument = Annotated[
    str, Argument(help="A scenario (`unjam scenarios` lists them), your own .sumocfg or .toml file, or path.py:name.")
]
RewardOption = Annotated[
    str, Option("--reward", help="Name of a reward, or your own: path.py:name.", show_default="the scenario's")
]
BackendOption = Annotated[
    str,
    Option(
        help="Simulator: sumo, batch (the same episodes on rings and recorded roads, elsewhere in distribution), or "
        "your own: path.py:name."
    ),
]
SeedOption = Annotated[int, Option("--seed", min=0, help="First seed.")]
OptunaSeedOption = Annotated[int, Option("--seed", min=0, max=2**32 - 1, help="First seed.")]
ScenarioSettingsOption = Annotated[list[str] | None, Option("--set", help="Any setting of the scenario: key=value.")]
WorkersOption = Annotated[
    int, Option("--workers", min=1, help="Worker processes; the result does not depend on their number.")
]
TrainingWorkersOption = Annotated[int, Option("--workers", min=1, help="Number of trainings at the same time.")]
ExecutorOption = Annotated[
    Executor, Option(help="Where trainings run: local, or ray (a cluster that shares the folder).")
]
OutOption = Annotated[
    Path | None, Option("--out", help="Folder for the results.", show_default="a new one under runs/")
]
AllMetricsOption = Annotated[
    bool, Option("--all", help="Print all metrics, and their differences to human drivers or the best expert.")
]
JsonOption = Annotated[bool, Option("--json", help="Print only one JSON document.")]
HumansOption = Annotated[
    str | None, Option("--humans", help="Human drivers: a file of `unjam fit-drivers`, unjam:ngsim or unjam:astazero.")
]

DEFAULT_WORKERS = os.cpu_count() or 1


def with_options(**groups: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Replace parameters of a command by groups of options.

    A group is a function whose parameters are options. They replace the command's parameter of the same name, which
    receives the return value of the function.
    """
    members = {name: inspect.signature(group).parameters for name, group in groups.items()}

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def wrapper(**arguments: Any) -> Any:
            for name, group in groups.items():
                arguments[name] = group(
                    **{option: arguments.pop(option) for option in members[name] if option in arguments}
                )
            return command(**arguments)

        options = inspect.signature(command).parameters.items()
        return _with_parameters(
            wrapper, (option for name, value in options for option in members.get(name, {name: value}).values())
        )

    return decorate


def with_trust_option(command: Callable[..., None]) -> Callable[..., None]:
    """Add the option --trust-code to a command, which allows Python code that a folder names."""
    option = Annotated[bool, Option(TRUST_CODE_OPTION, help="Run Python code that a folder names.")]
    parameter = inspect.Parameter("trust_code", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=option)

    @wraps(command)
    def wrapper(*, trust_code: bool, **arguments: Any) -> None:
        with trusting_code() if trust_code else nullcontext():
            command(**arguments)

    return _with_parameters(wrapper, [*inspect.signature(command).parameters.values(), parameter])


def _with_parameters(command: Callable[..., None], parameters: Iterable[inspect.Parameter]) -> Callable[..., None]:
    """Set the signature from which typer makes the options of a command."""
    keyword_parameters = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    command.__signature__ = inspect.Signature(keyword_parameters)  # pyright: ignore[reportFunctionMemberAccess]
    return command


def network_changes(
    cav_classes: Annotated[
        str | None, Option(help="Vehicle classes of CAVs on your own network: bus,truck.", show_default="passenger")
    ] = None,
    begin: Annotated[float | None, Option(help="Start time on your own network [s].")] = None,
    end: Annotated[float | None, Option(help="End time on your own network [s].")] = None,
    humans: HumansOption = None,
) -> dict[str, Any]:
    """Return the scenario settings from the options for user networks."""
    file = humans if humans is None or humans.startswith(PACKAGED_PREFIX) else str(Path(humans).absolute())
    classes = cav_classes.split(",") if cav_classes else None
    return _drop_none({"cav_classes": classes, "begin": begin, "end": end, "population": file})


@with_options(network=network_changes)
def scenario_changes(
    *,
    length: Annotated[str | None, Option(help="Length of the ring [m]: a number, or a range like 220-270.")] = None,
    radius: Annotated[str | None, Option(help="Radius of the figure eight [m]: 32, or a range like 32-35.")] = None,
    vehicles: Annotated[int | None, Option(help="Number of vehicles.")] = None,
    cavs: Annotated[int | None, Option(help="Number of CAVs among them.")] = None,
    warmup: Annotated[int | None, Option(help="Human-only simulation steps before the CAVs take over.")] = None,
    penetration_rate: Annotated[float | None, Option(help="Share of CAVs, on open roads.")] = None,
    cav_types: Annotated[str | None, Option(help="Vehicle types of CAVs on your own network: car,truck.")] = None,
    recordings: Annotated[
        str | None, Option(help="Recorded speeds: file, folder or pattern, on the road recorded.")
    ] = None,
    platoon: Annotated[str | None, Option(help="Vehicles behind the recorded one: `human*2 cav human*20`.")] = None,
    network: dict[str, Any],
) -> dict[str, Any]:
    """Return the scenario settings from the options of a command."""
    changes = {
        "length": parse_range("length", length),
        "radius": parse_range("radius", radius),
        "vehicles": vehicles,
        "cavs": cavs,
        "warmup": warmup,
        "penetration_rate": penetration_rate,
        "cav_types": cav_types.split(",") if cav_types else None,
        "recordings": None if recordings is None else str(Path(recordings).absolute()),
        "platoon": platoon,
    }
    return _drop_none(changes) | network


def _drop_none(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


TrainingOptions = tuple[Path | None, str, dict[str, Any]]
"""arguments of `load_config`: TOML file, name of a preset, and values of other options and of `--set` by key"""


def training_options(
    scenario: Annotated[str | None, Argument(help="Name of the scenario.", show_default="the configuration's")] = None,
    preset: Annotated[
        str, Option(help="Base configuration: demo, quick, best, rings, shared-rings, all-roads, paper, paper-exact.")
    ] = "",
    config: Annotated[Path | None, Option(help="TOML file with any configuration keys.")] = None,
    settings: Annotated[
        list[str] | None, Option("--set", help="Any configuration key: key=value, trpo.gamma=0.995.")
    ] = None,
    steps: Annotated[int | None, Option(min=1, help="Environment steps to train for.")] = None,
    seed: Annotated[int | None, Option(min=0, help="Seed of the whole run.")] = None,
    agent: Annotated[str | None, Option(help=f"Learner: {', '.join(AGENT_NAMES)}, or path.py:Class.")] = None,
    expert: Annotated[
        str | None, Option(help="Driver that the residual is added to, as in drive --driver; none: no expert.")
    ] = None,
    reward: RewardOption = "",
) -> TrainingOptions:
    """Return the values of the options that configure a training."""
    options = {"scenario": scenario, "steps": steps, "seed": seed, "agent": agent, "expert": expert}
    options = _drop_none({**options, "reward": reward or None})
    return config, preset, merge_settings(options, parse_settings(settings))


NUMBER_LENGTH_LIMIT = 10  # characters; a length or a radius has fewer


def parse_range(name: str, text: str | None) -> tuple[int, int] | None:
    """Return the range [m] of an option: (230, 230) for `230`, (220, 270) for `220-270`."""
    if text is None:
        return None
    parts = text.split("-")
    if len(parts) > 2 or not all(part.strip().isdecimal() and len(part) < NUMBER_LENGTH_LIMIT for part in parts):
        raise invalid_value(name, text, "meters, like 230 or 220-270")
    return int(parts[0]), int(parts[-1])


def parse_settings(texts: list[str] | None, option: str = "--set") -> dict[str, Any]:
    """Return the values of texts like `key=value` by key; errors begin with `option`."""
    return parse_assignments(texts or [], option)


def new_folder(out: Path | None, name: str) -> Path:
    """Return the folder for new results: `out`, or the next free folder under `runs/`, created for this process."""
    if out is not None:
        return out
    stem = Path(name).stem  # a scenario may be a file
    folders = (Path("runs") / f"{stem}-{index:03d}" for index in count(1))
    folder = next(folder for folder in folders if claim_folder(folder))
    atexit.register(remove_if_empty, folder)
    return folder


def merge_settings(options: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Return the values of options and of `--set`, by key; raise `InputError` if both set the same key."""
    if duplicates := options.keys() & settings.keys():
        raise InputError(f"--set {min(duplicates)}: it is not allowed together with the option for it")
    return options | settings


def check_page_path(path: Path) -> None:
    """Raise `InputError` unless a path ends in .html or .htm, which prevents overwriting another file."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise invalid_value("out", str(path), "a file that ends in .html")
