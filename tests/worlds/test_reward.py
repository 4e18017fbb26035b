import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from unjam.errors import InputError
from unjam.worlds.reward import (
    CRASH_CLOSURE_STEPS,
    MIN_CRASH_BACKLOG,
    REWARD_TERMS,
    REWARDS,
    Outcome,
    make_reward,
    released_reward,
    step_reward_terms,
    time_gap,
    validate_reward_terms,
)


@st.composite
def outcomes(draw: st.DrawFn) -> Outcome:
    """Outcomes of some control steps; some or all vehicles and CAVs may be absent."""
    rows, vehicles = draw(st.integers(1, 5)), draw(st.integers(1, 6))
    cavs = draw(st.integers(1, vehicles))
    speeds = draw(hnp.arrays(np.float64, (rows, vehicles), elements=st.floats(0, 70)))
    speeds[draw(hnp.arrays(np.bool_, (rows, vehicles)))] = np.nan
    accelerations = draw(hnp.arrays(np.float64, (rows, cavs), elements=st.floats(-3, 3)))
    headways = draw(hnp.arrays(np.float64, (rows, cavs), elements=st.floats(-1, 1e5)))
    away = draw(hnp.arrays(np.bool_, (rows, cavs)))
    own_speeds = draw(hnp.arrays(np.float64, (rows, cavs), elements=st.floats(0, 70)))
    accelerations[away] = headways[away] = own_speeds[away] = np.nan
    waiting = draw(hnp.arrays(np.float64, rows, elements=st.integers(0, 50).map(float)))
    return Outcome(speeds, accelerations, headways, draw(hnp.arrays(np.bool_, rows)), waiting, own_speeds)


def there(values: np.ndarray) -> list[float]:
    """Those of a row that are on the road."""
    return [value for value in values.tolist() if not math.isnan(value)]


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else 0.0


def one(speeds: list[float], accelerations: list[float], crashed: bool = False) -> Outcome:
    headways = np.full((1, len(accelerations)), 10.0)
    own_speeds = np.full(headways.shape, 5.0)
    numbers = np.array([speeds]), np.array([accelerations]), headways, np.array([crashed]), np.zeros(1)
    return Outcome(*numbers, own_speeds)


def total(terms: dict[str, Any]) -> Any:
    return sum(terms.values())


@pytest.mark.parametrize(
    ("speeds", "accelerations", "expected"),
    [
        ([0.0, 1.0], [0.0], 0.1),
        ([1.0, 1.0], [1.0], -3.8),
        ([1.0, 1.0], [-1.0], -3.8),
        ([5.0, 15.0, np.nan], [0.5, 0.0], 1.0),
    ],
)
def test_released_equals_the_authors_code(speeds: list[float], accelerations: list[float], expected: float) -> None:
    assert total(released_reward(one(speeds, accelerations)))[0] == pytest.approx(expected, abs=1e-12)


def test_released_is_zero_at_a_crash() -> None:
    terms = released_reward(one([3.0, 4.0], [0.7], crashed=True))
    assert {name: values.tolist() for name, values in terms.items()} == {"speed": [0.0], "acceleration": [0.0]}


@given(outcomes())
def test_released_is_four_times_mean_speed_over_twenty_minus_four_times_mean_acceleration(outcome: Outcome) -> None:
    found = total(released_reward(outcome))
    for row, crashed in enumerate(outcome.has_crashed):
        effort = [abs(push) for push in there(outcome.accelerations[row])]
        expected = 4.0 * mean(there(outcome.speeds[row])) / 20.0 - 4.0 * mean(effort)
        assert found[row] == pytest.approx(0.0 if crashed else expected, abs=1e-9)


