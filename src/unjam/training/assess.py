"""Assessment of CAVs on a user's network, with several controllers and penetration rates.

They are compared with two baselines: human-only traffic, and ACC vehicles without a controller.
"""

import json
import shlex
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import ceil, isfinite
from pathlib import Path
from typing import Any

from unjam.drivers.registry import driver_recipe, is_serializable
from unjam.errors import NoCavError, raise_failure
from unjam.files import atomic_write, to_json
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
from unjam.reports.assessment import (
    ASSESSMENT_FILE,
    ASSESSMENT_PAGE,
    archive_assessment,
    count_assessed_seeds,
    write_assessment,
)
from unjam.scenarios import scenario_recipe
from unjam.scenarios.file_watch import watch_files
from unjam.seeds import held_out_seeds
from unjam.text import format_count, format_duration
from unjam.training.assessment_request import PLOT_EPISODE_COUNT, AssessmentRequest
from unjam.training.episode_log import EpisodeLog
from unjam.training.evaluate import DriverAndEpisode, Evaluation, evaluate_on_roads, save_evaluation
from unjam.training.executors import MessageCallback
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    MIN_TEST_SEEDS,
    AssessmentFindings,
    EpisodeBudget,
    EpisodeSeed,
    Option,
    OptionRows,
    Selection,
    compare_on_test_seeds,
    min_episodes,
    seeds_at_once,
    select_controllers,
    verdict_episodes,
)
from unjam.worlds.record import Episode
from unjam.worlds.worker_pool import WorkerPool

StageCallback = Callable[[str, int], None]
"""called with the name of a stage that begins, and its maximum number of control steps"""
FIELDS_AHEAD = {"lane_speeds", "road_speeds", "congestion"}
"""fields of a `LocalState` with roadside information about the traffic ahead"""
MIN_SEEDS = {"tuning": 1, "test": MIN_TEST_SEEDS}
"""seeds of each kind that are simulated even if the time is up"""
MIN_BASELINE_EPISODES = 20
"""minimum denominator of the share of baseline episodes that end early, until the last episode has run"""
SELECTION_FOLDER = "selection"
"""folder within the results for the rows of the selection seeds"""
BASELINE_METRICS = ("travel_time", "outflow_veh_per_h", "fuel_ml_per_km", HARD_BRAKING_METRIC, "collisions")


@dataclass(frozen=True)
class Assessment:
    """The result of an assessment."""

    controller_results: list[ControllerResult]
    """result of the selected controller for each penetration rate, without rates at which all were rejected"""
    acc_results: list[AccResult]
    document: dict[str, Any]
    """the content of `assessment.json`: everything except the rows"""
    page: Path
    """the HTML page"""


