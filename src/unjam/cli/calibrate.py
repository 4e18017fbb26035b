"""Calibration of a user network to detector measurements: `unjam calibrate`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from unjam.cli.options import DEFAULT_WORKERS, JsonOption, OptunaSeedOption, OutOption, WorkersOption, new_folder
from unjam.cli.output import console, err_console, new_table, print_json, print_next_command

CALIBRATION_COLUMNS = {
    "geh": ("mean GEH", "", 2),
    "geh_below_5": ("share of GEH below 5", "", 2),
    "flow_rmse": ("flow error (RMSE)", "veh/h", 0),
    "speed_rmse": ("speed error (RMSE)", "m/s", 2),
    "score": ("score", "", 3),
}
"""label, unit and digits of each measure"""


def calibrate_command(
    scenario: Annotated[str, typer.Argument(help="Your own .sumocfg file.")],
    *,
    detectors: Annotated[
        Path, typer.Option(help="CSV file: edge or lane, position, begin, end, flow_veh_per_h, speed; SI units.")
    ],
    trials: Annotated[int, typer.Option(min=2, help="Number of settings, including the unchanged network.")] = 60,
    seeds: Annotated[int, typer.Option(min=1, help="Simulations of each.")] = 3,
    vary: Annotated[
        list[str] | None, typer.Option(help="Factors to vary: tau=0.5..2:log.", show_default="all, around 1")
    ] = None,
    begin: Annotated[float | None, typer.Option(min=0, help="Start time [s].")] = None,
    end: Annotated[float | None, typer.Option(min=0, help="End time [s].")] = None,
    seed: OptunaSeedOption = 0,
    workers: WorkersOption = DEFAULT_WORKERS,
    out: OutOption = None,
    json: JsonOption = False,
) -> None:
    """Calibrate vehicle types and flows of your own network to detectors; write a new network.

    Optuna searches factors on tau, accel, decel, minGap and speedFactor of the passenger types, and on the
    flows. The best trial and the unchanged network are evaluated on separate seeds. Your files are not modified.
    The same command with the same --out continues a stopped calibration, also with more trials.

    Examples:

      unjam calibrate my.sumocfg --detectors detectors.csv

      unjam calibrate my.sumocfg --detectors detectors.csv --vary tau=0.7..1.6 --vary flow=0.8..1.2

      unjam assess runs/calibrate-my-001/calibrated.sumocfg
    """
    from unjam.training.calibrate import calibrate, calibration_document
    from unjam.training.corridor import load_corridor, parse_factor_space
    from unjam.training.run_folder import lock_new_folder
    from unjam.training.trial_log import REQUEST_FILE
    from unjam.worlds.sumo.detector_pool import DetectorPool

    space = parse_factor_space(vary or [])
    corridor = load_corridor(scenario, detectors, begin, end)
    if corridor.excluded_count:
        err_console.print(f"{corridor.excluded_count} of the intervals are excluded: not between begin and end")
    folder = new_folder(out, f"calibrate-{Path(scenario).stem}")
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), DetectorPool(workers) as pool:
        on_message = (lambda line: None) if json else err_console.print
        result = calibrate(corridor, folder, pool, space, trials, seeds, seed, on_message)
    if json:
        print_json({"file": str(result.file), **calibration_document(replace(result, trials=[]))})
        return
    table = new_table(("measure", "unit"), ("original", "calibrated", "difference"))
    for name, columns in result.estimates().items():
        label, unit, digits = CALIBRATION_COLUMNS[name]
        cells = (
            f"{one.mean:.{digits}f} [{one.low:.{digits}f}, {one.high:.{digits}f}]" if one.count else "–"
            for one in columns.values()
        )
        table.add_row(label, unit, *cells)
    console.print(table)
    console.print(", ".join(f"{name} x {factor:g}" for name, factor in result.factors.items()), soft_wrap=True)
    times = {"--begin": begin, "--end": end}
    time_options = [word for name, time in times.items() if time is not None for word in (name, f"{time:g}")]
    print_next_command("assess it", "assess", result.file, *time_options)
