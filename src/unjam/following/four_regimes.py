"""A made-up set of car following in four regimes: acceleration, deceleration, cruising, emergency braking.

The paper trains and judges its knowledge network (Fig. 6) on such a set of 262,630 rows, after Mo, Shi and Di
(2021), and leaves most of its making open. Here every choice is a parameter, and all that is drawn comes from
one seed.
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
"""the drivers of Treiber, Hennecke and Helbing (2000)"""

MIN_REGIME_GAP = 0.1
"""what the driver is told at least [m]: noise may not drive it into its leader and out at the other side"""

UniformRange = tuple[float, float]


@dataclass(frozen=True, config=STRICT)
class FourRegimesSettings:
    """How the set is made; the defaults are ours where the paper is silent."""

    rows: PositiveInt = 262_630
    """moments with an acceleration, of all regimes together, as many of each as is possible (the paper: the
    total)"""
    seconds: Positive = 30.0
    """length of a trajectory; the last of the set is cut where the rows are full"""
    step: Positive = 0.1
    """time between two moments [s]"""
    driver: IDMParameters = field(default_factory=lambda: TREIBER_IDM)
    """who follows: the truth, which the knowledge network's own IDM need not share"""
    noise: NonNegative = 0.2
    """standard deviation of the Gaussian noise on each acceleration [m/s2]; it moves the follower too"""
    speed: UniformRange = (5.0, 25.0)
    """of the follower at the start, uniform [m/s] (the paper: `parse_factor_space`)"""
    leader_speed_surplus: UniformRange = (0.0, 8.0)
    """acceleration: by how much the leader is faster, uniform [m/s]"""
    leader_speed_deficit: UniformRange = (0.0, 8.0)
    """deceleration: by how much the leader is slower at the start, uniform [m/s]"""
    cruising_speed_difference: UniformRange = (-0.5, 0.5)
    """cruising: leader's speed minus the follower's at the start, uniform [m/s]"""
    emergency_speed_deficit: UniformRange = (4.0, 15.0)
    """emergency braking: by how much the leader is slower at the start, uniform [m/s]"""
    acceleration: UniformRange = (0.1, 0.5)
    """acceleration: of the follower at the start, as a share of what an empty road would give, uniform"""
    deceleration: UniformRange = (-2.0, 0.0)
    """deceleration: of the follower at the start, uniform [m/s2] (the paper)"""
    emergency_acceleration: float = -2.0
    """emergency braking: of the follower at the start [m/s2] (the paper)"""
    seed: NonNegativeInt = 0

    @model_validator(mode="after")
    def _check_speed(self) -> "FourRegimesSettings":
        if self.speed[1] >= self.driver.desired_speed:
            raise ValueError(
                f"speed: {self.speed[1]} m/s is not allowed at the start; allowed: below the driver's "
                f"desired speed, {self.driver.desired_speed} m/s"
            )
        return self


def make_four_regimes(settings: FourRegimesSettings) -> list[Pair]:
    """Return the trajectories, the regimes in turn; `kind` names the regime.

    The leader keeps its speed. Each trajectory starts with the gap at which the driver's own model gives the
    acceleration that belongs to the regime. They have `settings.rows` accelerations together.
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
        seen = clamp_min(gap, MIN_REGIME_GAP)
        acceleration = idm_acceleration(speed, leader_speed, seen, settings.driver) + noise[moment]
        speed = next_speed(speed, acceleration, settings.step)
        gap = next_position(gap, leader_speed - speed, settings.step)
        speeds[:, moment + 1], gaps[:, moment + 1] = speed, gap
    leaders = np.repeat(leader_speed[:, None], length + 1, axis=1)
    pairs = []
    for number, driven in enumerate(zip(speeds, leaders, gaps, strict=True)):
        name, kind = f"{number}", REGIMES[regime[number]]
        pair = Pair(name, name, settings.step, *driven, kind=kind)
        pairs.append(pair.part(0, min(length, settings.rows - number * length) + 1))
    return pairs


def _draw_starts(
    regime: np.ndarray, settings: FourRegimesSettings, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Return speed, leader's speed and gap at the start of each trajectory."""

    def uniform(bounds: UniformRange) -> Floats:
        return generator.uniform(*bounds, size=len(regime))

    p, s = settings.driver, settings
    speed = uniform(s.speed)
    free = p.max_acceleration * (1.0 - (speed / p.desired_speed) ** p.exponent)
    faster = [uniform(s.leader_speed_surplus), -uniform(s.leader_speed_deficit)]
    faster += [uniform(s.cruising_speed_difference), -uniform(s.emergency_speed_deficit)]
    leader_speed = (speed + np.choose(regime, faster)).clip(0.0, None)
    wanted = [uniform(s.acceleration) * free, uniform(s.deceleration), 0.0, s.emergency_acceleration]
    # Eq. 5 solved for the gap.
    interaction = (free - np.choose(regime, wanted)) / p.max_acceleration
    return speed, leader_speed, desired_gap(speed, speed - leader_speed, p) / np.sqrt(interaction)
