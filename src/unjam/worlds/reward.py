"""Rewards as sums of named terms, used both in the environment and in the learned model."""

from collections.abc import Callable, Sequence
from math import isnan
from sys import float_info
from typing import Any, NamedTuple

import numpy as np

from unjam.drivers.check import PROBE_ROWS, check_row_independence
from unjam.drivers.command import to_answer_array
from unjam.drivers.user_driver import FileReference, UserFunction, is_file_reference, object_label
from unjam.errors import InputError, invalid_value, unknown_name
from unjam.parameters import split_parameters
from unjam.physics.arrays import Array, Floats, clamp_min, namespace, square_root
from unjam.physics.fuel import fuel_rate, kinetic_fuel_rate
from unjam.worlds.record import Trajectory

DESIRED_SPEED = 30.0
"""v_des of Eq. 16 [m/s]"""
MAX_PENALIZED_TIME_GAP = 1.0
"""h_max of Eq. 16 [s]"""
MOBILITY_WEIGHT, TIME_GAP_WEIGHT, ACCELERATION_WEIGHT = 1.0, 0.1, 0.1
"""alpha, beta, gamma of Eq. 16"""
MERGE_TARGET_SPEED = 20.0
"""target speed of the merge reward, and scale of speeds in the power reward [m/s]"""
MERGE_FREE_FLOW_VEHICLES = 30.0
"""scale of the number of vehicles in the power reward: about the number on the merge in free flow"""
CRASH_CLOSURE_STEPS = 2_400
"""control steps for which a crash closes a road in the travel-time reward: a whole on-ramp episode"""
MIN_CRASH_BACKLOG = 200
"""minimum number of vehicles that a crash stops; about 160 (3,700 veh/h for 154 s) drive on an on-ramp road"""
MAX_CALM_TIME_GAP, MAX_CALM_GAP = 5.0, 90.0
"""limits of time gap [s] and gap [m]; a CAV beyond both lags behind"""
LATE_WEIGHT = 0.01
"""cost of each meter by which a CAV lags behind [ml/s]"""
STEADY_FUEL = 0.05
"""fuel of a mid-size car at a constant speed of 10 to 25 m/s [ml/m]"""
STANDSTILL_SPEED = 1e-3
"""lower limit of the speed in time gaps [m/s]"""
MAX_REWARD_TERM = 1e30
"""largest magnitude of a term in one control step, so that no return overflows"""
MAX_REWARD_CELLS = 4_000_000
"""maximum of control steps times vehicles in one call of a reward function, which limits the memory"""


class Outcome(NamedTuple):
    """The outcome of control steps, one per row: NumPy arrays or torch tensors in SI units.

    The rewards of the package also accept one control step without the axis of rows: `has_crashed` is then a bool,
    `backlog` a float, and values of a single CAV may be floats.
    """

    speeds: Array
    """speeds of all vehicles of the road or model after the step [m/s], shape (rows, vehicles); NaN if absent"""
    accelerations: Array
    """commands of the CAVs within the action limit [m/s2], shape (rows, CAVs); NaN if absent"""
    time_gaps: Array
    """time gaps of the CAVs after the step [s], shape (rows, CAVs); NaN if absent"""
    has_crashed: Array
    backlog: Array
    """insertion backlog [vehicles], shape (rows,)"""
    cav_speeds: Array
    """speeds of the CAVs after the step [m/s], shape (rows, CAVs); NaN if absent"""


Reward = Callable[[Outcome], dict[str, Array]]
"""a function that returns terms by name, each of shape (rows,); the reward is the sum of the terms"""
RewardLike = str | Callable[[Outcome], Any]
"""the name of a reward, or a function of this process that returns its terms by name, or one array"""


def _nan_mean(values: Array) -> Array:
    """Return the mean over the last axis without NaN; 0 if all values are NaN."""
    if type(values) is float:
        return _nan_sum(values)
    if namespace(values) is np:
        total = np.add.reduce(values, -1)  # NaN if a vehicle is absent
        is_any_absent = isnan(total) if values.ndim == 1 else np.isnan(total).any()
        if not is_any_absent:  # much faster than the sum without NaN
            return total / max(values.shape[-1], 1)
    return _nan_sum(values) / clamp_min((~namespace(values).isnan(values)).sum(-1), 1)


