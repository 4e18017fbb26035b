"""Calibration: `unjam tune` of experts, `unjam calibrate` of user networks, `unjam fit-drivers` of human drivers."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from unjam.cli import options as opt
from unjam.cli import output
from unjam.cli.output import console, err_console, print_json
from unjam.errors import InputError
from unjam.road_family import FAMILY, ROAD_GROUPS
from unjam.scenarios import make_scenario
from unjam.scenarios.family import family_scenarios
from unjam.scenarios.population import reserve_population
from unjam.training.run_folder import lock_new_folder
from unjam.training.trial_log import REQUEST_FILE
from unjam.worlds.reward import make_reward
from unjam.worlds.sumo.detectors import DetectorPool
from unjam.worlds.worker_pool import WorkerPool

CALIBRATION_COLUMNS = {
    "geh": ("mean GEH", "", 2),
    "geh_below_5": ("share of GEH below 5", "", 2),
    "flow_rmse": ("flow error (RMSE)", "veh/h", 0),
    "speed_rmse": ("speed error (RMSE)", "m/s", 2),
    "score": ("score", "", 3),
}
"""label, unit and number of decimals of each metric"""


@opt.with_options(changes=opt.scenario_changes)
def tune_command(
    *,
    scenario: opt.ScenarioArgument,
    expert: Annotated[
        str, Option("--expert", help="Name of the expert, as in unjam drivers, or path.py:YourClass.")
    ] = "smooth-acc",
    steps: Annotated[int, Option(min=1, help="Maximum number of control steps of all trials together.")] = 2_000_000,
    vary: Annotated[
        list[str] | None,
        Option(
            help="Parameters to vary: name=low..high, name=low..high:log, or name=a,b,c.",
            show_default="all, from a quarter of the default to four times the default",
        ),
    ] = None,
    changes: dict[str, Any],
    settings: opt.ScenarioSettingsOption = None,
    reward: opt.RewardOption = "",
    backend: opt.BackendOption = "sumo",
    seed: opt.OptunaSeedOption = 0,
    screen: Annotated[
        bool | None,
        Option(
            help="Evaluate all trials in the batch simulator, and only the best of them in SUMO.",
            show_default="where the batch simulator supports the road",
        ),
    ] = None,
    max_string_gain: Annotated[
        float | None,
        Option(
            min=0.0,
            help="Largest amplification of a leader's oscillations, 0.001 to 1 Hz, on closed roads; 0: any.",
            show_default="1.02 on closed roads",
        ),
    ] = None,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Tune the parameters of an expert with Optuna.

    Trials are evaluated on tuning seeds, with the limits and the safety filter of the road; infeasible ones are
    rejected, and settings that amplify oscillations are not tried. The tuned expert is a controller that every
    command accepts. To continue a stopped tuning, repeat the command with the same --out.

    Examples:

    - unjam tune ring
    - unjam tune ring --expert pi --max-string-gain 0       (pi always amplifies some frequency)
    - unjam tune on-ramp --expert jam-ahead --vary min_speed=2..8 --steps 300000
    - unjam tune rings         (also shared-rings, figure-eights, motorways, or all-roads)
    """
    from unjam.training.search_space import default_search_space, expert_search_space
    from unjam.training.string_limit import MAX_STRING_GAIN
    from unjam.training.tune import tune

    changes = opt.merge_settings(changes, opt.parse_settings(settings))
    if scenario in ROAD_GROUPS:
        if reward:
            raise InputError(f"reward: not allowed with {scenario}; there the objective is the mean normalized gain")
        roads = family_scenarios(scenario, "training", changes=changes)
    else:
        roads = {scenario: make_scenario(scenario, changes)}
    first_road = next(iter(roads.values()))
    make_reward(reward or first_road.reward)
    space = default_search_space(expert, first_road.control_step)
    space = expert_search_space(vary, space) if vary else space
    folder = opt.new_folder(out, f"tune-{Path(scenario).stem}")
    on_message = (lambda line: None) if json else err_console.print
    if max_string_gain is None:
        max_string_gain = MAX_STRING_GAIN if any(road.is_closed for road in roads.values()) else 0.0
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), WorkerPool(workers) as pool:
        options = reward, seed, backend, on_message, screen, max_string_gain
        result = tune(roads, expert, space, steps, folder, pool, *options)
    best, default = result.best, result.default
    if json:
        counts = {"environment_steps": result.environment_steps, "batch_steps": result.batch_steps}
        print_json({"driver": result.driver, "best": asdict(best), "default": asdict(default), **counts})
        return
    console.print(f"{result.environment_steps:,} environment steps, {result.batch_steps:,} batch steps")
    default_score = default.verdict if default.score is None else f"{default.score:.4g}"
    scores = f"{best.driver}: {best.score:.4g} on tuning seeds; {default.driver}: {default_score}"
    console.print(scores, soft_wrap=True)
    road = FAMILY[next(iter(roads))].scenario if scenario in ROAD_GROUPS else scenario
    options = output.setting_options(changes, reward=reward, backend=backend)
    output.print_next_command("drive with it", "drive", road, "--driver", result.driver, "--test-seeds", *options)


