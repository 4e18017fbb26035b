"""The safety filter keeps what docs/safety.md proves, for arbitrary leaders and drivers."""

from math import inf
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from unjam.drivers.safety import Actuator, ActuatorState, FollowingState, SafetyFilter
from unjam.drivers.sensors import SensorReadings, Sensors
from unjam.errors import InputError
from unjam.parameters import build_dataclass
from unjam.physics.kinematics import max_speed_to_stop, next_speed, stopping_distance

STEPS = st.sampled_from([0.05, 0.1, 0.2, 0.5])
SPEEDS = st.floats(0.0, 40.0)
GAPS = st.floats(0.5, 200.0)
FILTERS = [
    SafetyFilter(),
    SafetyFilter(time_gap=0.0),
    SafetyFilter(time_gap=1.6, time_gap_braking=3.0, standstill_gap=2.0),
    SafetyFilter(braking=4.5, leader_braking=8.0),
]
ACTUATORS = [None, Actuator(lag=0.3), Actuator(delay=0.2), Actuator(delay=0.3, lag=0.5)]


def stopping_by_steps(speed: float, braking: float, step: float) -> float:
    distance = 0.0
    while (speed := next_speed(speed, -braking, step)) > 0.0:
        distance += speed * step
    return distance


@given(SPEEDS, st.floats(1.0, 9.0), STEPS)
def test_a_stopping_distance_is_what_single_steps_add_up_to(speed: float, braking: float, step: float) -> None:
    assert stopping_distance(speed, braking, step) == pytest.approx(stopping_by_steps(speed, braking, step), abs=1e-9)


@given(st.floats(0.0, 300.0), st.floats(1.0, 9.0), STEPS)
def test_the_speed_to_stop_within_uses_the_distance_up(distance: float, braking: float, step: float) -> None:
    speed = max_speed_to_stop(distance, braking, step)
    assert speed * step + stopping_distance(speed, braking, step) == pytest.approx(distance, abs=1e-9)


class Pursuit:
    """Rows of cars that their filters alone keep behind leaders, in the simulator's own steps."""

    def __init__(
        self,
        safety: SafetyFilter,
        actuator: Actuator | None,
        step: float,
        rows: int,
        seed: int,
        sensors: Sensors | None = None,
    ) -> None:
        generator = np.random.default_rng(seed)
        self.readings = SensorReadings(sensors or Sensors(), safety.leader_braking, step, np.random.SeedSequence(seed))
        self.safety, self.actuator, self.step, self.generator = safety, actuator, step, generator
        ahead = FollowingState(*generator.uniform(0.0, [[35.0], [35.0], [150.0]], (3, rows)))
        start = ActuatorState(np.zeros(rows)) if actuator is None else actuator.initial_state(ahead.speed, step)
        actuation = None if actuator is None else (actuator, start)
        free = safety.max_acceleration(ahead, step, actuation) > -min(safety.braking, safety.time_gap_braking)
        self.ahead = FollowingState(*(values[free] for values in ahead))
        self.underway = ActuatorState(start.acceleration[free], tuple(each[free] for each in start.pending))

    def go(self, leader: Any, wanted: Any) -> np.ndarray:
        """Make one step in which leaders accelerate with `leader`; return the cars' accelerations."""
        step, sensed = self.step, self.readings.read_for_filter("all", self.ahead)
        actuation = None if self.actuator is None else (self.actuator, self.underway)
        limited = self.safety.limit(np.broadcast_to(wanted, self.ahead.speed.shape), sensed, step, actuation)
        assert (limited >= np.minimum(wanted, -self.safety.braking)).all()
        if self.actuator is not None:
            self.underway = self.actuator.apply_command(limited, self.ahead.speed, self.underway, step)
            limited = self.underway.acceleration
        speed = next_speed(self.ahead.speed, limited, step)
        ahead = next_speed(self.ahead.leader_speed, leader, step)
        self.ahead = FollowingState(speed, ahead, self.ahead.gap + step * (ahead - speed))
        return limited


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
@pytest.mark.parametrize("safety", FILTERS, ids=["usual", "no floor", "wide", "weak brakes"])
def test_a_leader_who_brakes_as_hard_as_allowed_is_never_touched(
    safety: SafetyFilter, actuator: Actuator | None
) -> None:
    for step, seed in ((0.1, 0), (0.5, 1)):
        pursuit = Pursuit(safety, actuator, step, 2000, seed)
        assert len(pursuit.ahead.gap) > 500
        nearest = np.minimum(pursuit.ahead.gap, safety.standstill_gap)
        leader = np.zeros(len(nearest))
        for number in range(round(30.0 / step)):
            if number % round(2.0 / step) == 0:
                leader = pursuit.generator.choice([-1.0, -1.0, -0.3, 0.0, 0.5], len(nearest))
                leader *= safety.leader_braking
            pursuit.go(leader, 3.0)
            assert (pursuit.ahead.gap >= nearest - 1e-9).all()


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
@pytest.mark.parametrize("safety", [FILTERS[0], FILTERS[2]], ids=["usual", "wide"])
def test_the_floor_holds_behind_who_brakes_no_harder_than_it_allows_for(
    safety: SafetyFilter, actuator: Actuator | None
) -> None:
    pursuit = Pursuit(safety, actuator, 0.1, 2000, 2)
    leader = np.zeros(len(pursuit.ahead.gap))
    for number in range(300):
        if number % 20 == 0:
            leader = pursuit.generator.choice([-1.0, -1.0, -0.3, 0.0, 0.5], len(pursuit.ahead.gap))
            leader *= safety.time_gap_braking
        pursuit.go(leader, 3.0)
        if number > 10:  # commands given before the start have arrived
            speed, _, gap = pursuit.ahead
            assert (gap >= safety.standstill_gap + safety.time_gap * speed - 1e-9).all()