def assess(
    request: AssessmentRequest,
    folder: Path,
    workers: WorkerPool,
    progress: Callable[[Any, int], None] | None = None,
    on_message: MessageCallback = lambda line: None,
    on_stage: StageCallback = lambda name, steps: None,
) -> Assessment:
    """Run an assessment, and write rows, `assessment.json` and the page into a folder.

    Finished episodes are logged in the folder: an assessment of the same road and files resumes there, or continues
    with other controllers, penetration rates and budgets. After each round of test seeds, the folder has the answer so
    far. Without `minutes`, the result does not depend on the number of workers. `progress` is called with an episode
    and its control steps so far, `on_stage` when a batch of episodes begins, and `on_message` with lines about results.
    Raise `InputError` if the folder has other contents, or no driver can drive on this road.
    """
    log = EpisodeLog(folder, request.network)
    if log.episodes:
        logged = f"{format_count(len(log.episodes), 'episode')} of earlier calls in {folder}"
        on_message(
            f"{logged}: not simulated again for the same controllers, except those of pictures; data that their code "
            "reads is not compared"
        )
    watch = watch_files([request.network])
    budget, baseline_rows = EpisodeBudget(request.episodes - 1, request.minutes, workers.count), OptionRows()
    new_episodes = set[tuple[Option, EpisodeSeed]]()

    def evaluate_options(options: Sequence[Option], seeds: Sequence[EpisodeSeed], **settings: Any) -> Evaluation:
        setups = {option.label: request.make_setup(option) for option in options}
        batch = budget.used_episodes

        def report_progress(episode: DriverAndEpisode, steps: int) -> None:
            if progress is not None:
                progress((batch, *episode), steps)

        return evaluate_on_roads(setups, seeds, workers, progress=report_progress, watch=watch, **settings)

    def run_options(kind: str, options: Sequence[Option], seeds: Sequence[EpisodeSeed]) -> dict[Option, OptionRows]:
        """Return the rows of all seeds, or only of the first seeds if the time is up."""
        hashes = {option: log.setup_hash(*request.make_setup(option)) for option in options}
        missing = [(option, seed) for option in options for seed in seeds if (hashes[option], seed) not in log.episodes]
        if missing:
            seed_numbers = {seed[-1] + 1 for _, seed in missing}
            first, last = min(seed_numbers), max(seed_numbers)
            seed_text = f"seeds {first} to {last}" if first < last else f"seed {first}"
            option_text = format_count(len({option for option, _ in missing}), "option")
            on_stage(f"simulating {kind} {seed_text} of {option_text}", request.network.horizon * len(missing))
        finished_seeds, hash_by_label = list[EpisodeSeed](), {option.label: hashes[option] for option in options}

        def log_row(seeds: Sequence[EpisodeSeed], episode: DriverAndEpisode, row: dict[str, Any]) -> None:
            label, index = episode
            log.add(hash_by_label[label], seeds[index], row)

        # With limited time, each batch has only some seeds, because all options need results on the same seeds.
        count = seeds_at_once(len(options), workers.count) if request.minutes else len(seeds)
        for batch in (seeds[first : first + count] for first in range(0, len(seeds), count)):
            to_run = {(option, seed) for option, seed in missing if seed in batch}
            if batch[0][-1] >= MIN_SEEDS[kind] and to_run and not budget.has_time_for(len(to_run)):
                break
            logged = {
                (option.label, index)
                for option in options
                for index, seed in enumerate(batch)
                if (option, seed) not in to_run
            }
            evaluate_options(options, batch, skipped=logged, on_row=partial(log_row, batch), with_plots=False)
            budget.spend(len(options) * len(batch), len(to_run))
            new_episodes.update(to_run)
            finished_seeds += batch
        rows = {option: [log.episodes[hashes[option], seed] for seed in finished_seeds] for option in options}
        human_rows = rows[HUMAN_BASELINE]
        baseline_rows.extend(human_rows)
        check_baseline(baseline_rows, MIN_BASELINE_EPISODES)
        # If a low penetration rate selects no vehicle for a seed, the traffic is the human baseline.
        return {
            option: [
                human if row["error"] == NoCavError.__name__ else row
                for row, human in zip(rows[option], human_rows, strict=True)
            ]
            for option in options
        }

    def run_plot_episode(stage: str, option: Option) -> Evaluation:
        on_stage(f"simulating {stage}", request.network.horizon)
        budget.spend(1)
        return evaluate_options([option], held_out_seeds(1))

    baseline = run_plot_episode("the human baseline, seed 1 of 1", HUMAN_BASELINE)
    raise_failure(baseline.rows[HUMAN_BASELINE.label])
    setup_hashes = {log.setup_hash(*request.make_setup(option)) for option in request.compared_options}
    stored_episodes = sum(setup_hash in setup_hashes for setup_hash, _ in log.episodes)
    for line in budget_lines(request, budget, stored_episodes):
        on_message(line)
    selection = select_controllers(request.options, partial(run_options, "tuning"), budget, on_message)
    selection_episodes = budget.used_episodes - 1

    def write_answer(findings: AssessmentFindings, plot_episodes: dict[str, Episode], is_complete: bool) -> Assessment:
        metadata = {"scenario": Path(request.file).name, "reward": request.network.reward, "manifest": manifest()}
        selection_rows = {option.label: rows for option, rows in selection.rows.items()}
        test_rows = {option.label: rows for option, rows in findings.rows.items()}
        check_baseline(baseline_rows, 0 if is_complete else MIN_BASELINE_EPISODES)
        all_rows = {label: [*selection_rows.get(label, ()), *rows] for label, rows in test_rows.items()}
        document = {
            **metadata,
            **_assessment_document(request, selection, findings, selection_episodes, budget),
            "is_complete": is_complete,
            "notes": [*episode_notes(all_rows), *request.network.notes, *sensing_notes(request)],
        }
        save_evaluation(folder / SELECTION_FOLDER, Evaluation(selection_rows, {}), metadata)
        save_evaluation(folder, Evaluation(test_rows, plot_episodes), metadata)
        seed_count = len(findings.rows[HUMAN_BASELINE])
        if archived_page := archive_assessment(folder, request.penetration_rates, document["drivers"], seed_count):
            on_message(f"the earlier answer is now in {archived_page}")
        atomic_write(folder / ASSESSMENT_FILE, to_json(document, indent=1))
        page = write_assessment(folder, folder / ASSESSMENT_PAGE)
        return Assessment(findings.controller_results, findings.acc_results, json.loads(to_json(document)), page)

    def write_interim_answer(findings: AssessmentFindings) -> None:
        assessed_seeds = count_assessed_seeds(folder, request.penetration_rates, _driver_recipes(request))
        if new_episodes and len(findings.rows[HUMAN_BASELINE]) > assessed_seeds:
            on_message(f"the answer so far is in {write_answer(findings, baseline.plot_episodes, False).page}")

    findings = compare_on_test_seeds(
        selection.finalists,
        request.penetration_rates,
        request.has_acc_properties,
        partial(run_options, "test"),
        budget,
        request.precision,
        on_message,
        write_interim_answer,
    )
    best = plotted_result(findings.controller_results)
    plotted = Option(best.penetration_rate, best.driver) if best else Option(request.penetration_rates[-1], ACC_DRIVER)
    plot_episodes = baseline.plot_episodes | run_plot_episode("the pictures", plotted).plot_episodes
    return write_answer(findings, plot_episodes, True)


