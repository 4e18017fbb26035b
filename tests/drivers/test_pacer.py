from dataclasses import replace
from math import pi

import numpy as np
import pytest

from unjam.drivers import LocalState, Pacer
from unjam.drivers.road_experts import BROKEN_LAP_FRACTION, GATHERED_LAP_FRACTION, TUNED_PACES


def state(gap: float, lap_fraction: float = 0.0, loop: float = 450.0, speed: float = 0.0) -> LocalState:
    values = (speed, 0.0, gap, 0.0, 5.0, lap_fraction * loop, loop)
    return LocalState(*(np.array([value]) for value in values))


def commanded_speed(driver: Pacer, *states: LocalState) -> float:
    memory = driver.initial_memory(1)
    acceleration = np.zeros(1)
    for entry in states:
        acceleration, memory = driver.act(entry, memory)
    return float(acceleration[0] * driver.time_constant + states[-1].speed[0])


def pace_at(harmonics: tuple[float, ...], lap_fraction: float) -> float:
    mean, a1, b1, a2, b2 = harmonics
    x = 2 * pi * lap_fraction
    return mean + a1 * np.cos(x) + b1 * np.sin(x) + a2 * np.cos(2 * x) + b2 * np.sin(2 * x)


def test_drives_slowly_until_the_road_ahead_is_free() -> None:
    assert commanded_speed(Pacer(), state(gap=0.39 * 450)) == pytest.approx(2.0)


def test_then_drives_a_lap_in_its_time() -> None:
    assert commanded_speed(Pacer(lap_time=70), state(gap=0.41 * 450)) == pytest.approx(450 / 70)


def test_keeps_its_pace_once_all_have_gathered() -> None:
    assert commanded_speed(Pacer(lap_time=70), state(gap=200.0), state(gap=10.0)) == pytest.approx(450 / 70)


@pytest.mark.parametrize("lap_fraction", [0.0, 0.1, 0.25, 0.7])
def test_pace_varies_over_the_lap_as_its_harmonics_say(lap_fraction: float) -> None:
    harmonics = (7.0, -0.8, 0.7, -1.3, 0.2)
    found = commanded_speed(Pacer(harmonics=harmonics), state(gap=200.0, lap_fraction=lap_fraction))
    assert found == pytest.approx(pace_at(harmonics, lap_fraction))


@pytest.mark.parametrize(("gap", "faster"), [(270.0, 0.9), (225.0, 0.0), (180.0, -0.9)])
def test_drives_faster_where_more_of_the_lap_is_free(gap: float, faster: float) -> None:
    pacer = Pacer(lap_time=70, gap_gain=0.02, target_gap=0.5)
    assert commanded_speed(pacer, state(gap=gap)) == pytest.approx(450 / 70 + faster)


def test_never_stands_still_however_little_is_free() -> None:
    pacer = Pacer(lap_time=70, gap_gain=1.0, target_gap=0.9)
    assert commanded_speed(pacer, state(gap=200.0)) == pytest.approx(1.0)


def test_waits_anew_when_the_queue_is_broken() -> None:
    pacer = Pacer(lap_time=70, gathering_gap=0.5, regathering_gap=0.4)
    together, longer, broken = (state(gap=share * 450) for share in (0.55, 0.45, 0.35))
    assert commanded_speed(pacer, together, longer) == pytest.approx(450 / 70)
    assert commanded_speed(pacer, together, broken) == pytest.approx(2.0)
    assert commanded_speed(pacer, together, broken, longer) == pytest.approx(2.0)
    assert commanded_speed(pacer, together, broken, together) == pytest.approx(450 / 70)


def pacer_of(lap: float) -> Pacer:
    harmonics, gain, gap = TUNED_PACES[lap]
    ready, broken = GATHERED_LAP_FRACTION, BROKEN_LAP_FRACTION
    return Pacer(harmonics=harmonics, gap_gain=gain, target_gap=gap, gathering_gap=ready, regathering_gap=broken)


@pytest.mark.parametrize("lap", TUNED_PACES)
def test_varying_is_the_pacer_that_was_tuned_for_the_nearest_lap(lap: float) -> None:
    here = state(gap=0.52 * lap, lap_fraction=0.3, loop=lap + 2.0)
    assert commanded_speed(Pacer(use_tuned=True), here) == pytest.approx(commanded_speed(pacer_of(lap), here))


@pytest.mark.parametrize("share", [0.3, 0.47, 0.6])
def test_varying_pacer_has_no_use_for_the_parameters_that_its_description_names(share: float) -> None:
    states = [state(gap=each * 450, lap_fraction=0.4) for each in (0.7, share)]
    pace = Pacer(use_tuned=True, lap_time=90.0, harmonics=(5.0,), gap_gain=0.3, target_gap=0.2)
    other = replace(pace, gathering_gap=0.2, regathering_gap=0.55)
    assert commanded_speed(other, *states) == commanded_speed(Pacer(use_tuned=True), *states)


def test_varying_rows_are_each_led_at_the_pace_of_their_own_lap() -> None:
    laps = list(TUNED_PACES)
    one_by_one = [
        commanded_speed(Pacer(use_tuned=True), state(gap=0.55 * lap, lap_fraction=0.2, loop=lap)) for lap in laps
    ]
    first, *others = (state(gap=0.55 * lap, lap_fraction=0.2, loop=lap) for lap in laps)
    rows = first.map(lambda *columns: np.concatenate(columns), *others)
    pacer = Pacer(use_tuned=True)
    acceleration, memory = pacer.act(rows, pacer.initial_memory(len(laps)))
    assert acceleration * pacer.time_constant == pytest.approx(one_by_one)
    assert memory["has_gathered"].tolist() == [1.0] * len(laps)