def calibrate_command(
    scenario: Annotated[str, Argument(help="Your own .sumocfg file.")],
    *,
    detectors: Annotated[
        Path, Option(help="CSV file with edge or lane, position [m], begin [s], end [s], flow_veh_per_h, speed [m/s].")
    ],
    trials: Annotated[int, Option(min=2, help="Number of trials, including the unchanged network.")] = 60,
    seeds: Annotated[int, Option(min=1, help="Number of simulations per trial.")] = 3,
    vary: Annotated[
        list[str] | None,
        Option(help="Factors to vary: name=low..high, as in tau=0.5..2:log.", show_default="all, around 1"),
    ] = None,
    begin: Annotated[float | None, Option(min=0, help="Start time [s].")] = None,
    end: Annotated[float | None, Option(min=0, help="End time [s].")] = None,
    seed: opt.OptunaSeedOption = 0,
    workers: opt.WorkersOption = opt.DEFAULT_WORKERS,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Calibrate vehicle types and flows of your own network to detectors, and write a new network.

    Optuna searches factors for tau, accel, decel, minGap and speedFactor of the passenger types, and for the
    flows. The best trial and the unchanged network are evaluated on separate seeds. Your files are not modified.
    There is no --backend: only SUMO has detectors.
    To continue a stopped calibration, also with more trials, repeat the command with the same --out.

    Examples:

    - unjam calibrate my.sumocfg --detectors detectors.csv
    - unjam calibrate my.sumocfg --detectors detectors.csv --vary tau=0.7..1.6 --vary flow=0.8..1.2
    - unjam assess runs/calibrate-my-001/calibrated.sumocfg
    """
    from unjam.training.calibrate import calibrate, calibration_document, load_corridor, parse_factor_space

    space = parse_factor_space(vary or [])
    corridor = load_corridor(scenario, detectors, begin, end)
    if corridor.excluded_count:
        reason = "intervals of the detectors are excluded: they are not between begin and end"
        err_console.print(f"{corridor.excluded_count} {reason}")
    folder = opt.new_folder(out, f"calibrate-{Path(scenario).stem}")
    with lock_new_folder(folder, resumable_file=REQUEST_FILE), DetectorPool(workers) as pool:
        on_message = (lambda line: None) if json else err_console.print
        result = calibrate(corridor, folder, pool, space, trials, seeds, seed, on_message)
    if json:
        print_json({"file": str(result.file), **calibration_document(replace(result, trials=[]))})
        return
    table = output.new_table(("metric", "unit"), ("original", "calibrated", "difference"))
    for name, columns in result.estimates().items():
        label, unit, digits = CALIBRATION_COLUMNS[name]
        cells = (
            f"{column.mean:.{digits}f} [{column.low:.{digits}f}, {column.high:.{digits}f}]" if column.count else "–"
            for column in columns.values()
        )
        table.add_row(label, unit, *cells)
    console.print(table)
    console.print(", ".join(f"{name} x {factor:g}" for name, factor in result.factors.items()), soft_wrap=True)
    times = {"--begin": begin, "--end": end}
    time_options = [word for name, time in times.items() if time is not None for word in (name, f"{time:g}")]
    output.print_next_command("assess it", "assess", result.file, *time_options)


def fit_drivers_command(
    data: Annotated[
        list[Path], Argument(help="Files of recorded trajectories, .parquet or .csv; several files form one data set.")
    ],
    out: Annotated[Path, Option(help="File to write the population to.")] = Path("drivers.json"),
    format: Annotated[
        str,
        Option(
            help="Format: table, ngsim, ngsim-reconstructed, highd, openacc or fcd.",
            show_default="detected from the columns",
        ),
    ] = "",
    driver: Annotated[str, Option(help="Columns of a table that identify the driver, like period,follower.")] = "",
    select: Annotated[list[str] | None, Option(help="Only trajectories with column=value, like kind=human.")] = None,
    residual: Annotated[
        bool, Option(help="Also fit a network that is added to the IDM of every driver; takes minutes.")
    ] = False,
    drop_bad_rows: Annotated[
        bool, Option("--drop-bad-rows", help="Drop bad rows instead of refusing the file.")
    ] = False,
    settings: Annotated[list[str] | None, Option("--set", help="Any setting: key=value, like rounds=2.")] = None,
    seed: opt.SeedOption = 0,
    json: opt.JsonOption = False,
) -> None:
    """Calibrate human drivers to recorded trajectories, and write a population that any scenario can use.

    The IDM parameters minimize the error of the simulated gaps. Each driver has its own time headway, and the
    other parameters are the same for all drivers (--set 'individual=["time_headway","minimum_gap"]' changes
    this). The command lists the rows that it used, skipped and dropped.

    Examples:

    - unjam fit-drivers data.parquet
    - unjam fit-drivers trajectories.csv --format ngsim --out people.json --residual
    - unjam drive ring-jammed -d human -d pi --humans drivers.json
    """
    from unjam.following.fit_drivers import fit_drivers_from_files

    changes: dict[str, Any] = {"residual": residual, "seed": seed, **opt.parse_settings(settings)}
    columns = tuple(name for name in driver.split(",") if name)
    filters = {name: str(value) for name, value in opt.parse_settings(select, "--select").items()}
    with reserve_population(out) as write, output.ProgressReporter("calibrating drivers") as reporter:
        fit = fit_drivers_from_files(data, changes, format, drop_bad_rows, columns, filters, reporter)
        write(fit.population)
    if json:
        print_json({"population": str(out), "read": fit.notes, **fit.facts()})
        return
    for line in fit.notes:
        err_console.print(line)
    population: Any = fit.population
    typical = asdict(population.typical)
    table = output.new_table(("parameter",), ("one for all", "mean", "std", "quartiles of the drivers"))
    for name, statistics in population.parameter_statistics().items():
        values = (typical[name], statistics["mean"], statistics["std"])
        quartiles = "  ".join(f"{value:.2f}" for value in statistics["quartiles"])
        table.add_row(name, *(f"{value:.2f}" for value in values), quartiles)
    console.print(table)
    for line in fit.report_lines():
        console.print(line)
    err_console.print(f"population: {out}")
