"""`unjam drive`: run episodes with a driver, print metrics, write a report."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import (
    DEFAULT_WORKERS,
    CavShareOption,
    CavsOption,
    CavTypesOption,
    EpisodesOption,
    HumansOption,
    JsonOption,
    LengthOption,
    OutOption,
    RadiusOption,
    RewardOption,
    ScenarioArgument,
    SeedOption,
    VehiclesOption,
    WarmupOption,
    WorkersOption,
    assignments,
    new_folder,
    road_changes,
)


def drive(
    scenario: ScenarioArgument,
    driver: Annotated[
        list[str],
        typer.Option(
            "--driver",
            "-d",
            help="Who drives the CAVs: a name, name:parameter=value, your own path.py:name, a run folder, or "
            "a .unjam file; joined by + they share the CAVs. Given several times, they are compared on "
            "the same traffic.",
        ),
    ],
    episodes: EpisodesOption = 5,
    seed: SeedOption = 0,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="On the seeds that judge trainings, instead of --seed.")
    ] = False,
    length: LengthOption = None,
    radius: RadiusOption = None,
    vehicles: VehiclesOption = None,
    cavs: CavsOption = None,
    warmup: WarmupOption = None,
    cav_share: CavShareOption = None,
    cav_types: CavTypesOption = None,
    humans: HumansOption = None,
    reward: RewardOption = "",
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Any parameter of the scenario: key=value.")
    ] = None,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    report: Annotated[bool, typer.Option(help="Write the results and a report.html into a folder.")] = True,
    json: JsonOption = False,
) -> None:
    """Run episodes with a driver: live progress, a table of metrics, a report.

    Examples:

      unjam drive ring --driver human

      unjam drive ring-warm --driver pi --length 230

      unjam drive ring-jammed -d human -d pi -d pi:time_constant=0 --episodes 10

      unjam drive ring --driver my_driver.py:gentle --json

      unjam drive my.sumocfg --cav-share 0.1 --driver pi

      unjam drive ring-jammed -d human -d pi --humans drivers.json

      unjam drive ring -d pi -d runs/ring-001 --held-out --episodes 20
    """
    from unjam.cli.output import aside, console, counting_steps, metrics_table, print_json
    from unjam.scenarios.registry import make_scenario
    from unjam.training.drive import drive as run
    from unjam.training.drive import raise_failures

    road = {
        **road_changes(length, radius, vehicles, cavs, warmup, cav_share, cav_types, humans),
        **assignments(settings),
    }
    total = make_scenario(scenario, road).horizon * episodes * len(driver)
    folder = new_folder(out, f"drive-{Path(scenario).stem}") if report else None
    with counting_steps(f"driving {Path(scenario).name}", total) as steps:
        result = run(scenario, driver, episodes, seed, road, reward, workers, folder, steps, held_out)
    if json:
        print_json(result.document())
    elif any(row["status"] != "failed" for rows in result.rows.values() for row in rows):
        console.print(metrics_table(result.rows))
        if result.report is not None:
            aside.print(f"report: {result.report}")
    raise_failures(result)
