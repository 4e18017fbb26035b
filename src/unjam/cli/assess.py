"""What CAVs would do on a road of one's own: `unjam assess`."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    JsonOption,
    OutOption,
    ScenarioSettingsOption,
    WorkersOption,
    assignments,
    new_folder,
)
from unjam.cli.output import aside, console, counting_steps, print_json
from unjam.errors import wrong


def assess(
    *,
    scenario: Annotated[str, typer.Argument(help="Your own .sumocfg file.", metavar="FILE")],
    driver: Annotated[
        list[str] | None,
        typer.Option(
            "--driver",
            "-d",
            help="Who drives the CAVs, as in drive; given several times, the best of them is chosen.",
            show_default="those that fit roads with ends",
        ),
    ] = None,
    shares: Annotated[
        str, typer.Option(help="Shares of CAVs among the cars and the like; people alone are always driven.")
    ] = "0.02,0.05,0.1,0.2",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes in all, at most.")] = 400,
    minutes: Annotated[
        float | None, typer.Option(help="Minutes, at most; looked at between batches of episodes.")
    ] = None,
    precision: Annotated[
        float,
        typer.Option(
            help="Half-width of the interval of travel time that is narrow enough, as a share of it."
        ),
    ] = 0.02,
    settings: ScenarioSettingsOption = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """What would CAVs do on my road? Shares and drivers beside people alone, and a recommendation, or none.

    For each share a driver is chosen on some seeds and judged on fresh ones. It is recommended only where the
    interval of travel time lies below zero, flow is not lower, a car could drive so, and people brake hard no
    more often than alone.

    Examples:

      unjam assess my.sumocfg

      unjam assess my.sumocfg --shares 0.05,0.2 -d acc -d pi --minutes 30

      unjam assess my.sumocfg -d runs/my-001 --shares 0.1 --set horizon=6000 --json
    """
    from unjam.training.assess import DRIVERS_OF_OPEN_ROADS, question
    from unjam.training.assess import assess as run
    from unjam.worlds.workers import Workers

    drivers, changes = driver or DRIVERS_OF_OPEN_ROADS, assignments(settings)
    asked = question(scenario, _shares(shares), episodes, precision, minutes, drivers, changes)
    folder = new_folder(out, f"assess-{Path(scenario).stem}")
    total = asked.road.horizon * episodes
    with counting_steps("assessing, at most", total) as steps, Workers(workers) as pool:
        found = run(asked, folder, pool, steps, (lambda line: None) if json else aside.print)
    if json:
        print_json({**found.document, "folder": str(folder), "report": str(found.page)})
        return
    console.print(found.document["headline"], soft_wrap=True, markup=False)
    for each in found.judged:
        console.print(f"- {each.words}", soft_wrap=True, markup=False)
    aside.print(f"report: {found.page}", soft_wrap=True, markup=False)


def _shares(text: str) -> list[float]:
    """Return the numbers of a list like 0.02,0.1."""
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise wrong("shares", text, "numbers from 0 to 1, like 0.02,0.1") from None
