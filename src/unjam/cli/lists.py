"""`unjam scenarios` and `unjam drivers`: what there is."""

from dataclasses import asdict, fields, is_dataclass
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import JsonOption
from unjam.cli.output import console, new_table, print_json
from unjam.errors import InputError

SHOWN_SHARE = 0.1
"""share of CAVs with which your own network is listed"""
PICTURED_AFTER = 60.0
"""seconds after which a road with ends is drawn: at the start it is all but empty"""


def scenarios(
    name: Annotated[str | None, typer.Argument(help="One scenario, in full.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Draw its road with the vehicles at the start: a .png file.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the scenarios; of one, its road, observation, reward, limit and every parameter.

    Examples:

      unjam scenarios

      unjam scenarios ring

      unjam scenarios figure-eight --picture eight.png
    """
    from rich.markup import escape

    from unjam.scenarios import SCENARIOS, scenario_recipe

    if picture is not None:
        if name is None or picture.suffix.lower() != ".png":
            raise InputError("picture: wants the name of a scenario, and a file that ends in .png")
        _draw(_scenario(name), name, picture)
    if name is None:
        if json:
            print_json({key: scenario_recipe(scenario) for key, scenario in SCENARIOS.items()})
            return
        shown = ("road", "vehicles", "limit")
        table = new_table(("scenario", *shown, "decisions", "warm-up"))
        for key, scenario in SCENARIOS.items():
            facts = dict(scenario.facts())
            warmup = f"{scenario.warmup * scenario.simulation_step:g} s"
            table.add_row(key, *(facts[fact] for fact in shown), f"{scenario.horizon:,}", warmup)
        console.print(table)
        return
    scenario = _scenario(name)
    facts = [*scenario.facts(), *_common_facts(scenario)]
    if json:
        print_json({"name": name, "facts": dict(facts), "parameters": scenario_recipe(scenario)})
        return
    console.print(f"[bold]{name}[/bold]")
    table = new_table()
    for fact in facts:
        table.add_row(*map(escape, fact))
    console.print(table)
    console.print(_parameter_table(parameter_rows(scenario), "parameter (--set key=value)"))


def _scenario(name: str) -> Any:
    """Return a scenario by name; your own network has no default share of CAVs, and gets one here."""
    from unjam.scenarios import make_scenario

    return make_scenario(name, {"cav_share": SHOWN_SHARE} if name.endswith(".sumocfg") else None)


def _draw(scenario: Any, name: str, path: Path) -> None:
    """Write a picture of the road that seed 0 draws: at the start, or a minute later where vehicles come."""
    from unjam.files import check_folder, write_whole
    from unjam.reports.film import draw_road
    from unjam.scenarios.road import ClosedRoad
    from unjam.worlds.sumo import make_traffic
    from unjam.worlds.sumo.simulation import Simulation

    check_folder(path)
    with Simulation() as simulation:
        traffic = make_traffic(scenario, (0,), simulation)
        traffic.start(controlled=False)
        closed = isinstance(traffic.road, ClosedRoad)
        for _ in range(0 if closed else round(PICTURED_AFTER / scenario.decision_step)):
            traffic.advance(None)
        scene = traffic.scene()
    fastest = max(1.0, float(scene.speeds.max(initial=0.0)))
    words = "\n".join([name, *(f"{key} {value:g} m" for key, value in traffic.road.drawn.items())])
    content = BytesIO()
    draw_road(scene, fastest, words).save(content, "PNG")
    write_whole(path, content.getvalue())


def _common_facts(scenario: Any) -> list[tuple[str, str]]:
    from unjam.drivers.observation import FEATURES

    warmup, seconds = scenario.warmup, scenario.warmup * scenario.simulation_step
    return [
        ("episode", f"{scenario.horizon:,} decisions of {scenario.decision_step:g} s; a collision ends it"),
        ("warm-up", f"{warmup} all-human steps ({seconds:g} s), before control, not counted"),
        ("people", scenario.people_in_words),
        ("action", f"acceleration within ±{scenario.action_limit:g} m/s2, {scenario.actuation}"),
        ("observation", "; ".join(map(str, FEATURES["local"].numbers or ()))),
        ("reward", scenario.reward),
    ]


def drivers(json: JsonOption = False) -> None:
    """List the drivers and their parameters, as `--driver name:parameter=value` takes them.

    Example:

      unjam drivers
    """
    from unjam.controller.naming import SHIPPED, shipped_names
    from unjam.drivers.registry import DRIVERS

    listed: dict[str, dict[str, Any]] = {}
    for name, kind in DRIVERS.items():
        about = (kind.__doc__ or "").strip().splitlines()[0]
        listed[name] = {"about": about, "parameters": parameter_rows(kind())}
    for name in shipped_names():
        listed[f"{SHIPPED}{name}"] = {"about": _about_shipped(name), "parameters": []}
    if json:
        print_json(listed)
        return
    for name, entry in listed.items():
        console.print(f"[bold]{name}[/bold]  {entry['about']}")
        rows = [row for row in entry["parameters"] if row["name"] != "time_step"]
        if rows:
            console.print(_parameter_table(rows, "parameter"))
        if name in DRIVERS:
            console.print()
    console.print(
        "\nYour own: --driver path.py:name, a function or a class; check it with unjam.check_driver."
    )


def _about_shipped(name: str) -> str:
    """Return what a shipped controller is, and what it was measured to do, from its manifest."""
    from unjam.controller.file import read_controller
    from unjam.controller.naming import shipped_file

    manifest = read_controller(shipped_file(name)).manifest
    expert, metrics, road = manifest["expert"], manifest["metrics"], manifest["run"]["scenario"]
    ours, theirs = (metrics[label]["mean_speed"]["mean"] for label in ("trained", expert))
    return (
        f"{expert} + residual, trained on {road}: {ours:.2f} m/s of all vehicles on "
        f"{metrics['trained']['episodes']} held-out seeds, its expert {theirs:.2f}"
    )


def parameter_rows(instance: Any) -> list[dict[str, Any]]:
    """Return name, value and meaning of each parameter of a parameter dataclass."""
    if not is_dataclass(instance) or isinstance(instance, type):
        return []
    about: dict[str, str] = {}
    for base in reversed(type(instance).__mro__):  # pydantic forgets the texts of inherited fields
        own = getattr(base, "__pydantic_fields__", {})
        about |= {name: field.description for name, field in own.items() if field.description}
    values = asdict(instance)
    return [
        {"name": field.name, "default": values[field.name], "about": about.get(field.name, "")}
        for field in fields(instance)
    ]


def _parameter_table(rows: list[dict[str, Any]], title: str) -> Any:
    from rich.markup import escape

    table = new_table((title, "default", "meaning"), style="dim")
    for row in rows:
        value = row["default"]
        if isinstance(value, dict):
            value = ", ".join(f"{key}={entry:g}" for key, entry in value.items())
        table.add_row(f"  {row['name']}", escape(str(value)), escape(" ".join(row["about"].split())))
    return table