@given(outcomes())
def test_released_merge_is_one_minus_speed_errors_and_short_time_gaps(outcome: Outcome) -> None:
    for numbers in (outcome, Outcome(*(torch.from_numpy(values) for values in outcome))):
        terms = REWARDS["released-merge"](numbers)
        assert set(terms) == {"speed", "time_gap", "lower_bound"}
        for row, crashed in enumerate(outcome.has_crashed):
            speeds = there(outcome.speeds[row])
            missed = math.hypot(*(20.0 - speed for speed in speeds))
            wanted = math.hypot(*(20.0 for _ in speeds))
            lacking = sum(min(time - 1.0, 0.0) for time in there(outcome.time_gaps[row]))
            expected = max(1.0 - missed / wanted + 0.1 * lacking, 0.0) if speeds and not crashed else 0.0
            assert float(total(terms)[row]) == pytest.approx(expected, abs=1e-9)
            assert float(terms["time_gap"][row]) == pytest.approx(0.0 if crashed else 0.1 * lacking, abs=1e-9)


@pytest.mark.parametrize(
    ("speeds", "headways", "crashed", "expected"),
    [
        ([20.0, 20.0], [5.0], False, 1.0),
        ([10.0, 10.0], [5.0], False, 0.5),
        ([20.0, np.nan], [0.5], False, 0.95),
        ([60.0, 60.0], [5.0], False, 0.0),
        ([0.0, 0.0], [0.1], False, 0.0),
        ([20.0, 20.0], [5.0], True, 0.0),
        ([np.nan, np.nan], [np.nan], False, 0.0),
    ],
)
def test_released_merge_by_hand(speeds: list[float], headways: list[float], crashed: bool, expected: float) -> None:
    numbers = np.array([speeds]), np.zeros((1, 1)), np.array([headways]), np.array([crashed]), np.zeros(1)
    outcome = Outcome(*numbers, cav_speeds=None)
    assert total(REWARDS["released-merge"](outcome))[0] == pytest.approx(expected)


@given(outcomes(), st.sampled_from(["eq16", "eq16-as-printed"]))
def test_equation_16_term_by_term(outcome: Outcome, name: str) -> None:
    terms = REWARDS[name](outcome)
    for row in range(len(outcome.has_crashed)):
        average = mean(there(outcome.speeds[row]))
        speed = max(30.0 - abs(30.0 - average), 0.0) if name == "eq16" else max(30.0 - average, 0.0)
        headway = -0.1 * sum(max(1.0 - time, 0.0) for time in there(outcome.time_gaps[row]))
        acceleration = -0.1 * sum(abs(push) for push in there(outcome.accelerations[row]))
        expected = {"speed": speed, "time_gap": headway, "acceleration": acceleration}
        assert {key: values[row] for key, values in terms.items()} == pytest.approx(expected, abs=1e-9)


def test_equation_16_rewards_speed_and_as_printed_standing() -> None:
    slow, fast = one([1.0, 2.0], [0.0]), one([10.0, 20.0], [0.0])
    assert total(REWARDS["eq16"](fast)) > total(REWARDS["eq16"](slow))
    assert total(REWARDS["eq16-as-printed"](fast)) < total(REWARDS["eq16-as-printed"](slow))


@given(outcomes(), st.sampled_from(sorted(REWARDS)))
def test_vehicles_that_are_not_on_the_road_are_left_out(outcome: Outcome, name: str) -> None:
    found = REWARDS[name](outcome)
    for row in range(len(outcome.has_crashed)):
        alone = Outcome(*(values[row : row + 1] for values in outcome))
        on_road = ~np.isnan(alone.accelerations[0])
        present = alone._replace(
            speeds=alone.speeds[:, ~np.isnan(alone.speeds[0])],
            accelerations=alone.accelerations[:, on_road],
            time_gaps=alone.time_gaps[:, on_road],
            cav_speeds=alone.cav_speeds[:, on_road],
        )
        for term, values in REWARDS[name](present).items():
            assert values[0] == pytest.approx(found[term][row], abs=1e-12)


@given(outcomes(), st.sampled_from(sorted(REWARDS)))
def test_tensors_have_the_rewards_of_arrays(outcome: Outcome, name: str) -> None:
    expected = REWARDS[name](outcome)
    found = REWARDS[name](Outcome(*(torch.from_numpy(values) for values in outcome)))
    assert found.keys() == expected.keys()
    for term, values in found.items():
        assert isinstance(values, torch.Tensor)
        np.testing.assert_allclose(values.numpy(), expected[term], rtol=0, atol=1e-9)


