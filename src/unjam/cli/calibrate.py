"""A road of the user's own made to drive as its detectors measured: `unjam calibrate`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, JsonOption, OutOption, SeedOption, WorkersOption, new_folder
from unjam.cli.output import console, err_console, new_table, print_json, print_next_command
from unjam.cli.tune import SEED_LIMIT
from unjam.errors import invalid_value

CALIBRATION_COLUMNS = {
    "geh": ("mean GEH", "", 2),
    "geh_below_5": ("share of GEH below 5", "", 2),
    "flow_rmse": ("error of flow (RMSE)", "veh/h", 0),
    "speed_rmse": ("error of speed (RMSE)", "m/s", 2),
    "score": ("score", "", 3),
}
"""name, unit and digits of what is shown"""


def calibrate_command(
    scenario: Annotated[str, typer.Argument(help="Your own .sumocfg file.")],
    *,
    detectors: Annotated[
        Path, typer.Option(help="CSV file: edge or lane, position, begin, end, flow_veh_per_h, speed; SI units.")
    ],
    trials: Annotated[int, typer.Option(min=2, help="Settings that are tried, the network as it is included.")] = 60,
    seeds: Annotated[int, typer.Option(min=1, help="Simulations of each.")] = 3,
    vary: Annotated[
        list[str] | None, typer.Option(help="Factors that are varied: tau=0.5..2:log; without it, all, around 1.")
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
    from unjam.training.calibrate import calibration_document
    from unjam.training.corridor import load_corridor, parse_factor_space
    from unjam.training.run_folder import lock_new_folder
    from unjam.training.trial_log import REQUEST_FILE
    from unjam.worlds.sumo.detector_pool import DetectorPool

    if seed >= SEED_LIMIT:
        raise invalid_value("seed", seed, f"less than {SEED_LIMIT}")
    space = parse_factor_space(vary or [])
    asked = load_corridor(scenario, detectors, begin, end)
    if asked.excluded_count:
        err_console.print(f"{asked.excluded_count} of the intervals are left out: not between begin and end")
    folder = new_folder(out, f"calibrate-{Path(scenario).stem}")
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), DetectorPool(workers) as counting:
        on_line = (lambda line: None) if json else err_console.print
        found = run(asked, folder, counting, space, trials, seeds, seed, on_line)
    if json:
        print_json({"file": str(found.file), **calibration_document(replace(found, trials=[]))})
        return
    table = new_table(("measure", "unit"), ("original", "calibrated", "difference"))
    for name, columns in found.estimates().items():
        label, unit, digits = CALIBRATION_COLUMNS[name]
        cells = (
            f"{one.mean:.{digits}f} [{one.low:.{digits}f}, {one.high:.{digits}f}]" if one.count else "–"
            for one in columns.values()
        )
        table.add_row(label, unit, *cells)
    console.print(table)
    console.print(", ".join(f"{name} x {factor:g}" for name, factor in found.factors.items()), soft_wrap=True)
    times = {"--begin": begin, "--end": end}
    given = [word for name, time in times.items() if time is not None for word in (name, f"{time:g}")]
    print_next_command("assess it", "assess", found.file, *given)
