"""What would CAVs do on the user's own road? Controllers at several penetration rates, and two baselines.

The baselines are human drivers alone, and ACC vehicles without a controller. A controller is chosen for each
penetration rate on tuning seeds and tested on others; a rule says whether it is recommended.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from unjam.controller import DEFAULT_DRIVER, make_driver
from unjam.drivers.driver import Driver
from unjam.errors import InputError, NoCavError, invalid_value
from unjam.files import atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.effect import AccResult, ControllerResult, assessment_headline, plotted_result, recommended_result
from unjam.measures.notes import check_baseline, episode_notes
from unjam.measures.statistics import metric_estimate
from unjam.reports.assessment import ASSESSMENT_FILE, ASSESSMENT_PAGE, write_assessment
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import ACC_SETTINGS, UserNetwork
from unjam.training.evaluate import Evaluation, evaluate_on_roads, raise_failure, save_evaluation
from unjam.training.run_folder import make_new_folder
from unjam.training.seeds import make_test_seeds
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    UNCHANGED_ACC_DRIVER,
    EpisodeBudget,
    EpisodeSeed,
    Option,
    OptionMessageCallback,
    OptionRows,
    Selection,
    AssessmentFindings,
    compare_on_test_seeds,
    format_duration,
    min_episodes,
    select_controllers,
)
from unjam.worlds.episode import can_drive
from unjam.worlds.worker_pool import WorkerPool

DEFAULT_CONTROLLERS = (DEFAULT_DRIVER, "follower-stopper", "pi")
"""controllers that are tried where none is named: they fit roads with ends"""
ACC_PROPERTIES = ("acceleration", "deceleration", "keep_right", "speed_gain")
"""settings of the CAVs' ACC that replace a property of the vehicle"""
MIN_BASELINE_EPISODES = 20
"""episodes of the baseline for which early ends are counted before the last one: two of them are too many"""
PLOT_EPISODE_COUNT = 2
"""episodes of the budget that are kept for pictures"""
ZERO_PENETRATION_RATE = 1e-12
"""share of CAVs where people are alone: a network without any is not allowed"""
SELECTION_FOLDER = "selection"
"""folder within the results: the rows of the seeds that chose"""
CAV_SELECTION_OPTIONS = "penetration_rate", "cav_types", "cavs"
"""settings of a road that the penetration rates stand for"""
BASELINE_METRICS = ("travel_time", "outflow_veh_per_h", "fuel_ml_per_km", "human_braking_beyond_4_5", "collisions")


@dataclass(frozen=True)
class AssessmentRequest:
    """What is asked of a road; everything in it has been checked."""

    file: str
    network: UserNetwork
    """with human drivers alone"""
    drivers: dict[str, Driver]
    """the controllers"""
    penetration_rates: tuple[float, ...]
    episodes: int
    """at most, in all"""
    minutes: float | None
    """at most, looked at between batches"""
    precision: float
    """half-width of the interval of travel time that is narrow enough, as a share of people's"""

    @property
    def options(self) -> list[Option]:
        """All penetration rates with all controllers."""
        return [Option(share, driver) for share in self.penetration_rates for driver in self.drivers]

    @property
    def has_acc_properties(self) -> bool:
        """Whether the user replaces a property of the vehicles by another one for CAVs."""
        return any(getattr(self.network.cruise, name) is not None for name in ACC_PROPERTIES)

    def make_setup(self, option: Option) -> tuple[Scenario, Driver]:
        """Return the road with so many CAVs, and their driver."""
        if option == HUMAN_BASELINE:
            return self.network, make_driver(HUMAN_BASELINE.driver, self.network.control_step)
        road = replace(self.network, penetration_rate=option.penetration_rate)
        if option.driver not in (ACC_DRIVER, UNCHANGED_ACC_DRIVER):
            return road, self.drivers[option.driver]
        cruise = road.cruise
        if option.driver == UNCHANGED_ACC_DRIVER:
            cruise = replace(cruise, **dict.fromkeys(ACC_PROPERTIES))
        safety = replace(road.safety, active=False)
        return replace(road, actuation="cruise", safety=safety, cruise=cruise), make_driver(
            ACC_DRIVER, road.control_step
        )


