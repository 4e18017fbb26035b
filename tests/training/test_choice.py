"""Is the best driver of each share found, judged where nothing was chosen, and the budget kept?"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from tests.measures.test_effect import USUAL
from unjam.errors import InputError
from unjam.measures.effect import LEAST_JUDGED
from unjam.training.choice import (
    LEAST_CHOOSING,
    PEOPLE,
    Budget,
    Option,
    Rows,
    Seed,
    choose,
    judge,
    least_episodes,
)
from unjam.training.seeds import CHOOSE, JUDGE

ACC, PI = (Option(0.1, name) for name in ("acc", "pi"))
ACC_MORE, PI_MORE = (Option(0.2, name) for name in ("acc", "pi"))
OPTIONS = [ACC, PI, ACC_MORE, PI_MORE]
Change = Callable[[np.random.Generator], dict[str, Any]]


def quiet(line: str) -> None:
    pass


class MadeUp:
    """Traffic of no simulator: people take a random time on each seed, CAVs change it."""

    def __init__(self, changes: dict[Option, Change], episodes: int = 1000) -> None:
        self.changes, self.driven = changes, list[tuple[Option, Seed]]()
        self.budget = Budget(episodes)

    def __call__(self, options: Sequence[Option], seeds: Sequence[Seed]) -> dict[Option, Rows]:
        self.driven += [(option, seed) for option in options for seed in seeds]
        self.budget.spend(len(options) * len(seeds))
        return {option: [self._row(option, seed) for seed in seeds] for option in options}

    def _row(self, option: Option, seed: Seed) -> dict[str, Any]:
        people = {**USUAL, "seed": list(seed), "travel_time": 100 + np.random.default_rng(seed).normal()}
        generator = np.random.default_rng((*seed, OPTIONS.index(option) if option in OPTIONS else 9))
        change = self.changes.get(option, lambda generator: {})(generator)
        return {**people, **change, "travel_time": people["travel_time"] + change.get("travel_time", 0.0)}

    def seeds_of(self, option: Option) -> list[Seed]:
        return [seed for each, seed in self.driven if each == option]


def shifted(mean: float, spread: float = 0.3, **changes: Any) -> Change:
    return lambda generator: {"travel_time": generator.normal(mean, spread), **changes}


def test_the_best_of_each_share_is_chosen_and_what_harms_is_set_aside_early() -> None:
    drive = MadeUp({ACC: shifted(-2), PI: shifted(-4), ACC_MORE: shifted(3), PI_MORE: shifted(-1, 4.0)})
    found = choose(OPTIONS, drive, drive.budget, 0.001, quiet)
    assert found.finalists == [PI, PI_MORE]
    assert found.set_aside[ACC].startswith("slower than pi: travel time +")
    assert found.set_aside[ACC_MORE].startswith("travel time is longer than people's alone")
    assert len(drive.seeds_of(ACC)) == LEAST_CHOOSING
    assert {seed[0] for _, seed in drive.driven} == {CHOOSE}
    assert drive.seeds_of(PEOPLE) == [(CHOOSE, number) for number in range(len(found.rows[PEOPLE]))]


def test_less_flow_is_a_loss_however_quick() -> None:
    drive = MadeUp({ACC: shifted(-30, throughput_veh_per_h=1900.0), PI: shifted(-1)})
    found = choose([ACC, PI], drive, drive.budget, 0.01, quiet)
    assert found.finalists == [PI]
    assert found.set_aside[ACC].startswith("flow is lower than people's alone")


def test_who_could_be_driven_by_a_car_comes_before_who_is_quick() -> None:
    drive = MadeUp({ACC: shifted(-9, 20.0, min_headway=0.1), PI: shifted(0, 20.0)})
    assert choose([ACC, PI], drive, drive.budget, 0.001, quiet).finalists == [PI]


def test_choosing_ends_when_all_is_known_well_enough() -> None:
    drive = MadeUp({option: shifted(0.0, 1.0) for option in OPTIONS})
    choose(OPTIONS, drive, drive.budget, 0.02, quiet)
    assert len(drive.seeds_of(PEOPLE)) == LEAST_CHOOSING


@pytest.mark.parametrize("episodes", [least_episodes(2, 2), 200])
def test_choosing_leaves_half_of_the_budget_and_judging_does_not_exceed_it(episodes: int) -> None:
    drive = MadeUp({option: shifted(0.0, 40.0) for option in OPTIONS}, episodes)
    found = choose(OPTIONS, drive, drive.budget, 0.001, quiet)
    assert len(found.rows[PEOPLE]) >= LEAST_CHOOSING
    assert drive.budget.spent <= episodes / 2
    rows, _ = judge(found.finalists, drive, drive.budget, 0.001, quiet)
    assert drive.budget.spent == len(drive.driven) <= episodes
    assert len(rows[PEOPLE]) >= LEAST_JUDGED


def test_judging_is_on_fresh_seeds_and_ends_when_intervals_are_narrow() -> None:
    drive = MadeUp({ACC: shifted(-2.0, 0.5), PI_MORE: shifted(-3.0, 3.0)})
    rows, judged = judge([ACC, PI_MORE], drive, drive.budget, 0.01, quiet)
    assert {seed[0] for _, seed in drive.driven} == {JUDGE}
    assert [(each.share, each.driver) for each in judged] == [ACC, PI_MORE]
    assert all(each.effect.width <= 0.01 for each in judged)
    assert LEAST_JUDGED <= len(rows[PEOPLE]) < 100
    assert judged[0].reasons == []


def test_an_option_that_fails_is_set_aside_with_the_reason() -> None:
    failed = {"status": "failed", "reason": "no CAV was on the road", "error": "InputError"}
    drive = MadeUp({ACC: lambda generator: failed, PI: shifted(-1)})
    found = choose([ACC, PI], drive, drive.budget, 0.01, quiet)
    assert found.set_aside == {ACC: "failed: no CAV was on the road"}
    assert found.finalists == [PI]
    with pytest.raises(InputError, match="no CAV was on the road"):
        choose([ACC], drive, drive.budget, 0.01, quiet)


def test_where_all_harm_nobody_is_chosen() -> None:
    drive = MadeUp({ACC: shifted(5), PI: shifted(6)})
    lines: list[str] = []
    found = choose([ACC, PI], drive, drive.budget, 0.01, lines.append)
    assert found.finalists == []
    assert set(found.set_aside) == {ACC, PI}
    assert lines[-1] == "choosing, 6 seeds: 0 of 2 left, all are set aside"


def test_each_batch_is_told_in_a_line() -> None:
    lines: list[str] = []
    choose([ACC, PI], MadeUp({}), Budget(60), 0.02, lines.append)
    assert lines[:2] == [
        "choosing, 2 seeds: 2 of 2 left, too few for an interval of travel time (wanted: ±2 %)",
        "choosing, 4 seeds: 2 of 2 left, travel time known to ±0.0 % of people's (wanted: ±2 %)",
    ]


FAILED: dict[str, Any] = {"status": "failed", "reason": "lost", "error": "EpisodeError"}


@pytest.mark.parametrize("later", [FAILED, {"min_headway": 0.1}], ids=["failed", "no car could drive so"])
@pytest.mark.parametrize("ends", [False, True], ids=["goes on", "ends at once"])
def test_who_was_slower_comes_back_when_the_quicker_one_turns_out_worse(
    later: dict[str, Any], ends: bool
) -> None:
    def turning(mean: float, spread: float, otherwise: dict[str, Any]) -> Change:
        """Drives so, but otherwise on the first seed after some may be set aside."""
        driven = list[int]()

        def change(generator: np.random.Generator) -> dict[str, Any]:
            driven.append(1)
            return shifted(mean, spread, **(otherwise if len(driven) == LEAST_CHOOSING + 1 else {}))(
                generator
            )

        return change

    others = {ACC_MORE: turning(0.0, 20.0, FAILED if ends else {}), PI_MORE: shifted(0.0, 9.0)}
    drive = MadeUp({ACC: shifted(-2.0), PI: turning(-9.0, 3.0, later), **others})
    found = choose(OPTIONS, drive, drive.budget, 0.001, quiet)
    assert len(drive.seeds_of(ACC)) < len(drive.seeds_of(PEOPLE))  # for a while it was out
    assert ACC in found.finalists
    assert ACC not in found.set_aside
