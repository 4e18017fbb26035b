"""Rewards: named terms, and their sum. One place for the actual and the virtual environment."""

from collections.abc import Callable
from sys import float_info
from typing import NamedTuple

from unjam.drivers.user_driver import FileReference, is_file_reference
from unjam.errors import invalid_value, unknown_name
from unjam.parameters import split_parameters
from unjam.physics.arrays import Array, clamp_min, namespace, square_root

DESIRED_SPEED = 30.0
"""v_des of Eq. 16 [m/s]"""
MAX_PENALIZED_TIME_GAP = 1.0
"""h_max of Eq. 16 [s]"""
MOBILITY_WEIGHT, TIME_GAP_WEIGHT, ACCELERATION_WEIGHT = 1.0, 0.1, 0.1
"""alpha, beta, gamma of Eq. 16"""
MERGE_TARGET_SPEED = 20.0
"""speed that the merge's reward wants, and the scale of speeds in power [m/s]"""
MERGE_FREE_FLOW_VEHICLES = 30.0
"""scale of how many are on the road in power: about as many as on the merge in free flow"""
CRASH_CLOSURE_STEPS = 2_400
"""decisions for which a crash closes a road, to its reward: the whole of an on-ramp's episode"""
MIN_CRASH_BACKLOG = 200
"""how many wait then, at least, for others were still to come: on an on-ramp, where 3,700 vehicles an hour
take people's 154 s, some 160 are there"""
STANDSTILL_SPEED = 1e-3
"""speed below which a time headway means nothing [m/s]"""


class Outcome(NamedTuple):
    """What one decision led to; a row per decision. NumPy arrays or torch tensors, SI units."""

    speeds: Array
    """speeds after the step of all vehicles (in the virtual environment: of those seen) [m/s], shape
    (rows, vehicles); NaN where a vehicle is not on the road"""
    accelerations: Array
    """what the CAVs were told, within the action limit [m/s2], shape (rows, CAVs); NaN where one is not on
    the road"""
    time_gaps: Array
    """time headways of the CAVs after the step, gap over speed [s], shape (rows, CAVs); NaN likewise"""
    has_crashed: Array
    """whether there was a collision, shape (rows,)"""
    backlog: Array
    """vehicles that want to enter and cannot, shape (rows,)"""


Reward = Callable[[Outcome], dict[str, Array]]
"""A reward: its terms by name, each of shape (rows,). What is earned is their sum."""


def _nan_mean(values: Array) -> Array:
    """Mean over the last axis of those that are there (not NaN); 0 where nobody is."""
    there = ~namespace(values).isnan(values)
    return _nan_sum(values) / clamp_min(there.sum(-1), 1)


def _nan_sum(values: Array) -> Array:
    """Sum over the last axis of those that are there (not NaN)."""
    return namespace(values).nan_to_num(values, nan=0.0).sum(-1)


def released_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward behind Table 1 on ring and figure eight: 4 mean v / 20 - 4 mean |a|; 0 at a crash.

    Source: the authors' released code, after Flow's wave attenuation environment.
    """
    running = ~outcome.has_crashed
    return {
        "speed": 4.0 * _nan_mean(outcome.speeds) / 20.0 * running,
        "acceleration": -4.0 * _nan_mean(abs(outcome.accelerations)) * running,
    }


def eq16_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward Eq. 16 of the paper with the sign of its first term mended: it pays for being near v_des."""
    mean = _nan_mean(outcome.speeds)
    return {
        "speed": MOBILITY_WEIGHT * clamp_min(DESIRED_SPEED - abs(DESIRED_SPEED - mean), 0.0),
        **_eq16_costs(outcome),
    }


def printed_eq16_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward Eq. 16 as it is printed: its first term pays for being slow. Here to show just that."""
    mean = _nan_mean(outcome.speeds)
    return {"speed": MOBILITY_WEIGHT * clamp_min(DESIRED_SPEED - mean, 0.0), **_eq16_costs(outcome)}


def _eq16_costs(outcome: Outcome) -> dict[str, Array]:
    return {
        "time_gap": TIME_GAP_WEIGHT * time_gap_penalty(outcome),
        "acceleration": -ACCELERATION_WEIGHT * _nan_sum(abs(outcome.accelerations)),
    }


def released_merge_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward behind Table 1 on the merge; 0 at a crash, and never below 0.

    1 - ||20 - v|| / ||20|| (norms over all vehicles), less 0.1 for each second that a CAV's headway lacks
    to 1 s. Source: the authors' released code, after Flow's merge environment.
    """
    xp = namespace(outcome.speeds)
    running = ~outcome.has_crashed
    there = ~xp.isnan(outcome.speeds)
    missed = _nan_sum((MERGE_TARGET_SPEED - outcome.speeds) ** 2) / (
        MERGE_TARGET_SPEED**2 * clamp_min(there.sum(-1), 1)
    )
    speed = clamp_min(1.0 - square_root(missed), 0.0) * there.any(-1) * running
    headway = TIME_GAP_WEIGHT * time_gap_penalty(outcome) * running
    return {"speed": speed, "time_gap": headway, "lower_bound": clamp_min(-speed - headway, 0.0)}