@pytest.mark.parametrize("actuator", ACTUATORS, ids=str)
@pytest.mark.parametrize("sensors", [Sensors(1.0, 1.0), Sensors(0.5, 0.5, dropout=0.5)], ids=str)
def test_sensors_that_err_within_their_bounds_and_miss_readings_change_neither_claim(
    sensors: Sensors, actuator: Actuator | None
) -> None:
    allows = SafetyFilter(gap_error=sensors.gap_error, speed_error=sensors.speed_error)
    for hardest in (allows.leader_braking, allows.time_gap_braking):
        pursuit = Pursuit(allows, actuator, 0.1, 4000, 3, sensors)
        nearest = np.minimum(pursuit.ahead.gap, allows.standstill_gap)
        leader = np.zeros(len(nearest))
        for number in range(300):
            if number % 20 == 0:
                leader = hardest * pursuit.generator.choice([-1.0, -1.0, -0.3, 0.0, 0.5], len(nearest))
            pursuit.go(leader, 3.0)
            speed, _, gap = pursuit.ahead
            assert (gap >= nearest - 1e-9).all()
            if number > 10 and hardest == allows.time_gap_braking:
                assert (gap >= allows.standstill_gap + allows.time_gap * speed - 1e-9).all()


def test_a_filter_that_does_not_know_of_its_sensors_errors_lets_cars_touch() -> None:
    pursuit = Pursuit(SafetyFilter(), None, 0.1, 4000, 3, Sensors(4.0, 4.0))
    for _ in range(300):
        pursuit.go(pursuit.generator.choice([-6.0, 3.0], len(pursuit.ahead.gap)), 3.0)
    assert (pursuit.ahead.gap < 0.0).any()


def test_without_the_filter_the_same_cars_crash() -> None:
    pursuit = Pursuit(SafetyFilter(active=False), None, 0.1, 100, 0)
    for _ in range(100):
        pursuit.go(-6.0, 3.0)
    assert (pursuit.ahead.gap < 0).any()


