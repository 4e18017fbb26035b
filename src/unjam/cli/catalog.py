"""What episodes are made of: `unjam scenarios`, `unjam drivers`, and people made by `unjam fit-drivers`."""

import ast
import inspect
import textwrap
from dataclasses import asdict, is_dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import JsonOption, SeedOption, parse_settings
from unjam.cli.output import ProgressReporter, console, err_console, new_table, print_json
from unjam.errors import InputError

PICTURE_SECONDS = 60.0
"""seconds after which a road with ends is drawn: at the start it is all but empty"""


def scenarios_command(
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
    from unjam.scenarios import SCENARIOS, example_scenario, scenario_recipe

    if picture is not None and (name is None or picture.suffix.lower() != ".png"):
        raise InputError("picture: wants the name of a scenario, and a file that ends in .png")
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
    scenario = example_scenario(name)
    if picture is not None:
        _draw_scenario(scenario, name, picture)
    facts = [*scenario.facts(), *_common_facts(scenario)]
    if json:
        print_json({"name": name, "facts": dict(facts), "parameters": scenario_recipe(scenario)})
        return
    console.print(name, style="bold")
    table = new_table()
    for fact in facts:
        table.add_row(*fact)
    console.print(table)
    console.print(_parameter_table(parameter_entries(scenario), "parameter (--set key=value)"))


def _draw_scenario(scenario: Any, name: str, path: Path) -> None:
    """Write a picture of the road that seed 0 draws: at the start, or a minute later where vehicles come."""
    from unjam.files import atomic_write, check_parent_folder
    from unjam.reports.video import draw_road
    from unjam.scenarios.road import ClosedRoad
    from unjam.worlds.sumo import make_traffic
    from unjam.worlds.sumo.sandboxed import open_simulation

    check_parent_folder(path)
    with open_simulation(scenario) as simulation:
        traffic = make_traffic(scenario, (0,), simulation)
        traffic.start(is_controlled=False)
        closed = isinstance(traffic.road, ClosedRoad)
        for _ in range(0 if closed else round(PICTURE_SECONDS / scenario.control_step)):
            traffic.advance(None)
        scene = traffic.scene()
    fastest = max(1.0, float(scene.speeds.max(initial=0.0)))
    words = "\n".join([name, *(f"{key} {value:g} m" for key, value in traffic.road.drawn.items())])
    content = BytesIO()
    draw_road(scene, fastest, words).save(content, "PNG")
    atomic_write(path, content.getvalue())


def _common_facts(scenario: Any) -> list[tuple[str, str]]:
    from unjam.drivers.observation import FEATURES
    from unjam.scenarios.user_network import UserNetwork

    warmup, seconds = scenario.warmup, scenario.warmup * scenario.simulation_step
    ends = "in training, a collision of a CAV" if isinstance(scenario, UserNetwork) else "a collision"
    return [
        ("episode", f"{scenario.horizon:,} decisions of {scenario.control_step:g} s; {ends} ends it"),
        ("warm-up", f"{warmup} all-human steps ({seconds:g} s), before control, not counted"),
        ("people", scenario.human_description),
        ("action", f"acceleration within ±{scenario.action_limit:g} m/s2, {scenario.actuation}"),
        ("observation", "; ".join(map(str, FEATURES["local"].inputs or ()))),
        ("reward", scenario.reward),
    ]


def drivers_command(json: JsonOption = False) -> None:
    """List the drivers and their parameters, as `--driver name:parameter=value` takes them.

    Example:

      unjam drivers
    """
    from unjam.controller import PACKAGED_PREFIX, packaged_names
    from unjam.drivers.registry import DRIVERS

    listed: dict[str, dict[str, Any]] = {
        name: {"about": (kind.__doc__ or "").strip().splitlines()[0], "parameters": parameter_entries(kind())}
        for name, kind in DRIVERS.items()
    }
    for name in packaged_names():
        listed[f"{PACKAGED_PREFIX}{name}"] = {"about": _packaged_summary(name), "parameters": []}
    if json:
        print_json(listed)
        return
    for name, entry in listed.items():
        console.print(f"[bold]{name}[/bold]  {entry['about']}", markup=True)
        rows = [row for row in entry["parameters"] if row["name"] != "time_step"]
        if rows:
            console.print(_parameter_table(rows, "parameter"))
        if name in DRIVERS:
            console.print()
    console.print("\nYour own: --driver path.py:name, a function or a class; check it with unjam.check_driver.")


def _packaged_summary(name: str) -> str:
    """Return what a shipped controller is, and what it was measured to do, from its manifest."""
    from unjam.controller import packaged_file
    from unjam.controller.file import read_controller
    from unjam.measures.gain import MEAN_GAIN

    manifest = read_controller(packaged_file(name)).manifest
    if tuned := manifest.get("tuned"):
        after, before = (f"{tuned[one]['score']:.4g}" for one in ("best", "default"))
        what = tuned["reward"] if tuned["reward"] == MEAN_GAIN else "return"
        return f"{manifest['expert']}, tuned: {what} {after} on tuning seeds, before {before}"
    if about := manifest.get("about"):
        return about
    expert, metrics, road = manifest["expert"], manifest["metrics"], manifest["run"]["scenario"]
    ours, theirs = (metrics[label]["mean_speed"]["mean"] for label in ("trained", expert))
    return (
        f"{expert} + residual, trained on {road}: {ours:.2f} m/s of all vehicles on "
        f"{metrics['trained']['episodes']} held-out seeds, its expert {theirs:.2f}"
    )


def parameter_entries(instance: Any) -> list[dict[str, Any]]:
    """Return name, value and meaning of each parameter of a parameter dataclass."""
    if not is_dataclass(instance) or isinstance(instance, type):
        return []
    about: dict[str, str] = {}
    for base in reversed(type(instance).__mro__):
        if is_dataclass(base):
            about |= _field_docstrings(base)
    return [{"name": name, "default": value, "about": about.get(name, "")} for name, value in asdict(instance).items()]


def _field_docstrings(kind: type) -> dict[str, str]:
    """Return the text under each field of a class; read from its source only where somebody asks."""
    try:
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    except (OSError, TypeError):
        return {}  # a class without a file
    texts = {}
    for line, below in pairwise(getattr(definition, "body", [])):
        match line, below:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                texts[name] = inspect.cleandoc(text)
    return texts


def _parameter_table(rows: list[dict[str, Any]], title: str) -> Any:
    table = new_table((title, "default", "meaning"), style="dim")
    for row in rows:
        value = row["default"]
        if isinstance(value, dict):
            value = ", ".join(
                f"{key}={f'{entry:g}' if type(entry) in (int, float) else str(entry).lower()}"
                for key, entry in value.items()
            )
        table.add_row(f"  {row['name']}", str(value), " ".join(row["about"].split()))
    return table


def fit_drivers_command(
    data: Annotated[
        list[Path], typer.Argument(help="Recorded trajectories: .parquet or .csv; several files are one data set.")
    ],
    out: Annotated[Path, typer.Option(help="File for the population.")] = Path("drivers.json"),
    format: Annotated[
        str,
        typer.Option(
            help="table, ngsim, ngsim-reconstructed, highd, openacc, fcd.", show_default="told from the columns"
        ),
    ] = "",
    driver: Annotated[
        str, typer.Option(help="Columns of a table that together name the driver: period,follower.")
    ] = "",
    select: Annotated[
        list[str] | None, typer.Option(help="Only trajectories with column=value, like kind=human.")
    ] = None,
    residual: Annotated[
        bool, typer.Option(help="Also learn what all drivers do beside their own IDM: minutes.")
    ] = False,
    drop_bad_rows: Annotated[
        bool, typer.Option("--cut-bad", help="Cut bad rows out of their trajectories instead of refusing.")
    ] = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="calibration.generations=200, multi_step.steps=500 and the like.")
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = False,
) -> None:
    """Calibrate how people drive on recorded trajectories: a population that any road can have.

    All drivers get the IDM with which the simulated gaps are nearest to the recorded ones, each with a time
    headway of its own (--set 'own=["time_headway","minimum_gap"]' says what else). What was read and what was
    not is said line by line.

    Examples:

      unjam fit-drivers data.parquet

      unjam fit-drivers trajectories.csv --format ngsim --out people.json --residual

      unjam drive ring-jammed -d human -d pi --humans drivers.json
    """
    from unjam.following.fit_drivers import fit_drivers_from_files
    from unjam.scenarios.population import write_population

    changes: dict[str, Any] = {"residual": residual, "seed": seed, **parse_settings(settings)}
    columns = tuple(name for name in driver.split(",") if name)
    chosen = {name: str(value) for name, value in parse_settings(select, "--only").items()}
    with ProgressReporter("calibrating drivers") as counted:
        found = fit_drivers_from_files(data, changes, format, drop_bad_rows, columns, chosen, out, counted)
    write_population(out, found.population)
    if json:
        print_json({"population": str(out), "read": found.notes, **found.facts()})
        return
    for line in found.notes:
        err_console.print(line)
    population: Any = found.population
    typical = asdict(population.typical)
    table = new_table(("parameter",), ("one for all", "mean", "std", "quartiles of the drivers"))
    for name, spread in population.spread().items():
        quartiles = "  ".join(f"{value:.2f}" for value in spread["quartiles"])
        values = (typical[name], spread["mean"], spread["std"])
        table.add_row(name, *(f"{value:.2f}" for value in values), quartiles)
    console.print(table)
    for line in found.report_lines():
        console.print(line)
    err_console.print(f"population: {out}")