def _nan_sum(values: Array) -> Array:
    if type(values) is float:
        return 0.0 if isnan(values) else values
    xp = namespace(values)
    return xp.where(xp.isnan(values), 0.0, values).sum(-1)


def released_reward(outcome: Outcome) -> dict[str, Array]:
    """Return the reward of Table 1 on loops, as in the authors' code: 4 mean v / 20 - 4 mean |a|; 0 at a crash."""
    is_running = outcome.has_crashed == 0
    return {
        "speed": 4.0 * _nan_mean(outcome.speeds) / 20.0 * is_running,
        "acceleration": -4.0 * _nan_mean(abs(outcome.accelerations)) * is_running,
    }


def eq16_reward(outcome: Outcome) -> dict[str, Array]:
    """Return the reward of Eq. 16 with a corrected sign of its first term, which rewards speeds near v_des."""
    return {
        "speed": MOBILITY_WEIGHT * clamp_min(DESIRED_SPEED - abs(DESIRED_SPEED - _nan_mean(outcome.speeds)), 0.0),
        "time_gap": TIME_GAP_WEIGHT * time_gap_penalty(outcome),
        "acceleration": -ACCELERATION_WEIGHT * _nan_sum(abs(outcome.accelerations)),
    }


def printed_eq16_reward(outcome: Outcome) -> dict[str, Array]:
    """Return the reward of Eq. 16 as printed, for comparison: its first term rewards low speeds."""
    speed = MOBILITY_WEIGHT * clamp_min(DESIRED_SPEED - _nan_mean(outcome.speeds), 0.0)
    return {**eq16_reward(outcome), "speed": speed}


def released_merge_reward(outcome: Outcome) -> dict[str, Array]:
    """Return the reward of Table 1 on the merge, as in the authors' code; 0 at a crash, and never below 0.

    It is 1 - ||20 - v|| / ||20|| (norms over all vehicles) minus 0.1 per second by which time gaps are below 1 s.
    """
    xp = namespace(outcome.speeds)
    is_running = outcome.has_crashed == 0
    is_present = ~xp.isnan(outcome.speeds)
    squared_error = _nan_sum((MERGE_TARGET_SPEED - outcome.speeds) ** 2)
    relative_error = squared_error / (MERGE_TARGET_SPEED**2 * clamp_min(is_present.sum(-1), 1))
    speed = clamp_min(1.0 - square_root(relative_error), 0.0) * is_present.any(-1) * is_running
    penalty = TIME_GAP_WEIGHT * time_gap_penalty(outcome) * is_running
    return {"speed": speed, "time_gap": penalty, "lower_bound": clamp_min(-speed - penalty, 0.0)}


def fuel_reward(outcome: Outcome) -> dict[str, Array]:
    """Return a reward for low fuel consumption of the CAVs per distance [ml/s]: about 0 in steady driving.

    Fuel is that of `unjam.physics.fuel` without the part that becomes kinetic energy, which only braking wastes. Time
    gaps below 1 s cost 0.1 per second, gaps beyond 90 m and 5 s cost 0.01 per meter, and a crash costs 10.
    """
    speeds, accelerations = outcome.cav_speeds, outcome.accelerations
    lost_fuel = fuel_rate(speeds, accelerations) - kinetic_fuel_rate(speeds, accelerations)
    lag = clamp_min(_cav_gaps(outcome) - clamp_min(MAX_CALM_TIME_GAP * speeds, MAX_CALM_GAP), 0.0)
    return {
        "fuel": _nan_mean(STEADY_FUEL * speeds - lost_fuel),
        "time_gap": TIME_GAP_WEIGHT * time_gap_penalty(outcome),
        "late": -LATE_WEIGHT * _nan_sum(lag),
        "crash": -10.0 * outcome.has_crashed,
    }


