"""Lists of the scenarios and drivers in the package: `unjam scenarios` and `unjam drivers`."""

import ast
import inspect
import re
import textwrap
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from unjam.cli.options import JsonOption
from unjam.cli.output import console, new_table, print_json, print_wrapped, setting_text
from unjam.controller import PACKAGED_PREFIX, packaged_names
from unjam.controller.file import read_controller
from unjam.drivers.observation import FEATURES
from unjam.drivers.registry import DRIVERS
from unjam.errors import InputError, unknown_name
from unjam.files import atomic_write, check_parent_folder
from unjam.measures.gain import MEAN_GAIN_OBJECTIVE
from unjam.parameters import flatten_keys
from unjam.road_family import FAMILY_PREFIX, FAMILY_SCENARIOS
from unjam.scenarios import SCENARIOS, example_scenario, make_scenario, scenario_recipe
from unjam.scenarios.road import format_drawn_values
from unjam.worlds.backend import WorldOptions
from unjam.worlds.sumo.backend import SumoBackend

FAMILY_GROUP = FAMILY_PREFIX.rstrip("/")  # argument to list the roads of the family
MIN_TABLE_WIDTH = 100
"""minimum width of a terminal for a table of scenarios [characters]"""
PICTURE_SECONDS = 60.0  # simulated time until an open road is drawn [s]; at first it is almost empty


def scenarios_command(
    name: Annotated[str | None, Argument(help="Scenario to describe; family: list benchmark roads.")] = None,
    picture: Annotated[Path | None, Option(help="Draw the road with its first vehicles into this .png file.")] = None,
    json: JsonOption = False,
) -> None:
    """List the scenarios, or describe one: road, observation, reward, speed limit and all parameters.

    Examples:

    - unjam scenarios
    - unjam scenarios ring
    - unjam scenarios family
    - unjam scenarios figure-eight --picture eight.png
    """
    if picture is not None and (name is None or picture.suffix.lower() != ".png"):
        raise InputError("picture: it needs the name of a scenario, and a file that ends in .png")
    if name is None or name == FAMILY_GROUP:
        scenarios = SCENARIOS if name is None else {key: make_scenario(key) for key in FAMILY_SCENARIOS}
        if json:
            print_json({key: scenario_recipe(scenario) for key, scenario in scenarios.items()})
            return
        _print_scenarios(scenarios)
        if name is None:
            console.print(f"{len(FAMILY_SCENARIOS)} roads of `unjam benchmark`: unjam scenarios {FAMILY_GROUP}")
        return
    scenario = example_scenario(name)
    if picture is not None:
        _draw_scenario(scenario, name, picture)
    facts = [*scenario.summary(), *_common_facts(scenario)]
    if json:
        print_json({"name": name, "facts": dict(facts), "parameters": scenario_recipe(scenario)})
        return
    console.print(name, style="bold")
    table = new_table(("", ""))
    for fact in facts:
        table.add_row(*fact)
    console.print(table)
    _print_parameters(parameter_entries(scenario), "parameters (--set key=value)")


def _print_scenarios(scenarios: Mapping[str, Any]) -> None:
    """Print the main properties of scenarios as a table, or in a narrow terminal as a list."""
    headings = "road", "vehicles", "limit", "control steps", "warm-up"
    table = new_table(("scenario", *headings))
    for key, scenario in scenarios.items():
        warmup = f"{scenario.warmup * scenario.simulation_step:g} s"
        values = *map(dict(scenario.summary()).__getitem__, headings[:3]), f"{scenario.horizon:,}", warmup
        if console.width >= MIN_TABLE_WIDTH:
            table.add_row(key, *values)
            continue
        console.print(key, style="bold")
        print_wrapped("  " + "; ".join(f"{heading}: {value}" for heading, value in zip(headings, values, strict=True)))
    if table.rows:
        console.print(table)


def _draw_scenario(scenario: Any, name: str, path: Path) -> None:
    """Write a picture of the road of seed 0: a closed road at the start, an open road after `PICTURE_SECONDS`."""
    from unjam.reports.video import draw_road

    check_parent_folder(path)
    with SumoBackend() as sumo, sumo.open(scenario, (0,), WorldOptions()) as world:
        world.start(is_controlled=False)
        for _ in range(0 if scenario.is_closed else round(PICTURE_SECONDS / scenario.control_step)):
            world.advance(None)
        scene, drawn_values = world.scene(), world.road.drawn_values
    max_speed = max(1.0, float(scene.speeds.max(initial=0.0)))
    caption = "\n".join([name, *format_drawn_values(drawn_values)])
    content = BytesIO()
    draw_road(scene, max_speed, caption).save(content, "PNG")
    atomic_write(path, content.getvalue())


def _common_facts(scenario: Any) -> list[tuple[str, str]]:
    lowest, highest = scenario.acceleration_limits
    seconds = scenario.warmup * scenario.simulation_step
    end = "in training, a collision of a CAV" if scenario.reads_user_files else "a collision"
    return [
        ("episode", f"{scenario.horizon:,} control steps of {scenario.control_step:g} s; {end} ends it"),
        ("warm-up", f"{scenario.warmup} human-only steps ({seconds:g} s) before control, not counted"),
        ("human drivers", scenario.human_description),
        ("action", f"acceleration from {lowest:g} to {highest:g} m/s2, {scenario.actuation}"),
        ("observation", "; ".join(map(str, FEATURES["local"].inputs or ()))),
        ("reward", scenario.reward),
    ]