@given(outcomes())
def test_travel_time_counts_vehicles_on_the_road_and_in_the_backlog(outcome: Outcome) -> None:
    found = REWARDS["travel-time"](outcome)["travel_time"]
    for row, waiting in enumerate(outcome.backlog.tolist()):
        count = len(there(outcome.speeds[row])) + waiting
        closed = CRASH_CLOSURE_STEPS * max(count, MIN_CRASH_BACKLOG) if outcome.has_crashed[row] else 0
        assert found[row] == pytest.approx(-(count + closed) / 100.0)


def test_an_earlier_crash_decreases_the_return() -> None:
    coming = np.minimum(np.arange(2400), 150)  # one a decision enters, up to a jam of 150
    without = -coming.sum() / 100.0
    crashed = [
        -coming[: end + 1].sum() / 100.0 - CRASH_CLOSURE_STEPS * max(int(coming[end]), MIN_CRASH_BACKLOG) / 100.0
        for end in (10, 60, 90, 600, 2399)
    ]
    assert max(crashed) < without


@given(outcomes())
def test_power_is_flow_times_mean_speed_in_units_of_thirty_vehicles_at_twenty(outcome: Outcome) -> None:
    for numbers in (outcome, Outcome(*(torch.from_numpy(values) for values in outcome))):
        terms = REWARDS["power"](numbers)
        for row, crashed in enumerate(outcome.has_crashed):
            speeds = there(outcome.speeds[row])
            expected = 0.0 if crashed else sum(speeds) / 600.0 * mean(speeds) / 20.0
            assert float(total(terms)[row]) == pytest.approx(expected, abs=1e-9)


def test_power_prefers_free_flow_to_a_jam_of_the_same_flow_and_to_an_empty_road() -> None:
    free, jammed, empty = (
        float(total(REWARDS["power"](one(speeds, [0.0])))[0]) for speeds in ([20.0] * 30, [10.0] * 60, [20.0] * 3)
    )
    assert free == pytest.approx(1.0)
    assert jammed == pytest.approx(0.5)
    assert empty == pytest.approx(0.1)


def test_a_time_gap_is_gap_over_speed_and_very_long_for_a_standing_vehicle() -> None:
    gaps, speeds = np.array([10.0, 10.0, 3.0, 0.0]), np.array([5.0, 0.0, 1e-12, 2.0])
    np.testing.assert_allclose(time_gap(gaps, speeds), [2.0, 1e4, 3e3, 0.0])
    found = time_gap(torch.from_numpy(gaps), torch.from_numpy(speeds))
    np.testing.assert_allclose(found.numpy(), [2.0, 1e4, 3e3, 0.0])


def test_rewards_are_found_by_name() -> None:
    names = "released", "released-merge", "eq16", "eq16-as-printed", "power", "travel-time", "fuel"
    assert set(REWARDS) == set(names)
    assert make_reward("released") is released_reward


def test_a_users_reward_is_loaded_from_a_file(my_drivers: Path) -> None:
    outcome = Outcome(
        np.array([[1.0, 3.0, np.nan], [2.0, 2.0, 5.0]]),
        np.array([[1.0, -1.0], [0.5, 0.0]]),
        np.full((2, 2), 9.0),
        np.array([False, False]),
        np.zeros(2),
        np.ones((2, 2)),
    )
    terms = make_reward(f"{my_drivers}:calm")(outcome)
    assert {name: values.tolist() for name, values in terms.items()} == {"speed": [2.0, 3.0], "push": [-2.0, -0.5]}


def test_a_reward_that_is_one_array_is_one_term(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def plain(outcome):\n    return outcome.speeds.mean(-1)\n")
    terms = make_reward(f"{file}:plain")(one([2.0, 4.0], [0.0]))
    assert {name: values.tolist() for name, values in terms.items()} == {"reward": [3.0]}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("not_callable", "mine.py:not_callable: is not a function of an Outcome"),
        ("Keeper", "mine.py:Keeper: is not a function of an Outcome"),
        ("nonesuch", "mine.py: has no 'nonesuch'; it has: .*calm"),
    ],
)
def test_objects_that_are_not_rewards_are_refused(name: str, words: str, my_drivers: Path) -> None:
    with pytest.raises(InputError, match=words):
        make_reward(f"{my_drivers}:{name}")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.py' is not a file"):
        make_reward(f"{tmp_path}/none.py:calm")


