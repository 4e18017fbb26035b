"""A road of the user's own made to drive as its detectors measured: `unjam calibrate`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, JsonOption, OutOption, SeedOption, WorkersOption, new_folder
from unjam.cli.output import aside, console, new_table, print_json, say_next
from unjam.cli.tune import SEEDS_BELOW
from unjam.errors import wrong

SHOWN = {
    "geh": ("mean GEH", "", 2),
    "geh_below_5": ("share of GEH below 5", "", 2),
    "flow_rmse": ("error of flow (RMSE)", "veh/h", 0),
    "speed_rmse": ("error of speed (RMSE)", "m/s", 2),
    "score": ("score", "", 3),
}
"""name, unit and digits of what is shown"""


def calibrate(
    scenario: Annotated[str, typer.Argument(help="Your own .sumocfg file.")],
    *,
    detectors: Annotated[
        Path,
        typer.Option(help="CSV file: edge or lane, position, begin, end, flow_veh_per_h, speed; SI units."),
    ],
    trials: Annotated[
        int, typer.Option(min=2, help="Settings that are tried, the network as it is included.")
    ] = 60,
    seeds: Annotated[int, typer.Option(min=1, help="Simulations of each.")] = 3,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Factors that are varied: tau=0.5..2:log; without it, all, around 1."),
    ] = None,
    begin: Annotated[float | None, typer.Option(min=0, help="When to begin [s].")] = None,
    end: Annotated[float | None, typer.Option(min=0, help="When to end [s].")] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate your own network to detectors: vehicle types and flows, written as a new network.

    Factors on tau, accel, decel, minGap and speedFactor of the passenger types, and on the flows, are
    searched for with Optuna. The best and the network as it is are judged on seeds of their own. Your files
    stay as they are. After a stop the same command with the same --out goes on, also with more trials.

    Examples:

      unjam calibrate my.sumocfg --detectors detectors.csv

      unjam calibrate my.sumocfg --detectors detectors.csv --vary tau=0.7..1.6 --vary flows=0.8..1.2

      unjam assess runs/calibrate-my-001/calibrated.sumocfg
    """
    from unjam.training.calibrate import calibrate as run
    from unjam.training.calibrate import facts
    from unjam.training.corridor import corridor, varied
    from unjam.training.folder import new_and_owned
    from unjam.training.tried import ASKED
    from unjam.worlds.sumo.counting import Counting

    if seed >= SEEDS_BELOW:
        raise wrong("seed", seed, f"less than {SEEDS_BELOW}")
    space = varied(vary or [])
    asked = corridor(scenario, detectors, begin, end)
    if asked.left_out:
        aside.print(f"{asked.left_out} of the intervals are left out: not between begin and end")
    folder = new_folder(out, f"calibrate-{Path(scenario).stem}")
    with new_and_owned(folder, or_with=ASKED), Counting(workers) as counting:
        on_line = (lambda line: None) if json else aside.print
        found = run(asked, folder, counting, space, trials, seeds, seed, on_line)
    if json:
        print_json({"file": str(found.file), **facts(replace(found, trials=[]))})
        return
    table = new_table(("measure", "unit"), ("original", "calibrated", "difference"))
    for name, columns in found.estimates().items():
        label, unit, digits = SHOWN[name]
        cells = (
            f"{one.mean:.{digits}f} [{one.low:.{digits}f}, {one.high:.{digits}f}]" if one.count else "–"
            for one in columns.values()
        )
        table.add_row(label, unit, *cells)
    console.print(table)
    console.print(", ".join(f"{name} x {factor:g}" for name, factor in found.factors.items()), soft_wrap=True)
    times = {"--begin": begin, "--end": end}
    given = [word for name, time in times.items() if time is not None for word in (name, f"{time:g}")]
    say_next("assess it", "assess", found.file, *given)