@given(SPEEDS, SPEEDS, GAPS | st.just(inf), st.floats(-3.0, 3.0), STEPS, st.sampled_from([1.0, 0.3, 0.0]))
@example(2.27840919390205, 0.0, 4.03725439536899, 0.0455, 1.0, 0.3)  # a time gap shorter than a step
def test_one_car_in_plain_numbers_is_told_what_rows_and_tensors_are(
    speed: float, leader: float, gap: float, wanted: float, step: float, time_gap: float
) -> None:
    ahead, safety = FollowingState(speed, leader, gap), SafetyFilter(time_gap=time_gap)
    limited = safety.limit(wanted, ahead, step)
    rows = safety.limit(np.array([wanted]), FollowingState(*(np.array([value]) for value in ahead)), step)
    tensors = safety.limit(
        torch.tensor([wanted], dtype=torch.float64),
        FollowingState(*(torch.tensor([value], dtype=torch.float64) for value in ahead)),
        step,
    )
    assert rows[0] == pytest.approx(limited, abs=1e-9)
    assert tensors[0].item() == pytest.approx(limited, abs=1e-9)


SLOW_ACTUATORS = st.sampled_from([each for each in ACTUATORS if each is not None])


@given(
    *(SLOW_ACTUATORS, SPEEDS, SPEEDS, GAPS, STEPS),
    st.floats(-6.0, 2.0),
    st.lists(st.floats(-6.0, 2.0), min_size=7, max_size=7),
)
def test_the_bound_of_a_slow_actuator_is_the_same_for_plain_numbers_rows_and_tensors(
    actuator: Actuator,
    speed: float,
    leader_speed: float,
    gap: float,
    step: float,
    acceleration: float,
    commands: list[float],
) -> None:
    pending = commands[: actuator.delay_steps(step)]
    plain = FollowingState(speed, leader_speed, gap)
    bound = SafetyFilter().max_acceleration(plain, step, (actuator, ActuatorState(acceleration, tuple(pending))))
    for rows in (lambda value: np.array([value, 1.0]), lambda value: torch.tensor([value, 1.0], dtype=torch.float64)):
        state = ActuatorState(rows(acceleration), tuple(rows(each) for each in pending))
        found = SafetyFilter().max_acceleration(FollowingState(*map(rows, plain)), step, (actuator, state))
        assert float(found[0]) == pytest.approx(bound, abs=1e-9)


def smallest_margin(
    command: float, safety: SafetyFilter, actuator: Actuator, state: FollowingState, start: ActuatorState, step: float
) -> float:
    """Return the smallest gap beyond the time gap after a command, while both then brake as hard as it assumes."""
    speed, leader, gap = state
    margins, arriving = list[float](), len(start.pending)
    for number in range(400):
        wanted = command if number == 0 else -safety.time_gap_braking
        start = actuator.apply_command(wanted, speed, start, step)
        speed = next_speed(speed, start.acceleration, step)
        leader = next_speed(leader, -safety.time_gap_braking, step)
        gap += (leader - speed) * step
        if number >= arriving:
            margins.append(gap - safety.standstill_gap - safety.time_gap * speed)
        if speed == 0.0 == leader:
            break
    return min(margins)


@given(SLOW_ACTUATORS, st.floats(0.0, 30.0), st.floats(0.0, 30.0), st.floats(2.0, 80.0), st.floats(-3.0, 2.0))
def test_the_time_gap_of_a_slow_actuator_is_kept_and_no_more(
    actuator: Actuator, speed: float, leader_speed: float, gap: float, acceleration: float
) -> None:
    safety, step = SafetyFilter(braking=100.0, leader_braking=100.0), 0.1  # contact never limits it first
    state = FollowingState(speed, leader_speed, gap)
    start = ActuatorState(acceleration, (acceleration,) * actuator.delay_steps(step))
    bound = safety.max_acceleration(state, step, (actuator, start))
    if -safety.time_gap_braking < bound < 10.0:
        assert smallest_margin(bound, safety, actuator, state, start, step) >= -1e-9
        assert smallest_margin(bound + 1e-3, safety, actuator, state, start, step) < 0.0


@given(SPEEDS, SPEEDS, st.floats(-3.0, 3.0))
def test_without_a_leader_commands_are_not_limited(speed: float, leader_speed: float, wanted: float) -> None:
    for actuation in (None, (Actuator(lag=0.3), ActuatorState(0.0))):
        free = SafetyFilter().limit(wanted, FollowingState(speed, leader_speed, inf), 0.1, actuation)
        assert free == wanted