def make_request(
    file: str,
    penetration_rates: Sequence[float],
    episodes: int,
    precision: float,
    minutes: float | None = None,
    drivers: Sequence[str] = DEFAULT_CONTROLLERS,
    options: dict[str, Any] | None = None,
) -> AssessmentRequest:
    """Return a question whose parts have been checked; a share of 0 is always asked for.

    Raises:
        InputError: one of them is wrong.
    """
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    for name in [name for name in options or {} if name in CAV_SELECTION_OPTIONS]:
        raise InputError(f"{name}: it is not allowed here: --penetration-rates says how many vehicles are CAVs")
    for share in penetration_rates:
        if not 0 <= share <= 1:
            raise invalid_value("penetration_rates", share, ">= 0, <= 1")
    asked = tuple(sorted(set(penetration_rates) - {0.0}))
    if not asked:
        raise invalid_value(
            "penetration_rates", ",".join(f"{share:g}" for share in penetration_rates), "one above 0 at least"
        )
    if minutes is not None and not minutes > 0:
        raise invalid_value("minutes", minutes, "> 0")
    if not 0 < precision < 1:
        raise invalid_value("precision", precision, "> 0, < 1")
    road = make_scenario(file, {**ACC_SETTINGS, **(options or {}), "penetration_rate": ZERO_PENETRATION_RATE})
    assert isinstance(road, UserNetwork)
    made = {name: make_driver(name, road.control_step) for name in drivers if name != ACC_DRIVER}
    for name, driver in made.items():
        if driver.is_native or not can_drive(driver, road):
            why = "the human baseline is driven anyway" if driver.is_native else "one that needs no closed road"
            raise invalid_value("driver", name, why)
    asked_for = AssessmentRequest(file, road, made, asked, episodes, minutes, precision)
    least = min_episodes(len(asked), len(made), asked_for.has_acc_properties) + PLOT_EPISODE_COUNT
    if episodes < least:
        controllers = f"{len(asked)} penetration rates and {len(made)} controllers"
        raise invalid_value("episodes", episodes, f">= {least} for {controllers}")
    return asked_for


@dataclass(frozen=True)
class Assessment:
    """The answer."""

    controller_results: list[ControllerResult]
    """the controller that was chosen for each penetration rate; none where all were set aside"""
    acc_results: list[AccResult]
    """what ACC vehicles alone do at each penetration rate"""
    document: dict[str, Any]
    """all of it but the rows, as `assessment.json` has it"""
    page: Path


