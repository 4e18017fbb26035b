"""Assessment of CAVs on a user's network: controllers at several penetration rates, compared with two baselines.

These are human drivers alone, and ACC vehicles without a controller.
"""

import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import ceil, isfinite
from pathlib import Path
from typing import Any, cast

from unjam.controller import DEFAULT_DRIVER, make_driver
from unjam.drivers.driver import Driver
from unjam.drivers.registry import driver_recipe, is_serializable
from unjam.errors import InputError, NoCavError, invalid_value
from unjam.files import FileWatch, atomic_write, to_json
from unjam.manifest import manifest
from unjam.measures.feasibility import HARD_BRAKING_METRIC
from unjam.measures.notes import check_baseline, episode_notes
from unjam.measures.recommendation import (
    MIN_VERDICT_SEEDS,
    UNDECIDED,
    AccResult,
    ControllerResult,
    acc_finding,
    plotted_result,
    recommended_result,
    road_verdict,
)
from unjam.measures.statistics import metric_estimate
from unjam.reports.assessment import ASSESSMENT_FILE, ASSESSMENT_PAGE, keep_earlier_answer, write_assessment
from unjam.scenarios import make_scenario, scenario_recipe
from unjam.scenarios.scenario import Scenario
from unjam.scenarios.user_network import ACC_SETTINGS, UserNetwork
from unjam.seeds import held_out_seeds
from unjam.text import format_count, format_duration
from unjam.training.episode_log import EpisodeLog
from unjam.training.evaluate import Evaluation, evaluate_on_roads, raise_failure, save_evaluation
from unjam.training.executors import MessageCallback
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    UNCHANGED_ACC_DRIVER,
    AssessmentFindings,
    EpisodeBudget,
    EpisodeSeed,
    Option,
    OptionRows,
    Selection,
    compare_on_test_seeds,
    min_episodes,
    select_controllers,
    verdict_episodes,
)
from unjam.worlds.episode import check_can_drive
from unjam.worlds.worker_pool import WorkerPool

StageCallback = Callable[[str, int], None]
"""called with the name of a stage that begins, and its maximum number of control steps"""
DEFAULT_CONTROLLERS = (DEFAULT_DRIVER, "follower-stopper", "pi")
ACC_PROPERTIES = ("acceleration", "deceleration", "keep_right", "speed_gain")
"""settings of the CAVs' ACC that replace a property of the vehicle"""
SPEEDS_AHEAD = {"lane_speeds", "road_speeds", "congestion"}
"""fields of a `LocalState` with messages about the traffic ahead"""
MIN_BASELINE_EPISODES = 20
"""episodes of the baseline to which early ends are related before the last one: two of them are too many"""
PLOT_EPISODE_COUNT = 2
ZERO_PENETRATION_RATE = 1e-12
"""penetration rate of human-only traffic: zero is not allowed on user networks"""
SELECTION_FOLDER = "selection"
"""folder within the results with the rows of the selection seeds"""
CAV_SELECTION_OPTIONS = "penetration_rate", "cav_types", "cavs"
"""options of a road that the penetration rates replace"""
BASELINE_METRICS = ("travel_time", "outflow_veh_per_h", "fuel_ml_per_km", HARD_BRAKING_METRIC, "collisions")