@given(SPEEDS, SPEEDS, GAPS, st.floats(-3.0, 3.0), st.floats(0.0, 2.0), st.floats(0.0, 2.0))
def test_errors_of_the_sensors_within_their_bounds_never_let_more_pass(
    speed: float, leader: float, gap: float, wanted: float, far: float, fast: float
) -> None:
    careful = SafetyFilter(gap_error=2.0, speed_error=2.0)
    sensed = careful.limit(wanted, FollowingState(speed, leader + fast, gap + far), 0.1)
    assert sensed <= SafetyFilter().limit(wanted, FollowingState(speed, leader, gap), 0.1) + 1e-9


@given(st.floats(0.0, 30.0), st.floats(-6.0, 2.0), st.lists(st.floats(-6.0, 2.0), min_size=1, max_size=40))
def test_a_car_with_lag_drives_no_farther_than_its_equivalent(
    speed: float, acceleration: float, commands: list[float]
) -> None:
    actuator, step, braking = Actuator(lag=0.4), 0.1, 6.0
    underway = ActuatorState(max(acceleration, -speed / step))
    for command in commands:
        equivalent = actuator.equivalent_speed(speed, underway, braking, step)
        underway = actuator.apply_command(command, speed, underway, step)
        speed = next_speed(speed, underway.acceleration, step)
        following = actuator.equivalent_speed(speed, underway, braking, step)
        standing = actuator.equivalent_speed(0.0, ActuatorState(0.0), braking, step)
        assert speed <= following + 1e-9
        assert following <= max(equivalent + command * step, standing) + 1e-9


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"leader_braking": 5.0}, "leader_braking: 5 is not allowed; allowed: >= braking, 6"),
        ({"leader_braking": 1e308}, "leader_braking: 1e+308 is not allowed; allowed: <= 100"),
        ({"time_gap_braking": 7.0}, "time_gap_braking: 7 is not allowed; allowed: 0.5 to braking, 6"),
        ({"time_gap_braking": 1e-6}, "time_gap_braking: 1e-06 is not allowed; allowed: 0.5 to braking, 6"),
        ({"time_gap": -1.0}, "time_gap: -1.0 is not allowed; allowed: greater than or equal to 0"),
    ],
)
def test_brakes_that_prove_nothing_are_refused(values: dict[str, float], line: str) -> None:
    with pytest.raises(InputError) as refused:
        build_dataclass(SafetyFilter, values, "safety")
    assert line in str(refused.value)


@pytest.mark.parametrize("name", ["delay", "lag"])
def test_an_actuator_that_would_fill_the_memory_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"actuator.{name}: 1000000000.0 is not allowed; allowed: less than or"):
        build_dataclass(Actuator, {name: 1e9}, "actuator")


@given(st.integers(0, 2**32 - 1), st.sampled_from(FILTERS), SLOW_ACTUATORS, STEPS)
def test_plans_of_braking_that_are_left_out_would_change_nothing(
    seed: int, safety: SafetyFilter, actuator: Actuator, step: float
) -> None:
    generator, rows = np.random.default_rng(seed), 64
    speed = generator.uniform(0.0, 40.0, rows) * (generator.random(rows) > 0.1)
    leader = np.maximum(speed + generator.normal(0.0, 8.0, rows), 0.0)
    state = FollowingState(speed, leader, generator.exponential(generator.choice([5.0, 30.0, 90.0]), rows))
    pending = tuple(generator.uniform(-6.0, 3.0, rows) for _ in range(actuator.delay_steps(step)))
    start = ActuatorState(np.maximum(generator.uniform(-6.0, 3.0, rows), -speed / step), pending)
    wanted = generator.uniform(-6.0, 3.0, rows)
    expected = np.minimum(wanted, safety.max_acceleration(state, step, (actuator, start)))
    np.testing.assert_allclose(safety.limit(wanted, state, step, (actuator, start)), expected, atol=1e-9)
    for row in range(3):
        own = ActuatorState(start.acceleration[row].item(), tuple(each[row].item() for each in pending))
        plain = FollowingState(*(values[row].item() for values in state))
        found = safety.limit(wanted[row].item(), plain, step, (actuator, own))
        assert found == pytest.approx(expected[row], abs=1e-9)