def budget_lines(request: AssessmentRequest, budget: EpisodeBudget, stored_episodes: int = 0) -> list[str]:
    """Return lines about the duration of a verdict, the duration of the whole budget, and a smaller question."""

    def seconds(episodes: int) -> float:
        return budget.estimate_seconds(max(0, episodes - stored_episodes))

    def duration(episodes: int) -> str:
        stored = f", {min(stored_episodes, episodes):,} of them stored" if stored_episodes else ""
        return f"{format_count(episodes, 'episode')}{stored}, about {format_duration(seconds(episodes))}"

    for_verdict, limit = request.verdict_episodes, f" or {request.minutes:g} min" if request.minutes else ""
    lines = [f"a verdict needs at least {MIN_VERDICT_SEEDS} test seeds: {duration(for_verdict)}"]
    too_small = ", which is too small for a verdict" if request.episodes < for_verdict else ""
    lines.append(f"the budget is at most {duration(request.episodes)}{limit}{too_small}")
    for_answer = min_episodes(len(request.penetration_rates), len(request.drivers), request.has_acc_properties)
    if request.minutes and seconds(for_answer) > 60.0 * request.minutes:
        lines.append(
            f"an answer takes longer than {request.minutes:g} min: about {format_duration(seconds(for_answer))}, "
            "as each option is simulated at least once"
        )
    elif request.minutes and seconds(for_verdict) > 60.0 * request.minutes:
        lines.append(f"{request.minutes:g} min are too short for a verdict")
    small_request = request.smallest_request
    if len(request.options) > 1:
        (option,) = small_request.options
        question = f"--penetration-rates {option.penetration_rate:g} -d {shlex.quote(option.driver)}"
        episodes = small_request.verdict_episodes  # stored episodes of this question are not counted
        text = f"{format_count(episodes, 'episode')}, less those stored" if stored_episodes else duration(episodes)
        lines.append(f"a smaller question, {question}, needs at least {text}")
    return lines


def missing_budget(request: AssessmentRequest, findings: AssessmentFindings, budget: EpisodeBudget) -> dict[str, Any]:
    """Return the budget that would probably be enough for a verdict on all undecided controllers.

    It is for all penetration rates, but only for undecided controllers. With fewer seeds than a verdict needs, the
    estimate is rough: then the entries `min_*` are the smallest budget of any verdict.
    """
    undecided = [result for result in findings.controller_results if result.verdict == UNDECIDED]
    required_seeds = [result.difference_to_acc.count + result.missing_seeds for result in undecided]
    seeds = max([MIN_VERDICT_SEEDS, *map(ceil, filter(isfinite, required_seeds))])
    drivers = list(dict.fromkeys(result.driver for result in undecided))
    counts = len(request.penetration_rates), len(drivers), request.has_acc_properties
    is_rough = any(result.difference_to_acc.count < MIN_VERDICT_SEEDS for result in undecided)
    min_seeds = MIN_VERDICT_SEEDS if is_rough else seeds
    least, episodes = (verdict_episodes(*counts, n, len(undecided)) + PLOT_EPISODE_COUNT for n in (min_seeds, seeds))
    return {
        "test_seeds": seeds,
        "min_test_seeds": min_seeds,
        "episodes": episodes,
        "min_episodes": least,
        "seconds": budget.estimate_seconds(episodes),
        "min_seconds": budget.estimate_seconds(least),
        "drivers": drivers,
    }


def sensing_notes(request: AssessmentRequest) -> list[str]:
    """Return a note on the assumed roadside information if a controller uses it, else an empty list."""
    users = [
        name for name, driver in request.drivers.items() if FIELDS_AHEAD & set(driver.requirements().measured_fields)
    ]
    if not users:
        return []
    information = request.network.roadside.description
    settings = "roadside.latency, smoothing_time and loss_rate"
    return [f"{', '.join(users)}: assumed to know {information}; {settings} change it"]


def _driver_recipes(request: AssessmentRequest) -> dict[str, Any]:
    return {
        name: driver_recipe(driver)[0] if is_serializable(driver) else {"policy": driver.describe()}
        for name, driver in request.drivers.items()
    }


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
        needs = f"a verdict needs {seeds} test seeds ({episodes} episodes, {duration})"
        answer = answer._replace(sentence=f"{answer.sentence.removesuffix('.')}; {needs}.")
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
            {**asdict(result), "reasons": result.reasons, "verdict": result.verdict, "summary": result.summary}
            for result in findings.controller_results
        ],
        "acc_results": [
            {**asdict(result), "driver": ACC_DRIVER, "summary": result.summary} for result in findings.acc_results
        ],
        "candidates": candidates,
        "baseline": {name: asdict(metric_estimate(baseline_rows, name)) for name in BASELINE_METRICS},
        "road": {**scenario_recipe(request.network), "file": request.file},
        "human_drivers": request.network.human_description,
        "drivers": _driver_recipes(request),
        "penetration_rates": request.penetration_rates,
        "precision": request.precision,
        "budget": {"episodes": request.episodes, "minutes": request.minutes},
        "episodes": {"selection": selection_episodes, "total": budget.used_episodes},
        "seeds": {"selection": len(selection.rows[HUMAN_BASELINE]), "test": len(baseline_rows)},
    }