def drivers_command(
    name: Annotated[str | None, Argument(help="Driver to describe, with its parameters.")] = None,
    json: JsonOption = False,
) -> None:
    """List the drivers, or describe one with its parameters, which `--driver name:parameter=value` sets.

    Examples:

    - unjam drivers
    - unjam drivers pi
    """
    names = [*DRIVERS, *(f"{PACKAGED_PREFIX}{key}" for key in packaged_names())]
    if name is not None and name not in names:
        raise unknown_name("driver", name, names)
    names = names if name is None else [name]
    descriptions = {
        key: inspect.getdoc(DRIVERS[key]) or "" if key in DRIVERS else _packaged_summary(key, name is None)
        for key in names
    }
    parameters = {key: parameter_entries(DRIVERS[key]()) if key in DRIVERS else [] for key in names}
    summaries = {key: text.partition("\n")[0] for key, text in descriptions.items()}
    if json:
        print_json({key: {"description": summaries[key], "parameters": parameters[key]} for key in names})
    elif name is None:
        table = new_table(("driver", "description"))
        for row in summaries.items():
            table.add_row(*row)
        console.print(table)
        console.print("Parameters: unjam drivers NAME. Your own driver: --driver path.py:name, a function or a class.")
    else:
        console.print(f"[bold]{name}[/bold]", markup=True)
        console.print(re.sub(r"(?<!\n)\n(?!\n)", " ", descriptions[name]))  # joins the lines of a paragraph
        if rows := [row for row in parameters[name] if row["name"] != "time_step"]:
            _print_parameters(rows, f"parameters (--driver {name}:parameter=value)")


def _packaged_summary(name: str, is_brief: bool) -> str:
    """Return a text on a packaged controller and its performance; if brief, without parameters of the expert."""
    controller = read_controller(name)
    manifest = controller.manifest
    full_expert = manifest.get("expert", "")
    expert = full_expert.partition(":")[0] if is_brief else full_expert
    if tuning := manifest.get("tuning"):
        best, default = (f"{tuning[key]['score']:.4g}" for key in ("best", "default"))
        score = tuning["reward"] if tuning["reward"] == MEAN_GAIN_OBJECTIVE else "return"
        return f"{expert}, tuned: {score} {best} on tuning seeds, default parameters {default}"
    if summary := manifest.get("summary"):
        return summary if is_brief else f"{summary}\n\n{controller.driver.describe()}"
    metrics, label = manifest["metrics"], f"{expert} + residual, trained on {manifest['run']['scenario']}"
    speed, expert_speed = (metrics[name]["mean_speed"]["mean"] for name in ("trained", full_expert))
    seeds = f"{metrics['trained']['episodes']} test seeds"
    return f"{label}: mean speed {speed:.2f} m/s on {seeds}, expert {expert_speed:.2f} m/s"


def suggest_setting(option: str, command: str) -> str:
    """Return a hint that lists scenario parameters with the name of an unknown option, such as `--delay`, if any."""
    name, prefix = option.lstrip("-").replace("-", "_"), "scenario_options." if command in ("train", "search") else ""
    recipes = (scenario_recipe(example_scenario(name)) for name in SCENARIOS)
    keys = dict.fromkeys(key for recipe in recipes for key in flatten_keys(recipe) if f".{key}".endswith(f".{name}"))
    return f"; parameters of scenarios: {', '.join(f'--set {prefix}{key}=' for key in keys)}" if keys else ""


def parameter_entries(instance: Any) -> list[dict[str, Any]]:
    """Return name, default and description of each parameter of a parameter dataclass."""
    if not is_dataclass(instance) or isinstance(instance, type):
        return []
    texts: dict[str, str] = {}
    for base in reversed(type(instance).__mro__):
        texts |= _field_docstrings(base) if is_dataclass(base) else {}
    values = asdict(instance).items()
    return [{"name": name, "default": value, "description": texts.get(name, "")} for name, value in values]


def _field_docstrings(kind: type) -> dict[str, str]:
    """Return the docstring below each field of a class, by the name of the field."""
    try:
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    except (OSError, TypeError):
        return {}  # the class has no source file
    texts = {}
    for statement, next_statement in pairwise(getattr(definition, "body", [])):
        match statement, next_statement:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                texts[name] = inspect.cleandoc(text)
    return texts


def _print_parameters(rows: list[dict[str, Any]], title: str) -> None:
    """Print the name, default and meaning of each parameter in wrapped lines."""
    console.print(f"{title}, their defaults and meanings", style="dim", soft_wrap=True)
    for row in rows:
        name, value = row["name"], row["default"]
        values = {f"{name}.{key}": entry for key, entry in value.items()} if isinstance(value, dict) else {name: value}
        texts = {key: "(none)" if entry is None else setting_text(entry) or '""' for key, entry in values.items()}
        defaults = " ".join(f"{key}={text}" for key, text in texts.items())
        meaning = " ".join(row["description"].split())
        print_wrapped(f"  {defaults}" + (f": {meaning}" if meaning else ""))