def test_an_error_in_a_users_reward_is_reported_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def lost(outcome):\n    raise KeyError('map')\n")
    with pytest.raises(InputError, match=r"mine\.py:lost: KeyError: 'map' \(line 2\)"):
        make_reward(f"{file}:lost")(one([1.0], [0.0]))


@pytest.mark.parametrize("name", ["fame", "", "Released", "released "])
def test_an_unknown_reward_lists_the_known_ones(name: str) -> None:
    known = "released, released-merge, eq16, eq16-as-printed, power, travel-time, fuel, path.py:name"
    with pytest.raises(InputError, match=f"reward: {name!r} is not allowed; allowed: {known}"):
        make_reward(name)


def fuel_return(acceleration: float = 0.0, time_gap: float = 2.0, speed: float = 20.0) -> float:
    """Return the fuel reward of one step of one CAV."""
    numbers = np.zeros((1, 2)), np.array([[acceleration]]), np.array([[time_gap]]), np.zeros(1, bool), np.zeros(1)
    return float(total(REWARDS["fuel"](Outcome(*numbers, np.array([[speed]]))))[0])


def test_fuel_is_lost_by_braking_and_not_by_accelerating() -> None:
    assert fuel_return() == pytest.approx(0.0, abs=0.15)
    assert fuel_return(0.5) == pytest.approx(fuel_return())  # it becomes speed
    assert fuel_return(-0.2) == pytest.approx(fuel_return())  # coasting gives it back
    assert fuel_return(-1.0) < fuel_return() - 0.5
    assert fuel_return(-2.0) - fuel_return(-1.0) == pytest.approx(fuel_return(-3.0) - fuel_return(-2.0))


@pytest.mark.parametrize("speed", [0.0, 2.0, 10.0, 30.0])
def test_gaps_cost_beyond_90_m_and_5_s(speed: float) -> None:
    limit = max(90.0, 5.0 * speed)
    near, calm, late = (fuel_return(time_gap=gap / max(speed, 1e-3), speed=speed) for gap in (2.0, limit, limit + 20.0))
    assert late == pytest.approx(calm - 0.2)
    assert near == pytest.approx(calm - 0.1 * max(0.0, 1.0 - 2.0 / max(speed, 1e-3)))


@given(outcome=outcomes())
@pytest.mark.parametrize("name", [*REWARDS, *(f"eq16:{term}=0.5" for term in REWARD_TERMS)])
def test_a_single_step_has_the_terms_of_a_row(outcome: Outcome, name: str) -> None:
    reward, last = make_reward(name), len(outcome.speeds) - 1
    one, row = (Outcome(*(values[part] for values in outcome)) for part in (last, slice(last, None)))
    one = one._replace(has_crashed=bool(one.has_crashed), backlog=float(one.backlog))
    if len(one.accelerations) == 1:  # as of a world with a single CAV
        one = one._replace(
            **{each: float(getattr(one, each)[0]) for each in ("accelerations", "time_gaps", "cav_speeds")}
        )
    expected = {term: values.item() for term, values in validate_reward_terms(reward, row).items()}
    assert step_reward_terms(reward, one, 3, needs_rows=False) == expected
    assert step_reward_terms(reward, one, 0, needs_rows=True) == expected


def test_a_term_of_a_single_step_that_is_not_finite_is_refused() -> None:
    step = Outcome(np.array([1.0]), 0.0, 1.0, False, 0.0, 1.0)
    with pytest.raises(InputError, match="step 4: term 'bad' is nan; allowed: finite"):
        step_reward_terms(lambda outcome: {"bad": outcome.backlog * np.nan}, step, 4, needs_rows=False)