def power_reward(outcome: Outcome) -> dict[str, Array]:
    """Return a reward for flow and speed: the sum of all speeds times the mean speed; 0 at a crash.

    It is about 1 in free flow on the merge. Source: the power of Kleinrock 1979 (IEEE ICC, 43.1), in vehicles.
    """
    flow = _nan_sum(outcome.speeds) / (MERGE_TARGET_SPEED * MERGE_FREE_FLOW_VEHICLES)
    return {"power": flow * _nan_mean(outcome.speeds) / MERGE_TARGET_SPEED * (outcome.has_crashed == 0)}


def travel_time_reward(outcome: Outcome) -> dict[str, Array]:
    """Return a reward for short travel times: minus the number of vehicles on the road and in the backlog, in hundreds.

    The return is proportional to the mean travel time including insertion delays. A crash ends the episode, and costs
    as if these vehicles, at least `MIN_CRASH_BACKLOG`, had to wait for `CRASH_CLOSURE_STEPS` control steps.
    """
    vehicles = (~namespace(outcome.speeds).isnan(outcome.speeds)).sum(-1) + outcome.backlog
    crash_cost = CRASH_CLOSURE_STEPS * clamp_min(vehicles, MIN_CRASH_BACKLOG) * outcome.has_crashed
    return {"travel_time": -(vehicles + crash_cost) / 100.0}


def time_gap_penalty(outcome: Outcome) -> Array:
    """Return minus the sum of the seconds by which time gaps of CAVs are below 1 s."""
    return -_nan_sum(clamp_min(MAX_PENALIZED_TIME_GAP - outcome.time_gaps, 0.0))


def gap_penalty(outcome: Outcome) -> Array:
    """Return minus the mean gap of the CAVs [100 m], as longer gaps reduce the flow."""
    return -_nan_mean(_cav_gaps(outcome)) / 100.0


def acceleration_penalty(outcome: Outcome) -> Array:
    """Return minus the mean squared acceleration of the CAVs [m2/s4]."""
    return -_nan_mean(outcome.accelerations * outcome.accelerations)


def speed_variation_penalty(outcome: Outcome) -> Array:
    """Return minus the standard deviation of the speeds of all vehicles [m/s]."""
    mean = _nan_mean(outcome.speeds)[..., None]
    return -square_root(_nan_mean((outcome.speeds - mean) ** 2))


REWARD_TERMS: dict[str, Callable[[Outcome], Array]] = {
    "time_gap": time_gap_penalty,
    "gap": gap_penalty,
    "comfort": acceleration_penalty,
    "smoothness": speed_variation_penalty,
}
"""terms that can be added to any reward, with a weight"""

REWARDS: dict[str, Reward] = {
    "released": released_reward,
    "released-merge": released_merge_reward,
    "eq16": eq16_reward,
    "eq16-as-printed": printed_eq16_reward,
    "power": power_reward,
    "travel-time": travel_time_reward,
    "fuel": fuel_reward,
}


def reward_label(reward: RewardLike) -> str:
    """Return the name of a reward, for tables."""
    return reward if isinstance(reward, str) else object_label(reward)


def time_gap(gap: Array, speed: Array) -> Array:
    """Return gap over speed [s]; it is very large for a standing vehicle."""
    return gap / clamp_min(speed, STANDSTILL_SPEED)


def _cav_gaps(outcome: Outcome) -> Array:
    """Return the gaps of the CAVs [m] from their time gaps and speeds."""
    return outcome.time_gaps * clamp_min(outcome.cav_speeds, STANDSTILL_SPEED)


