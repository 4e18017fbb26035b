"""`unjam watch`: see an episode, in SUMO's window or as a film."""

from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import (
    CavShareOption,
    CavsOption,
    CavTypesOption,
    HumansOption,
    JsonOption,
    LengthOption,
    RadiusOption,
    ScenarioArgument,
    SeedOption,
    VehiclesOption,
    WarmupOption,
    assignments,
    road_changes,
)


def watch(
    scenario: ScenarioArgument,
    driver: Annotated[
        str, typer.Option("--driver", "-d", help="As in drive; a run folder shows its trained controller.")
    ],
    seed: SeedOption = 0,
    video: Annotated[
        Path | None, typer.Option(help="Write a film (.gif, .webp, .mp4) instead; needs no display.")
    ] = None,
    pace: Annotated[float, typer.Option(min=0.1, max=1000.0, help="Times as fast as life.")] = 10.0,
    length: LengthOption = None,
    radius: RadiusOption = None,
    vehicles: VehiclesOption = None,
    cavs: CavsOption = None,
    warmup: WarmupOption = None,
    cav_share: CavShareOption = None,
    cav_types: CavTypesOption = None,
    humans: HumansOption = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Any parameter of the scenario: key=value.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Watch an episode in SUMO's window, or write a film of it without a display.

    Examples:

      unjam watch ring --driver pi

      unjam watch ring-jammed --driver runs/ring-001 --video wave.mp4
    """
    from unjam.cli.output import aside, console, print_json
    from unjam.controller import make_driver
    from unjam.drivers.registry import describe
    from unjam.files import check_folder
    from unjam.measures.metrics import measure
    from unjam.reports.film import check_format, write_video
    from unjam.scenarios.registry import make_scenario
    from unjam.training.evaluate import raise_failure
    from unjam.training.watch import watch_in_window
    from unjam.worlds.workers import EpisodeTask, Workers

    road = make_scenario(
        scenario,
        {
            **road_changes(length, radius, vehicles, cavs, warmup, cav_share, cav_types, humans),
            **assignments(settings),
        },
    )
    driven = make_driver(driver, road.decision_step)
    if video is None:
        episode = watch_in_window(road, driven, (seed,), pace)
    else:
        check_format(video)
        check_folder(video)
        aside.print("driving")
        with Workers(1) as workers:
            episode = workers.run([EpisodeTask(road, driven, (seed,), full=True)])[0]
    row = measure(episode)
    if episode.ok and video is not None:
        aside.print("drawing")
        write_video(episode, video, describe(driven), pace)
    if json:
        print_json(
            {"scenario": scenario, "driver": driver, "video": str(video) if video else None, "episode": row}
        )
    raise_failure([row])
    if not json and video is not None:
        console.print(str(video))