@dataclass(frozen=True)
class AssessmentRequest:
    """The settings of an assessment, all of them checked."""

    file: str
    network: UserNetwork
    """user network with human drivers alone"""
    drivers: dict[str, Driver]
    penetration_rates: tuple[float, ...]
    episodes: int
    minutes: float | None
    """time budget, checked between batches"""
    precision: float
    """target half-width of the CI of travel time, as a share of the baseline's travel time"""

    @property
    def options(self) -> list[Option]:
        """All penetration rates with all controllers."""
        return [Option(rate, driver) for rate in self.penetration_rates for driver in self.drivers]

    @property
    def compared_options(self) -> list[Option]:
        """All that may be simulated: the human baseline, ACC vehicles and the controllers."""
        return [HUMAN_BASELINE, *(Option(rate, ACC_DRIVER) for rate in self.penetration_rates), *self.options]

    @property
    def has_acc_properties(self) -> bool:
        """Whether the user replaces a property of the vehicles for CAVs."""
        return any(getattr(self.network.cruise, name) is not None for name in ACC_PROPERTIES)

    @property
    def verdict_episodes(self) -> int:
        """Number of episodes of the smallest verdict."""
        counts = len(self.penetration_rates), len(self.drivers), self.has_acc_properties
        return verdict_episodes(*counts) + PLOT_EPISODE_COUNT

    @property
    def smallest_question(self) -> "AssessmentRequest":
        """The same request with its median penetration rate and first controller only."""
        rate = self.penetration_rates[len(self.penetration_rates) // 2]
        drivers = dict(list(self.drivers.items())[:1])
        return replace(self, penetration_rates=(rate,), drivers=drivers)

    def make_setup(self, option: Option) -> tuple[Scenario, Driver]:
        """Return the road with this penetration rate, and the driver of the CAVs."""
        if option == HUMAN_BASELINE:
            return self.network, make_driver(HUMAN_BASELINE.driver, self.network.control_step)
        road = replace(self.network, penetration_rate=option.penetration_rate)
        if option.driver not in (ACC_DRIVER, UNCHANGED_ACC_DRIVER):
            return road, self.drivers[option.driver]
        unchanged = dict.fromkeys(ACC_PROPERTIES if option.driver == UNCHANGED_ACC_DRIVER else ())
        safety, cruise = replace(road.safety, active=False), replace(road.cruise, **unchanged)
        road = replace(road, actuation="cruise", safety=safety, cruise=cruise)
        return road, make_driver(ACC_DRIVER, road.control_step)


def make_request(
    file: str,
    penetration_rates: Sequence[float],
    episodes: int,
    precision: float,
    minutes: float | None = None,
    drivers: Sequence[str] = DEFAULT_CONTROLLERS,
    options: dict[str, Any] | None = None,
) -> AssessmentRequest:
    """Return a checked request, with the human baseline; raise `InputError` if an argument is wrong."""
    if not file.endswith(".sumocfg"):
        raise invalid_value("scenario", file, "your own .sumocfg file")
    for name in [name for name in options or {} if name in CAV_SELECTION_OPTIONS]:
        raise InputError(f"{name}: it is not allowed here: --penetration-rates says how many vehicles are CAVs")
    for rate in penetration_rates:
        if not 0 <= rate <= 1:
            raise invalid_value("penetration_rates", rate, "shares from 0 to 1, such as 0.05 for 5 %")
    rates = tuple(sorted(set(penetration_rates) - {0.0}))
    if not rates:
        text = ",".join(f"{rate:g}" for rate in penetration_rates)
        raise invalid_value("penetration_rates", text, "one above 0 at least")
    if minutes is not None and not minutes > 0:
        raise invalid_value("minutes", minutes, "> 0")
    if not 0 < precision < 1:
        raise invalid_value("precision", precision, "> 0, < 1")
    changes = {**ACC_SETTINGS, **(options or {}), "penetration_rate": ZERO_PENETRATION_RATE}
    road = cast(UserNetwork, make_scenario(file, changes))
    controllers = {name: make_driver(name, road.control_step) for name in drivers if name != ACC_DRIVER}
    for name, driver in controllers.items():
        if driver.is_native:
            raise invalid_value("driver", name, "the human baseline is always included")
        check_can_drive(driver, road, f"driver {name}")
    request = AssessmentRequest(file, road, controllers, rates, episodes, minutes, precision)
    minimum = min_episodes(len(rates), len(controllers), request.has_acc_properties) + PLOT_EPISODE_COUNT
    if episodes < minimum:
        counts = format_count(len(rates), "penetration rate"), format_count(len(controllers), "controller")
        allowed = f">= {minimum} for {' and '.join(counts)}"
        raise invalid_value("episodes", episodes, allowed)
    return request


@dataclass(frozen=True)
class Assessment:
    """The result of an assessment."""

    controller_results: list[ControllerResult]
    """results of the controller that was selected for each penetration rate; empty if all were rejected"""
    acc_results: list[AccResult]
    document: dict[str, Any]
    """the content of `assessment.json`: everything except the rows"""
    page: Path


def assess(
    request: AssessmentRequest,
    folder: Path,
    workers: WorkerPool,
    progress: Callable[[Any, int], None] | None = None,
    on_message: MessageCallback = lambda line: None,
    on_stage: StageCallback = lambda name, steps: None,
) -> Assessment:
    """Run an assessment, and write rows, `assessment.json` and the page into a folder, at its end.

    Finished batches are in a log: in the same folder an assessment of the same road and files resumes, or continues
    with other controllers, penetration rates and budgets. Without `minutes`, the result does not depend on the number
    of workers. `progress` is called with the control steps of an episode, `on_stage` when a batch of episodes begins,
    and `on_message` with a line about its result. Raise `InputError` if the folder has something else, or no driver can
    drive on this road.
    """
    log = EpisodeLog(folder, request.network)
    if log.episodes:
        known = f"{format_count(len(log.episodes), 'episode')} of earlier calls in {folder}"
        on_message(f"{known}: not simulated again for the same controllers; data that their code reads is not compared")
    watch = FileWatch(lambda: request.network.user_files)
    budget, baseline = EpisodeBudget(request.episodes - 1, request.minutes, workers.count), OptionRows()

    def evaluate_options(
        stage: str, options: Sequence[Option], seeds: Sequence[EpisodeSeed], with_plots: bool = False
    ) -> Evaluation:
        on_stage(stage, request.network.horizon * len(options) * len(seeds))
        setups = {option.label: request.make_setup(option) for option in options}
        batch = budget.used_episodes

        def report_progress(episode: tuple[str, int], steps: int) -> None:
            if progress is not None:
                progress((batch, *episode), steps)

        return evaluate_on_roads(setups, seeds, workers, progress=report_progress, with_plots=with_plots, watch=watch)

    def run_options(kind: str, options: Sequence[Option], seeds: Sequence[EpisodeSeed]) -> dict[Option, OptionRows]:
        hashes = {option: log.setup_hash(*request.make_setup(option)) for option in options}
        missing = [(option, seed) for option in options for seed in seeds if (hashes[option], seed) not in log.episodes]
        new_options, new_seeds = dict.fromkeys(option for option, _ in missing), sorted({seed for _, seed in missing})
        if missing:
            first, last = new_seeds[0][-1] + 1, new_seeds[-1][-1] + 1
            numbers = f"seeds {first} to {last}" if first < last else f"seed {first}"
            stage = f"simulating {kind} {numbers} of {format_count(len(new_options), 'option')}"
            new_rows = evaluate_options(stage, [*new_options], new_seeds).rows
            for option in new_options:
                log.add(hashes[option], new_seeds, new_rows[option.label])
        budget.spend(len(options) * len(seeds), len(new_options) * len(new_seeds))
        rows = {option: [log.episodes[hashes[option], seed] for seed in seeds] for option in options}
        human_rows = rows[HUMAN_BASELINE]
        baseline.extend(human_rows)
        check_baseline(baseline, MIN_BASELINE_EPISODES)
        # If a low penetration rate selects no vehicle for a seed, the traffic is the human baseline.
        return {
            option: [
                human if row["error"] == NoCavError.__name__ else row
                for row, human in zip(rows[option], human_rows, strict=True)
            ]
            for option in options
        }

    first = evaluate_options("simulating the human baseline, seed 1 of 1", [HUMAN_BASELINE], held_out_seeds(1), True)
    budget.spend(1)
    raise_failure(first.rows[HUMAN_BASELINE.label])
    setups = {log.setup_hash(*request.make_setup(option)) for option in request.compared_options}
    stored_episodes = sum(setup in setups for setup, _ in log.episodes)
    for line in budget_lines(request, budget, stored_episodes):
        on_message(line)
    selection = select_controllers(request.options, partial(run_options, "tuning"), budget, on_message)
    selection_episodes = budget.used_episodes - 1
    rates, precision = request.penetration_rates, request.precision
    findings = compare_on_test_seeds(
        selection.finalists,
        rates,
        request.has_acc_properties,
        partial(run_options, "test"),
        budget,
        precision,
        on_message,
    )
    best = plotted_result(findings.controller_results)
    plotted = Option(best.penetration_rate, best.driver) if best else Option(rates[-1], ACC_DRIVER)
    plot_episodes = first.plot_episodes
    plot_episodes |= evaluate_options("simulating the pictures", [plotted], held_out_seeds(1), True).plot_episodes
    budget.spend(1)

    metadata = {"scenario": Path(request.file).name, "reward": request.network.reward, "manifest": manifest()}
    selection_rows = {option.label: rows for option, rows in selection.rows.items()}
    test_rows = {option.label: rows for option, rows in findings.rows.items()}
    check_baseline(baseline)
    all_rows = {label: [*selection_rows.get(label, ()), *rows] for label, rows in test_rows.items()}
    document = {
        **metadata,
        **_assessment_document(request, selection, findings, selection_episodes, budget),
        "notes": [*episode_notes(all_rows), *request.network.notes, *sensing_notes(request)],
    }
    save_evaluation(folder / SELECTION_FOLDER, Evaluation(selection_rows, {}), metadata)
    save_evaluation(folder, Evaluation(test_rows, plot_episodes), metadata)
    if kept_page := keep_earlier_answer(folder, rates, document["drivers"]):
        on_message(f"the answer to the earlier question is now in {kept_page}")
    atomic_write(folder / ASSESSMENT_FILE, to_json(document, indent=1))
    page = write_assessment(folder, folder / ASSESSMENT_PAGE)
    return Assessment(findings.controller_results, findings.acc_results, json.loads(to_json(document)), page)


def budget_lines(request: AssessmentRequest, budget: EpisodeBudget, stored_episodes: int = 0) -> list[str]:
    """Return how long a verdict and the whole budget take, and a smaller question, one line each."""

    def seconds(episodes: int) -> float:
        return budget.estimate_seconds(max(0, episodes - stored_episodes))

    def duration(episodes: int) -> str:
        stored = f", {min(stored_episodes, episodes):,} of them stored" if stored_episodes else ""
        return f"{format_count(episodes, 'episode')}{stored}, about {format_duration(seconds(episodes))}"

    needed, limit = request.verdict_episodes, f" or {request.minutes:g} min" if request.minutes else ""
    lines = [f"a verdict needs at least {MIN_VERDICT_SEEDS} test seeds: {duration(needed)}"]
    too_small = ", which is too small for a verdict" if request.episodes < needed else ""
    lines.append(f"the budget is at most {duration(request.episodes)}{limit}{too_small}")
    fewest = min_episodes(len(request.penetration_rates), len(request.drivers), request.has_acc_properties)
    if request.minutes and seconds(fewest) > 60.0 * request.minutes:
        lines.append(
            f"an answer takes longer than {request.minutes:g} min: about {format_duration(seconds(fewest))}, "
            "as each option is simulated at least once"
        )
    elif request.minutes and seconds(needed) > 60.0 * request.minutes:
        lines.append(f"{request.minutes:g} min are too short for a verdict")
    small = request.smallest_question
    if len(request.options) > 1:
        (option,) = small.options
        question = f"--penetration-rates {option.penetration_rate:g} -d {shlex.quote(option.driver)}"
        lines.append(f"a smaller question, {question}, needs at least {duration(small.verdict_episodes)}")
    return lines


def missing_budget(request: AssessmentRequest, findings: AssessmentFindings, budget: EpisodeBudget) -> dict[str, Any]:
    """Return the budget with which the open questions would probably be answered.

    All penetration rates stay, and only controllers are left out: they were selected on other seeds. The estimate from
    fewer seeds than a verdict needs is rough, so that the smallest budget of a verdict is returned, too.
    """
    undecided = [each for each in findings.controller_results if each.verdict == UNDECIDED]
    needed = [each.difference_to_acc.count + each.missing_seeds for each in undecided]
    seeds = max([MIN_VERDICT_SEEDS, *(ceil(each) for each in needed if isfinite(each))])
    drivers = list(dict.fromkeys(each.driver for each in undecided))
    counts = len(request.penetration_rates), len(drivers), request.has_acc_properties
    is_rough = any(each.difference_to_acc.count < MIN_VERDICT_SEEDS for each in undecided)
    min_seeds = MIN_VERDICT_SEEDS if is_rough else seeds
    fewest, episodes = (verdict_episodes(*counts, n, len(undecided)) + PLOT_EPISODE_COUNT for n in (min_seeds, seeds))
    return {
        "test_seeds": seeds,
        "min_test_seeds": min_seeds,
        "episodes": episodes,
        "min_episodes": fewest,
        "seconds": budget.estimate_seconds(episodes),
        "min_seconds": budget.estimate_seconds(fewest),
        "drivers": drivers,
    }


def sensing_notes(request: AssessmentRequest) -> list[str]:
    """Return what the controllers are assumed to know of the traffic ahead, if any of them reads it."""
    readers = [
        name for name, driver in request.drivers.items() if SPEEDS_AHEAD & set(driver.requirements().measured_fields)
    ]
    if not readers:
        return []
    known = request.network.roadside.description
    return [f"{', '.join(readers)}: assumed to know {known}; roadside.latency, smoothing_time and loss_rate change it"]


def _range_text(low: int, high: int) -> str:
    return f"{low:,} to {high:,}" if low < high else f"about {high:,}"


def _assessment_document(
    request: AssessmentRequest,
    selection: Selection,
    findings: AssessmentFindings,
    selection_episodes: int,
    budget: EpisodeBudget,
) -> dict[str, Any]:
    best = recommended_result(findings.controller_results)
    baseline_rows = findings.rows[HUMAN_BASELINE]
    answer, missing = road_verdict(findings.controller_results, baseline_rows), None
    if answer.verdict == UNDECIDED:
        missing = missing_budget(request, findings, budget)
        seeds, episodes = (_range_text(missing[f"min_{name}"], missing[name]) for name in ("test_seeds", "episodes"))
        duration = f"at most about {format_duration(missing['seconds'])}"
        more = f"a verdict needs {seeds} test seeds ({episodes} episodes, {duration})"
        answer = answer._replace(sentence=f"{answer.sentence.removesuffix('.')}; {more}.")
    candidates = [
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
        "verdict": answer.verdict,
        "headline": answer.sentence,
        "acc_finding": acc_finding(findings.acc_results),
        "missing_budget": missing,
        "recommended": best and {"penetration_rate": best.penetration_rate, "driver": best.driver},
        "controller_results": [
            {**asdict(each), "reasons": each.reasons, "verdict": each.verdict, "summary": each.summary}
            for each in findings.controller_results
        ],
        "acc_results": [
            {**asdict(each), "driver": ACC_DRIVER, "summary": each.summary} for each in findings.acc_results
        ],
        "candidates": candidates,
        "baseline": {name: asdict(metric_estimate(baseline_rows, name)) for name in BASELINE_METRICS},
        "road": {**scenario_recipe(request.network), "file": request.file},
        "human_drivers": request.network.human_description,
        "drivers": {
            name: driver_recipe(driver)[0] if is_serializable(driver) else {"policy": driver.describe()}
            for name, driver in request.drivers.items()
        },
        "penetration_rates": request.penetration_rates,
        "precision": request.precision,
        "budget": {"episodes": request.episodes, "minutes": request.minutes},
        "episodes": {"selection": selection_episodes, "total": budget.used_episodes},
        "seeds": {"selection": len(selection.rows[HUMAN_BASELINE]), "test": len(baseline_rows)},
    }