def make_reward(text: RewardLike) -> Reward:
    """Return the reward function for a name, which may contain weights, or for a user's function.

    `released:acceleration=2,time_gap=0.5` doubles the term `acceleration` of `released`, and adds half of the term
    `time_gap` of `REWARD_TERMS`. A function, also as `path.py:name`, takes an `Outcome` and returns its terms by name,
    or one array. Raise `InputError` for unknown names and terms, and for weights that are not numbers.
    """
    if not isinstance(text, str):
        return _user_reward(UserFunction.from_object(text, "an Outcome"))
    name, weights = split_parameters(text)
    for term, weight in weights.items():
        is_number = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not is_number or not abs(weight) <= float_info.max:  # also refuses NaN
            raise invalid_value(f"reward {name}: {term}", weight, "a number")
    if not is_file_reference(name) and name not in REWARDS:
        raise unknown_name("reward", name, [*REWARDS, "path.py:name"])
    reward = REWARDS.get(name)
    if reward is None:
        reference = FileReference.parse(name)
        reward = _user_reward(UserFunction.from_object(reference.load_object(), "an Outcome", reference))

    def weighted_reward(outcome: Outcome) -> dict[str, Array]:
        terms = dict(reward(outcome))
        for name, weight in weights.items():
            if name not in terms and name not in REWARD_TERMS:
                raise invalid_value("reward: term", name, ", ".join(dict.fromkeys([*terms, *REWARD_TERMS])))
            terms[name] = weight * (terms[name] if name in terms else REWARD_TERMS[name](outcome))
        return terms

    weighted_reward.__name__ = text
    return weighted_reward if weights else reward


def is_packaged_reward(reward: RewardLike) -> bool:
    """Return whether a reward is a reward of the package, with or without weights, and not a user's function."""
    return isinstance(reward, str) and not is_file_reference(split_parameters(reward)[0])


def _user_reward(function: UserFunction) -> Reward:
    def user_reward(outcome: Outcome) -> dict[str, Array]:
        terms = function(outcome)
        return terms if isinstance(terms, dict) else {"reward": terms}

    user_reward.__name__ = function.label

    def terms_of(rows: slice) -> Floats:
        return np.stack([*validate_reward_terms(user_reward, _random_outcome(rows)).values()], -1)

    try:
        terms_of(slice(None))
    except (InputError, ValueError):  # it may need another road than this example; errors appear in its episodes
        return user_reward
    check_row_independence(terms_of, f"reward {function.label}", "control steps")
    return user_reward


def _random_outcome(rows: slice, vehicles: int = 6, cavs: int = 2) -> Outcome:
    """Return `rows` of random control steps, which are the same in each call."""
    generator = np.random.default_rng(0)
    speeds, accelerations = generator.uniform(0, 20, (PROBE_ROWS, vehicles)), generator.normal(size=(PROBE_ROWS, cavs))
    time_gaps, has_crashed = generator.uniform(0.5, 3, (PROBE_ROWS, cavs)), np.arange(PROBE_ROWS) == 1
    fields = speeds, accelerations, time_gaps, has_crashed, 10 * speeds[:, 0], speeds[:, :cavs]
    return Outcome(*(values[rows] for values in fields))