def assess(
    request: AssessmentRequest,
    folder: Path,
    workers: WorkerPool,
    progress: Callable[[Any, int], None] | None = None,
    on_message: OptionMessageCallback = lambda line: None,
) -> Assessment:
    """Answer a question, and write rows, `assessment.json` and the page into a new folder.

    Nothing is written before all is known. The result does not depend on how many workers drive, where no
    minutes are asked for. `progress` is told now and then how many decisions an episode has made, `on_line`
    gets a line for each batch of episodes.

    Raises:
        InputError: the folder holds something, or no driver can drive this road.
    """
    make_new_folder(folder)
    budget, baseline = EpisodeBudget(request.episodes - 1, request.minutes, workers.count), OptionRows()

    def evaluate_options(
        options: Sequence[Option], seeds: Sequence[EpisodeSeed], with_plots: bool = False
    ) -> Evaluation:
        setups = {option.label: request.make_setup(option) for option in options}
        batch = budget.used_episodes

        def report_progress(episode: tuple[str, int], steps: int) -> None:
            if progress is not None:
                progress((batch, *episode), steps)

        found = evaluate_on_roads(setups, seeds, workers, progress=report_progress, with_plots=with_plots)
        budget.spend(len(options) * len(seeds))
        return found

    def run_options(options: Sequence[Option], seeds: Sequence[EpisodeSeed]) -> dict[Option, OptionRows]:
        rows = evaluate_options(options, seeds).rows
        humans = rows[HUMAN_BASELINE.label]
        baseline.extend(humans)
        check_baseline(baseline, MIN_BASELINE_EPISODES)
        # On a seed with which a small share picks no vehicle, human drivers alone are driven.
        return {
            option: [
                alone if row["error"] == NoCavError.__name__ else row
                for row, alone in zip(rows[option.label], humans, strict=True)
            ]
            for option in options
        }

    first = evaluate_options([HUMAN_BASELINE], make_test_seeds(1), with_plots=True)
    raise_failure(first.rows[HUMAN_BASELINE.label])
    took, whole = format_duration(budget.elapsed_seconds), format_duration(budget.estimate_seconds(budget.episodes))
    on_message(
        f"an episode of the human baseline took {took}; all {request.episodes} episodes on {workers.count} "
        f"workers may take {whole}" + (f", but at most {request.minutes:g} min" if request.minutes else "")
    )
    choice = select_controllers(request.options, run_options, budget, on_message)
    chose = budget.used_episodes - 1
    tested = compare_on_test_seeds(
        choice.finalists,
        request.penetration_rates,
        request.has_acc_properties,
        run_options,
        budget,
        request.precision,
        on_message,
    )
    best = plotted_result(tested.controller_results)
    option = Option(best.penetration_rate, best.driver) if best else Option(request.penetration_rates[-1], ACC_DRIVER)
    shown = first.plot_episodes | evaluate_options([option], make_test_seeds(1), with_plots=True).plot_episodes

    about = {"scenario": Path(request.file).name, "reward": request.network.reward, "manifest": manifest()}
    tried = {option.label: found for option, found in choice.rows.items()}
    rows = {option.label: found for option, found in tested.rows.items()}
    check_baseline(baseline)
    notes = [
        *episode_notes({label: [*tried.get(label, ()), *found] for label, found in rows.items()}),
        *request.network.notes,
    ]
    document = {**about, **_assessment_document(request, choice, tested, chose, budget), "notes": notes}
    save_evaluation(folder / SELECTION_FOLDER, Evaluation(tried, {}), about)
    save_evaluation(folder, Evaluation(rows, shown), about)
    atomic_write(folder / ASSESSMENT_FILE, to_json(document, indent=1))
    page = write_assessment(folder, folder / ASSESSMENT_PAGE)
    return Assessment(tested.controller_results, tested.acc_results, json.loads(to_json(document)), page)


def _assessment_document(
    request: AssessmentRequest,
    selection: Selection,
    findings: AssessmentFindings,
    selection_episodes: int,
    budget: EpisodeBudget,
) -> dict[str, Any]:
    """Return what is known in the end, but for the rows."""
    best = recommended_result(findings.controller_results)
    tried = [
        {
            **option._asdict(),
            "rejection_reason": selection.rejection_reasons.get(option, ""),
            "is_finalist": option in selection.finalists,
            "effect": asdict(selection.effect(option)),
        }
        for option in request.options
        if selection.rows[option]
    ]
    return {
        "headline": assessment_headline(
            findings.controller_results, findings.acc_results, findings.rows[HUMAN_BASELINE]
        ),
        "recommended": best and {"penetration_rate": best.penetration_rate, "driver": best.driver},
        "controller_results": [
            {**asdict(each), "reasons": each.reasons, "summary": each.summary} for each in findings.controller_results
        ],
        "acc_results": [
            {**asdict(each), "driver": ACC_DRIVER, "summary": each.summary} for each in findings.acc_results
        ],
        "candidates": tried,
        "baseline": {name: asdict(metric_estimate(findings.rows[HUMAN_BASELINE], name)) for name in BASELINE_METRICS},
        "road": {**scenario_recipe(request.network), "file": request.file},
        "human_drivers": request.network.human_description,
        "drivers": {name: driver.recipe().get("parameters", {}) for name, driver in request.drivers.items()},
        "penetration_rates": request.penetration_rates,
        "precision": request.precision,
        "budget": {"episodes": request.episodes, "minutes": request.minutes},
        "episodes": {"selection": selection_episodes, "total": budget.used_episodes},
        "seeds": {"selection": len(selection.rows[HUMAN_BASELINE]), "test": len(findings.rows[HUMAN_BASELINE])},
    }