def power_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward flow and speed at once: the distance that all cover, times their mean speed; 0 at a crash.

    About 1 where the merge flows freely. Neither a jam that lets many through nor an empty road earns it.
    Source: throughput over delay, the power of Kleinrock 1979 (IEEE ICC, 43.1), in vehicles.
    """
    flow = _nan_sum(outcome.speeds) / (MERGE_TARGET_SPEED * MERGE_FREE_FLOW_VEHICLES)
    return {"power": flow * _nan_mean(outcome.speeds) / MERGE_TARGET_SPEED * ~outcome.has_crashed}


def travel_time_reward(outcome: Outcome) -> dict[str, Array]:
    """Reward short travel times: minus how many are on the road or wait to be, in hundreds.

    Whoever wants to drive is given by the demand, so that the sum over an episode is, but for its scale, the
    mean travel time with waiting: nothing is earned by keeping vehicles out. Nor by a crash, which ends the
    episode: who is there then, and at least `MIN_CRASH_BACKLOG`, wait for `CRASH_CLOSURE_STEPS` decisions.
    """
    there = (~namespace(outcome.speeds).isnan(outcome.speeds)).sum(-1) + outcome.backlog
    closed = CRASH_CLOSURE_STEPS * clamp_min(there, MIN_CRASH_BACKLOG) * outcome.has_crashed
    return {"travel_time": -(there + closed) / 100.0}


def time_gap_penalty(outcome: Outcome) -> Array:
    """Term: minus the seconds that CAVs' time headways lack to 1 s."""
    return -_nan_sum(clamp_min(MAX_PENALIZED_TIME_GAP - outcome.time_gaps, 0.0))


def acceleration_penalty(outcome: Outcome) -> Array:
    """Term: minus the CAVs' mean squared acceleration [m2/s4]."""
    return -_nan_mean(outcome.accelerations**2)


def speed_variation_penalty(outcome: Outcome) -> Array:
    """Term: minus the standard deviation of speed across vehicles [m/s]."""
    mean = _nan_mean(outcome.speeds)[..., None]
    return -(_nan_mean((outcome.speeds - mean) ** 2) ** 0.5)


REWARD_TERMS: dict[str, Callable[[Outcome], Array]] = {
    "time_gap": time_gap_penalty,
    "comfort": acceleration_penalty,
    "smoothness": speed_variation_penalty,
}
"""what any reward may ask for besides, with a weight"""

REWARDS: dict[str, Reward] = {
    "released": released_reward,
    "released-merge": released_merge_reward,
    "eq16": eq16_reward,
    "eq16-as-printed": printed_eq16_reward,
    "power": power_reward,
    "travel-time": travel_time_reward,
}


def time_gap(gap: Array, speed: Array) -> Array:
    """Return gap over speed [s]; of a standing vehicle a very large number."""
    return gap / clamp_min(speed, STANDSTILL_SPEED)


def make_reward(text: str) -> Reward:
    """Return the reward for a name, with weights of its terms, or for a function of the user's own.

    `released:acceleration=2,time_gap=0.5` is the reward `released_reward` with its term `acceleration` counted twice,
    and with half of the term `time_gap` of TERMS besides; `path.py:name` a function that takes an `Outcome`
    and returns its terms by name, or one array.

    Raises:
        InputError: unknown name or term, a weight that is no number, or the file has no such function.
    """
    name, weights = split_parameters(text)
    for term, weight in weights.items():
        number = isinstance(weight, int | float) and not isinstance(weight, bool)
        if not number or not abs(weight) <= float_info.max:  # NaN is not either
            raise invalid_value(f"reward {name}: {term}", weight, "a number")
    if is_file_reference(name):
        reward = _user_reward(name)
    elif name in REWARDS:
        reward = REWARDS[name]
    else:
        raise unknown_name("reward", name, [*REWARDS, "path.py:name"])
    return _weighted_reward(reward, weights) if weights else reward


def _user_reward(name: str) -> Reward:
    reference = FileReference.parse(name)
    function = reference.load_function("an Outcome")

    def user_reward(outcome: Outcome) -> dict[str, Array]:
        terms = reference.call_user_code(function, outcome)
        return terms if isinstance(terms, dict) else {"reward": terms}

    return user_reward


def _weighted_reward(reward: Reward, weights: dict[str, float]) -> Reward:
    """Return a reward whose terms count as `weights` says; those that it does not have come from TERMS."""

    def weighted_reward(outcome: Outcome) -> dict[str, Array]:
        terms = reward(outcome)
        for name, weight in weights.items():
            if name not in terms and name not in REWARD_TERMS:
                raise invalid_value("reward: term", name, ", ".join(dict.fromkeys([*terms, *REWARD_TERMS])))
            terms[name] = weight * (terms[name] if name in terms else REWARD_TERMS[name](outcome))
        return terms

    return weighted_reward
