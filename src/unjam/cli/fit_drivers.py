"""`unjam fit-drivers`: calibrate a population of drivers on recorded trajectories."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from unjam.cli.options import JsonOption, SeedOption, assignments
from unjam.cli.output import Counted, aside, console, new_table, print_json


def fit_drivers(
    data: Annotated[
        list[Path],
        typer.Argument(help="Recorded trajectories: .parquet or .csv; several files are one data set."),
    ],
    out: Annotated[Path, typer.Option(help="File for the population.")] = Path("drivers.json"),
    format: Annotated[
        str,
        typer.Option(
            help="table, ngsim, ngsim-reconstructed, openacc.", show_default="told from the columns"
        ),
    ] = "",
    driver: Annotated[
        str, typer.Option(help="Columns of a table that together name the driver: period,follower.")
    ] = "",
    only: Annotated[
        list[str] | None, typer.Option(help="Only trajectories with column=value, like kind=human.")
    ] = None,
    residual: Annotated[
        bool, typer.Option(help="Also learn what all drivers do beside their own IDM: minutes.")
    ] = False,
    cut_bad: Annotated[
        bool, typer.Option("--cut-bad", help="Cut bad rows out of their trajectories instead of refusing.")
    ] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="calibration.generations=200, multi_step.steps=500 and the like."),
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
    from unjam.following.fit_drivers import fit_from_files
    from unjam.scenarios.population import write_population

    changes: dict[str, Any] = {"residual": residual, "seed": seed, **assignments(settings)}
    columns = tuple(name for name in driver.split(",") if name)
    chosen = {name: str(value) for name, value in assignments(only).items()}
    with Counted("calibrating drivers") as counted:
        found = fit_from_files(data, changes, format, cut_bad, columns, chosen, out, counted)
    write_population(out, found.population)
    if json:
        print_json({"population": str(out), "read": found.words, **found.facts()})
        return
    for line in found.words:
        aside.print(line)
    population: Any = found.population
    typical = asdict(population.typical)
    table = new_table(("parameter",), ("one for all", "mean", "std", "quartiles of the drivers"))
    for name, spread in population.spread().items():
        quartiles = "  ".join(f"{value:.2f}" for value in spread["quartiles"])
        values = (typical[name], spread["mean"], spread["std"])
        table.add_row(name, *(f"{value:.2f}" for value in values), quartiles)
    console.print(table)
    for line in found.verdict():
        console.print(line)
    aside.print(f"population: {out}")
