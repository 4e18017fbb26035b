"""A synthetic data set of car following in four regimes: acceleration, deceleration, cruising, emergency braking.

The paper trains and tests its knowledge network (Fig. 6) on such a set of 262,630 rows, after Mo, Shi and Di (2021),
and hardly describes how it was made. Here every choice is a setting, and everything random comes from one seed.
"""

from dataclasses import field

import numpy as np
from pydantic import model_validator
from pydantic.dataclasses import dataclass

from unjam.following.pairs import Floats, Pair
from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt
from unjam.physics.arrays import clamp_min
from unjam.physics.idm import IDMParameters, desired_gap, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed

REGIMES = ("acceleration", "deceleration", "cruising", "emergency braking")
TREIBER_IDM = IDMParameters(desired_speed=33.3, time_headway=1.6, max_acceleration=0.73, comfortable_deceleration=1.67)
"""of Treiber, Hennecke and Helbing (2000)"""
MIN_REGIME_GAP = 0.1
"""minimum gap for the driver, so that noise does not push it through its leader [m]"""

UniformRange = tuple[float, float]


@dataclass(frozen=True, config=STRICT)
class FourRegimesSettings:
    """Settings; initial values are uniform in their ranges. The defaults are ours where the paper gives no value."""

    rows: PositiveInt = 262_630
    """moments with an acceleration, equally divided between the regimes where possible (the paper: the total)"""
    seconds: Positive = 30.0
    """duration of a trajectory; the last one is cut when the rows are complete"""
    step: Positive = 0.1
    """time between two moments [s]"""
    driver: IDMParameters = field(default_factory=lambda: TREIBER_IDM)
    """true follower, which may differ from the knowledge network's own IDM"""
    noise: NonNegative = 0.2
    """standard deviation of the Gaussian noise on each acceleration, which also moves the follower [m/s2]"""
    speed: UniformRange = (5.0, 25.0)
    """initial speed of the follower [m/s] (the paper)"""
    leader_speed_surplus: UniformRange = (0.0, 8.0)
    """acceleration: leader speed minus the follower's initial speed [m/s]"""
    leader_speed_deficit: UniformRange = (0.0, 8.0)
    """deceleration: the follower's initial speed minus the leader speed [m/s]"""
    cruising_speed_difference: UniformRange = (-0.5, 0.5)
    """cruising: leader speed minus the follower's initial speed [m/s]"""
    emergency_speed_deficit: UniformRange = (4.0, 15.0)
    """emergency braking: the follower's initial speed minus the leader speed [m/s]"""
    acceleration: UniformRange = (0.1, 0.5)
    """acceleration: initial acceleration as a share of that on an empty road"""
    deceleration: UniformRange = (-2.0, 0.0)
    """deceleration: initial acceleration [m/s2] (the paper)"""
    emergency_acceleration: float = -2.0
    """emergency braking: initial acceleration [m/s2] (the paper)"""
    seed: NonNegativeInt = 0

    @model_validator(mode="after")
    def _check_speed(self) -> "FourRegimesSettings":
        if self.speed[1] >= self.driver.desired_speed:
            limit = f"below the driver's desired speed, {self.driver.desired_speed} m/s"
            raise ValueError(f"speed: {self.speed[1]} m/s is not allowed; allowed: {limit}")
        return self


def make_four_regimes(settings: FourRegimesSettings) -> list[Pair]:
    """Return trajectories of the regimes in turn, whose `kind` is the regime, with `settings.rows` accelerations.

    The leader keeps its speed. Each trajectory starts with the gap at which the driver has the initial acceleration.
    """
    generator = np.random.default_rng(settings.seed)
    length = max(1, round(settings.seconds / settings.step))
    count = -(-settings.rows // length)
    regime = np.arange(count) % len(REGIMES)
    speed, leader_speed, gap = _draw_starts(regime, settings, generator)
    noise = generator.normal(0.0, settings.noise, (length, count))
    speeds, gaps = np.empty((2, count, length + 1))
    speeds[:, 0], gaps[:, 0] = speed, gap
    for moment in range(length):
        seen_gap = clamp_min(gap, MIN_REGIME_GAP)
        acceleration = idm_acceleration(speed, leader_speed, seen_gap, settings.driver) + noise[moment]
        speed = next_speed(speed, acceleration, settings.step)
        gap = next_position(gap, leader_speed - speed, settings.step)
        speeds[:, moment + 1], gaps[:, moment + 1] = speed, gap
    leader_speeds = np.repeat(leader_speed[:, None], length + 1, axis=1)
    pairs = []
    for number, columns in enumerate(zip(speeds, leader_speeds, gaps, strict=True)):
        pair = Pair(f"{number}", f"{number}", settings.step, *columns, kind=REGIMES[regime[number]])
        pairs.append(pair.part(0, min(length, settings.rows - number * length) + 1))
    return pairs


def _draw_starts(
    regime: np.ndarray, settings: FourRegimesSettings, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Return the initial speed, leader speed and gap of each trajectory."""

    def uniform(bounds: UniformRange) -> Floats:
        return generator.uniform(*bounds, size=len(regime))

    p, s = settings.driver, settings
    speed = uniform(s.speed)
    free = p.max_acceleration * (1.0 - (speed / p.desired_speed) ** p.exponent)
    differences = [uniform(s.leader_speed_surplus), -uniform(s.leader_speed_deficit)]
    differences += [uniform(s.cruising_speed_difference), -uniform(s.emergency_speed_deficit)]
    leader_speed = (speed + np.choose(regime, differences)).clip(0.0, None)
    accelerations = [uniform(s.acceleration) * free, uniform(s.deceleration), 0.0, s.emergency_acceleration]
    # Eq. 5 solved for the gap.
    interaction = (free - np.choose(regime, accelerations)) / p.max_acceleration
    return speed, leader_speed, desired_gap(speed, speed - leader_speed, p) / np.sqrt(interaction)
