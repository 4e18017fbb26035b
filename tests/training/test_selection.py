"""The best controller of each penetration rate is selected, tested on other seeds, and the budget is kept."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from tests.measures.test_effect import USUAL
from unjam.errors import InputError
from unjam.measures.recommendation import MIN_VERDICT_SEEDS, NOT_RECOMMENDED, RECOMMENDED, UNDECIDED
from unjam.seeds import SELECTION_SEED, TEST_SEED
from unjam.training.selection import (
    ACC_DRIVER,
    HUMAN_BASELINE,
    MAX_SELECTION_SEEDS,
    MIN_TEST_SEEDS,
    SELECTION_BUDGET_FRACTION,
    UNCHANGED_ACC_DRIVER,
    AssessmentFindings,
    EpisodeBudget,
    EpisodeSeed,
    Option,
    OptionRows,
    compare_on_test_seeds,
    min_episodes,
    seeds_at_once,
    select_controllers,
    verdict_episodes,
)

SHARES = (0.1, 0.2)
IDM, PI = (Option(0.1, name) for name in ("idm", "pi"))
IDM_MORE, PI_MORE = (Option(0.2, name) for name in ("idm", "pi"))
OPTIONS = [IDM, PI, IDM_MORE, PI_MORE]
BASELINE = Option(0.1, ACC_DRIVER)
Change = Callable[[np.random.Generator], dict[str, Any]]


def quiet(line: str) -> None:
    pass


class MadeUp:
    """Traffic without a simulator: human drivers take a random time on each seed, and CAVs change it."""

    def __init__(self, changes: dict[Option, Change], episodes: int = 1000, **budget: Any) -> None:
        self.changes, self.driven = changes, list[tuple[Option, EpisodeSeed]]()
        self.budget = EpisodeBudget(episodes, **budget)

    def __call__(self, options: Sequence[Option], seeds: Sequence[EpisodeSeed]) -> dict[Option, OptionRows]:
        self.driven += [(option, seed) for option in options for seed in seeds]
        self.budget.spend(len(options) * len(seeds))
        return {option: [self._row(option, seed) for seed in seeds] for option in options}

    def _row(self, option: Option, seed: EpisodeSeed) -> dict[str, Any]:
        human_row = {**USUAL, "seed": list(seed), "travel_time": 100 + np.random.default_rng(seed).normal()}
        generator = np.random.default_rng((*seed, OPTIONS.index(option) if option in OPTIONS else 9))
        change = self.changes.get(option, lambda generator: {})(generator)
        return {**human_row, **change, "travel_time": human_row["travel_time"] + change.get("travel_time", 0.0)}

    def seeds_of(self, option: Option) -> list[EpisodeSeed]:
        return [seed for each, seed in self.driven if each == option]


def shift_travel_time(mean: float, spread: float = 0.3, **changes: Any) -> Change:
    return lambda generator: {"travel_time": generator.normal(mean, spread), **changes}


def run_judge(
    drive: MadeUp, finalists: Sequence[Option], precision: float = 0.01, split: bool = False
) -> AssessmentFindings:
    shares = tuple(dict.fromkeys(option.penetration_rate for option in finalists)) or (0.1,)
    return compare_on_test_seeds(finalists, shares, split, drive, drive.budget, precision, quiet)


def test_best_controller_of_each_penetration_rate_is_selected() -> None:
    drive = MadeUp(
        {
            IDM: shift_travel_time(-2),
            PI: shift_travel_time(-4),
            IDM_MORE: shift_travel_time(-3),
            PI_MORE: shift_travel_time(-1),
        }
    )
    found = select_controllers(OPTIONS, drive, drive.budget, quiet)
    assert found.finalists == [PI, IDM_MORE]
    assert found.rejection_reasons[IDM].startswith("behind pi (10 tuning seeds")
    assert {seed[0] for _, seed in drive.driven} == {SELECTION_SEED}
    assert drive.seeds_of(HUMAN_BASELINE) == [
        (SELECTION_SEED, number) for number in range(len(found.rows[HUMAN_BASELINE]))
    ]


def test_half_of_the_controllers_are_rejected_in_each_round() -> None:
    many = [Option(0.1, name) for name in ("a", "b", "c", "d", "e")]
    drive = MadeUp({option: shift_travel_time(-number) for number, option in enumerate(many)})
    found = select_controllers(many, drive, drive.budget, quiet)
    assert found.finalists == [many[-1]]
    counts = [len(drive.seeds_of(option)) for option in (*many, HUMAN_BASELINE)]
    assert counts == [MAX_SELECTION_SEEDS * rounds for rounds in (1, 1, 2, 3, 3, 3)]


def test_single_controller_needs_no_selection_seeds() -> None:
    drive = MadeUp({})
    assert select_controllers([PI, IDM_MORE], drive, drive.budget, quiet).finalists == [PI, IDM_MORE]
    assert not drive.driven


def test_lower_flow_is_rejected_despite_shorter_travel_time() -> None:
    drive = MadeUp({IDM: shift_travel_time(-30, outflow_veh_per_h=1900.0), PI: shift_travel_time(-1)})
    found = select_controllers([IDM, PI], drive, drive.budget, quiet)
    assert found.finalists == [PI]
    assert found.rejection_reasons[IDM].startswith("flow is lower than that of the human baseline")


def test_feasible_controllers_rank_before_quick_ones() -> None:
    drive = MadeUp({IDM: shift_travel_time(-9, 20.0, min_time_gap=0.1), PI: shift_travel_time(0, 20.0)})
    assert select_controllers([IDM, PI], drive, drive.budget, quiet).finalists == [PI]


def test_failed_option_is_rejected_with_the_reason() -> None:
    failed = {"status": "failed", "reason": "no CAV was on the road", "error": "InputError"}
    drive = MadeUp({IDM: lambda generator: failed, PI: shift_travel_time(-1)})
    found = select_controllers([IDM, PI], drive, drive.budget, quiet)
    assert found.rejection_reasons == {IDM: "failed: no CAV was on the road"}
    assert found.finalists == [PI]
    drive.changes[PI] = lambda generator: failed
    with pytest.raises(InputError, match="no CAV was on the road"):
        select_controllers([IDM, PI], drive, drive.budget, quiet)


@pytest.mark.parametrize("drivers", [2, 5])
@pytest.mark.parametrize("more", [0, 20, 200])
def test_budget_is_never_exceeded(drivers: int, more: int) -> None:
    episodes = min_episodes(2, drivers) + more
    options = [Option(share, f"driver {number}") for share in SHARES for number in range(drivers)]
    drive = MadeUp({option: shift_travel_time(0.0, 40.0) for option in options}, episodes)
    found = select_controllers(options, drive, drive.budget, quiet)
    assert [option.penetration_rate for option in found.finalists] == [*SHARES]
    assert drive.budget.used_episodes <= max(SELECTION_BUDGET_FRACTION * episodes, 1 + len(options))
    rows = run_judge(drive, found.finalists, 0.001).rows
    assert drive.budget.used_episodes == len(drive.driven) <= episodes
    assert len(rows[HUMAN_BASELINE]) >= MIN_TEST_SEEDS


def test_human_baseline_runs_once_per_seed() -> None:
    drive = MadeUp({PI: shift_travel_time(-2.0), IDM_MORE: shift_travel_time(-3.0)})
    found = run_judge(drive, [PI, IDM_MORE])
    assert {seed[0] for _, seed in drive.driven} == {TEST_SEED}
    assert drive.seeds_of(HUMAN_BASELINE) == [(TEST_SEED, number) for number in range(len(found.rows[HUMAN_BASELINE]))]
    assert [(each.penetration_rate, each.driver) for each in found.controller_results] == [PI, IDM_MORE]
    assert [each.penetration_rate for each in found.acc_results] == [0.1, 0.2]


def test_gain_over_acc_vehicles_runs_until_its_interval_is_narrow() -> None:
    drive = MadeUp({PI: shift_travel_time(-6.0, 6.0), BASELINE: shift_travel_time(-2.0, 0.1)}, 4000)
    (judged,) = run_judge(drive, [PI]).controller_results
    assert judged.reasons == []
    assert judged.effect.relative_half_width <= 0.01
    assert MIN_VERDICT_SEEDS < judged.difference_to_acc.count < 1000
    assert judged.difference_to_acc.mean == pytest.approx(-4.0, abs=1.0)


def test_gain_equal_to_acc_vehicles_is_not_recommended() -> None:
    drive = MadeUp({PI: shift_travel_time(-5.0, 0.01), BASELINE: shift_travel_time(-5.5, 0.01)})
    found = run_judge(drive, [PI])
    (judged,), (acc,) = found.controller_results, found.acc_results
    assert acc.effect.travel_time.high < 0
    assert [reason.startswith("travel time is longer than with ACC") for reason in judged.reasons] == [True]


@pytest.mark.parametrize(
    "change",
    [
        shift_travel_time(5.0),
        shift_travel_time(-9.0, outflow_veh_per_h=1900.0),
        shift_travel_time(-9.0, min_time_gap=0.1),
        shift_travel_time(-0.01, 30.0),
        lambda generator: {"status": "failed", "reason": "lost", "error": "EpisodeError"},
    ],
    ids=["slower", "less flow", "infeasible", "out of reach", "failed"],
)
def test_hopeless_controller_ends_early(change: Change) -> None:
    drive = MadeUp(
        {PI: change, IDM_MORE: shift_travel_time(-6.0, 6.0), Option(0.2, ACC_DRIVER): shift_travel_time(0.0, 0.1)}, 800
    )
    found = run_judge(drive, [PI, IDM_MORE])
    hopeless, good = found.controller_results
    assert hopeless.reasons
    assert good.reasons == []
    assert len(drive.seeds_of(PI)) <= 2 * MIN_VERDICT_SEEDS < len(drive.seeds_of(IDM_MORE))
    assert len(drive.seeds_of(BASELINE)) <= 2 * MIN_VERDICT_SEEDS


def test_small_budget_reports_the_missing_seeds() -> None:
    drive = MadeUp({PI: shift_travel_time(-1.0, 9.0)}, 12)
    (judged,) = run_judge(drive, [PI], 0.001).controller_results
    assert judged.difference_to_acc.count == 4
    assert judged.missing_seeds > 0
    assert judged.verdict == UNDECIDED


def test_infeasible_and_failed_controllers_end_after_the_first_round() -> None:
    changes: list[dict[str, Any]] = [
        {"min_time_gap": 0.1},
        {"status": "failed", "reason": "lost", "error": "EpisodeError"},
    ]
    for change in changes:
        drive = MadeUp({PI: shift_travel_time(-9.0, **change), IDM_MORE: shift_travel_time(-9.0)})
        first, second = run_judge(drive, [PI, IDM_MORE]).controller_results
        assert first.verdict == NOT_RECOMMENDED
        assert len(drive.seeds_of(PI)) == MIN_TEST_SEEDS
        assert second.verdict == RECOMMENDED
        assert len(drive.seeds_of(BASELINE)) >= MIN_VERDICT_SEEDS  # findings on ACC vehicles need ten test seeds


@pytest.mark.parametrize("drivers", [1, 3])
@pytest.mark.parametrize("seeds", [MIN_VERDICT_SEEDS, 25])
def test_estimated_budget_is_enough_for_its_test_seeds(drivers: int, seeds: int) -> None:
    options = [Option(share, f"driver {number}") for share in SHARES for number in range(drivers)]
    episodes = verdict_episodes(len(SHARES), drivers, False, seeds, len(SHARES))
    drive = MadeUp({option: shift_travel_time(-1.0, 90.0) for option in options}, episodes)
    found = select_controllers(options, drive, drive.budget, quiet)
    affordable = drive.budget.affordable_seeds(1 + 2 * len(SHARES))
    assert affordable >= seeds
    assert len(found.finalists) == len(SHARES)


def test_acc_vehicles_are_tested_without_controllers() -> None:
    found = run_judge(MadeUp({BASELINE: shift_travel_time(-3.0)}), [])
    assert (found.controller_results, len(found.acc_results)) == ([], 1)
    assert found.acc_results[0].effect.travel_time.high < 0
    assert found.acc_results[0].property_effect is None


def test_property_effect_is_reported_separately() -> None:
    unchanged = Option(0.1, UNCHANGED_ACC_DRIVER)
    drive = MadeUp({BASELINE: shift_travel_time(-5.0), unchanged: shift_travel_time(-1.0)})
    (acc,) = run_judge(drive, [PI], split=True).acc_results
    assert acc.property_effect is not None
    assert acc.property_effect.mean == pytest.approx(-4.0, abs=0.5)


def test_affordable_seeds_follow_from_the_elapsed_time() -> None:
    now = [0.0]
    budget = EpisodeBudget(1000, minutes=1.0, workers=4, clock=lambda: now[0])
    assert budget.affordable_seeds(10) == 100
    now[0] = 5.0
    budget.spend(1)  # alone: it took as long as four at once would
    assert budget.affordable_seeds(4) == 11
    assert budget.affordable_seeds(4, fraction=0.5) == 5
    assert budget.estimate_seconds(8) == 10.0
    now[0] = 59.0
    assert budget.affordable_seeds(4) == 0


def test_each_round_has_a_line_with_the_remaining_time() -> None:
    lines: list[str] = []
    now = [0.0]
    budget = EpisodeBudget(40, clock=lambda: now[0])
    drive = MadeUp({PI: shift_travel_time(-1.0, 9.0)})

    def timed(options: Sequence[Option], seeds: Sequence[EpisodeSeed]) -> dict[Option, OptionRows]:
        found = drive(options, seeds)
        budget.spend(len(options) * len(seeds))
        now[0] += 10.0 * len(options) * len(seeds)
        return found

    select_controllers([IDM, PI], timed, budget, lines.append)
    compare_on_test_seeds([PI], (0.1,), False, timed, budget, 0.001, lines.append)
    assert lines[0] == "5 tuning seeds: 1 of 2 options remain; at most 4 min more"
    assert lines[1].startswith("3 test seeds: CI of travel time at most ±")
    assert "; 2 options remain, at most " in lines[1]


@pytest.mark.parametrize(("option_count", "workers", "seeds"), [(3, 1, 1), (3, 2, 1), (3, 6, 2), (4, 15, 3)])
def test_with_a_limit_of_time_as_many_seeds_run_at_once_as_workers_have_options_for(
    option_count: int, workers: int, seeds: int
) -> None:
    assert seeds_at_once(option_count, workers) == seeds