def episode_reward_terms(
    reward: Reward, speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats
) -> dict[str, Floats]:
    """Return the terms of a reward in an episode, each of shape (T,); raise `InputError` if a term is invalid.

    Speeds are those of all vehicles, shape (T + 1, N); the backlog has shape (T + 1,), or (0,) if there is none.
    """
    step_count, block_size = len(speeds) - 1, max(1, MAX_REWARD_CELLS // max(1, speeds.shape[1]))
    terms = list[dict[str, Floats]]()
    for start in range(0, max(step_count, 1), block_size):
        stop = min(start + block_size, step_count)
        crashes = has_crashed and stop == step_count
        outcome = _step_outcomes(speeds, trajectories, crashes, backlog, slice(start, stop))
        terms.append(validate_reward_terms(reward, outcome, start))
    return {name: np.concatenate([term[name] for term in terms]) for name in terms[0]}


def _step_outcomes(
    speeds: Floats, trajectories: Sequence[Trajectory], has_crashed: bool, backlog: Floats, step_range: slice
) -> Outcome:
    first, end = step_range.start, step_range.stop
    size = end - first
    cavs = [cav for cav in trajectories if cav.step_slice.start < end and first < cav.step_slice.stop]
    accelerations, time_gaps, cav_speeds = (np.full((size, len(cavs)), np.nan) for _ in range(3))
    for column, cav in enumerate(cavs):
        start, stop = max(cav.start_step, first), min(cav.step_slice.stop, end)
        rows, steps = slice(start - first, stop - first), slice(start - cav.start_step, stop - cav.start_step)
        accelerations[rows, column] = cav.applied_acceleration[steps]
        later_steps = slice(steps.start + 1, steps.stop + 1)
        time_gaps[rows, column] = time_gap(cav.states.leader_gap[later_steps], cav.states.speed[later_steps])
        cav_speeds[rows, column] = cav.states.speed[later_steps]
    crash_steps = np.zeros(size, bool)
    crash_steps[-1:] = has_crashed
    step_backlog = backlog[1:][step_range] if len(backlog) else np.zeros(size)
    # Column-major: the rounding of sums over vehicles depends on the order in memory.
    all_speeds = np.asfortranarray(speeds[1:][step_range])
    return Outcome(all_speeds, accelerations, time_gaps, crash_steps, step_backlog, cav_speeds)


def validate_reward_terms(
    reward: Reward, outcome: Outcome, start: int = 0, row_name: str = "step"
) -> dict[str, Floats]:
    """Return the terms of steps from `start` on; raise `InputError` unless each term has an allowed value per step."""
    label, terms = f"reward {object_label(reward)}", dict[str, Floats]()
    answers = reward(outcome)
    if not answers:
        raise InputError(f"{label}: it has no terms; allowed: at least one")
    for name, answer in answers.items():
        row = "control step" if row_name == "step" else row_name
        values = to_answer_array(answer, len(outcome.speeds), label, f"term {name!r}", row)
        is_allowed = abs(values) <= MAX_REWARD_TERM
        if not is_allowed.all():
            row, allowed = int(np.argmin(is_allowed)), f"finite, at most {MAX_REWARD_TERM:g}"
            raise InputError(f"{label}: {row_name} {start + row}: term {name!r} is {values[row]:g}; allowed: {allowed}")
        terms[name] = values
    return terms


def check_tensor_terms(reward: Reward, terms: dict[str, Array]) -> None:
    """Raise `InputError` unless a reward has terms, and all terms are torch tensors of allowed real numbers."""
    label = f"reward {object_label(reward)}"
    if not terms:
        raise InputError(f"{label}: it has no terms; allowed: at least one")
    for name, values in terms.items():
        is_complex = getattr(values, "is_complex", None)
        if is_complex is None or is_complex():
            kind = f"a {type(values).__name__} is not allowed for the term {name!r}"
            raise InputError(f"{label}: {kind}; allowed: a tensor of real numbers, made of those of the Outcome")
        is_allowed = abs(values.detach().double()) <= MAX_REWARD_TERM
        if not bool(is_allowed.all()):
            value, allowed = float(values.detach()[~is_allowed][0]), f"finite, at most {MAX_REWARD_TERM:g}"
            raise InputError(f"{label}: term {name!r} is {value:g}; allowed: {allowed}")


def step_reward_terms(reward: Reward, outcome: Outcome, step: int, needs_rows: bool) -> dict[str, float]:
    """Return the terms of a reward in one control step without the axis of rows.

    A user's reward `needs_rows`. Raise `InputError` unless each term is one finite number.
    """
    if not needs_rows:
        terms = {name: float(value) for name, value in reward(outcome).items()}
        if all(abs(value) <= MAX_REWARD_TERM for value in terms.values()):  # also refuses NaN
            return terms
    rows = Outcome(*(np.array(values, ndmin=axes) for values, axes in zip(outcome, (2, 2, 2, 1, 1, 2), strict=True)))
    if step == 0:  # a constant term has the right shape for one row only
        validate_reward_terms(reward, Outcome(*(np.repeat(values, 2, axis=0) for values in rows)))
    return {name: values.item() for name, values in validate_reward_terms(reward, rows, step).items()}
