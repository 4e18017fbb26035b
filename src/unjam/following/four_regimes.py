"""A synthetic data set of car following in four regimes: acceleration, deceleration, cruising, emergency braking.

The paper trains and tests its knowledge network (Fig. 6) on such a data set of 262,630 rows, after Mo, Shi and Di
(2021), and hardly describes its generation. Here every choice is a setting, and one seed determines all random numbers.
"""

from dataclasses import field

import numpy as np
from pydantic import model_validator

from unjam.parameters import STRICT, NonNegative, NonNegativeInt, Positive, PositiveInt, parameter_dataclass
from unjam.physics.arrays import clamp_min
from unjam.physics.idm import IDMParameters, desired_gap, idm_acceleration
from unjam.physics.kinematics import next_position, next_speed
from unjam.recordings.trajectories import Floats, FollowingTrajectory

REGIMES = ("acceleration", "deceleration", "cruising", "emergency braking")
"""names of the regimes, in the order of the trajectories"""
TREIBER_IDM = IDMParameters(desired_speed=33.3, time_headway=1.6, max_acceleration=0.73, comfortable_deceleration=1.67)
"""IDM parameters of Treiber, Hennecke and Helbing (2000)"""
MIN_REGIME_GAP = 0.1
"""smallest gap in the formula of the acceleration [m]; noise can make the simulated gap smaller"""
UniformRange = tuple[float, float]
"""smallest and largest value of a uniform distribution"""


@parameter_dataclass(frozen=True, config=STRICT)
class FourRegimesSettings:
    """Settings of the data set; each trajectory draws values from the uniform distributions of the ranges.

    Defaults with the mark (paper) are values of the paper; the paper does not state the other values.
    """

    samples: PositiveInt = 262_630
    """number of samples with an acceleration, in all regimes together (paper)"""
    seconds: Positive = 30.0
    """duration of a trajectory [s]; the last trajectory is shorter if `samples` requires it"""
    time_step: Positive = 0.1
    """time between two samples [s]"""
    driver: IDMParameters = field(default_factory=lambda: TREIBER_IDM)
    """IDM parameters of the simulated follower; the base of the knowledge network may have other parameters"""
    acceleration_noise: NonNegative = 0.2
    """standard deviation of the Gaussian noise that is added to each acceleration of the follower [m/s2]"""
    initial_speed: UniformRange = (5.0, 25.0)
    """initial speed of the follower [m/s] (paper)"""
    acceleration_speed_surplus: UniformRange = (0.0, 8.0)
    """regime acceleration: leader speed minus initial speed of the follower [m/s]"""
    deceleration_speed_deficit: UniformRange = (0.0, 8.0)
    """regime deceleration: initial speed of the follower minus leader speed [m/s]"""
    cruising_speed_difference: UniformRange = (-0.5, 0.5)
    """regime cruising: leader speed minus initial speed of the follower [m/s]"""
    emergency_speed_deficit: UniformRange = (4.0, 15.0)
    """regime emergency braking: initial speed of the follower minus leader speed [m/s]"""
    acceleration_share: UniformRange = (0.1, 0.5)
    """regime acceleration: initial acceleration of the follower, as a share of its acceleration on a free road"""
    initial_deceleration: UniformRange = (-2.0, 0.0)
    """regime deceleration: initial acceleration of the follower [m/s2] (paper)"""
    emergency_acceleration: float = -2.0
    """regime emergency braking: initial acceleration of the follower [m/s2] (paper)"""
    seed: NonNegativeInt = 0
    """seed of all random numbers"""

    @model_validator(mode="after")
    def _check_speed(self) -> "FourRegimesSettings":
        if self.initial_speed[1] >= self.driver.desired_speed:
            limit = f"below the driver's desired speed, {self.driver.desired_speed} m/s"
            raise ValueError(f"initial_speed: {self.initial_speed[1]} m/s is not allowed; allowed: {limit}")
        return self


def make_four_regimes(settings: FourRegimesSettings) -> list[FollowingTrajectory]:
    """Return trajectories with `settings.samples` accelerations in total; their `kind` is the name of their regime.

    The regimes alternate in the order of `REGIMES`. Leaders have constant speeds, and initial gaps result from the
    initial accelerations of the regimes.
    """
    generator = np.random.default_rng(settings.seed)
    steps = max(1, round(settings.seconds / settings.time_step))
    count = -(-settings.samples // steps)  # rounded up
    regimes = np.arange(count) % len(REGIMES)
    speed, leader_speed, gap = _draw_initial_states(regimes, settings, generator)
    noise = generator.normal(0.0, settings.acceleration_noise, (steps, count))
    speeds, gaps = np.empty((2, count, steps + 1))
    speeds[:, 0], gaps[:, 0] = speed, gap
    for step in range(steps):
        limited_gap = clamp_min(gap, MIN_REGIME_GAP)
        acceleration = idm_acceleration(speed, leader_speed, limited_gap, settings.driver) + noise[step]
        speed = next_speed(speed, acceleration, settings.time_step)
        gap = next_position(gap, leader_speed - speed, settings.time_step)
        speeds[:, step + 1], gaps[:, step + 1] = speed, gap
    leader_speeds = np.repeat(leader_speed[:, None], steps + 1, axis=1)
    trajectories = []
    for index, columns in enumerate(zip(speeds, leader_speeds, gaps, strict=True)):
        name, kind = str(index), REGIMES[regimes[index]]
        trajectory = FollowingTrajectory(name, name, settings.time_step, *columns, kind=kind)
        trajectories.append(trajectory.slice(0, min(steps, settings.samples - index * steps) + 1))
    return trajectories


def _draw_initial_states(
    regimes: np.ndarray, settings: FourRegimesSettings, generator: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Return speeds [m/s], leader speeds [m/s] and gaps [m] at the start of trajectories with the given regimes."""

    def draw(bounds: UniformRange) -> Floats:
        return generator.uniform(*bounds, size=len(regimes))

    p, s = settings.driver, settings
    speed = draw(s.initial_speed)
    free_acceleration = p.max_acceleration * (1.0 - (speed / p.desired_speed) ** p.exponent)
    differences = [draw(s.acceleration_speed_surplus), -draw(s.deceleration_speed_deficit)]
    differences += [draw(s.cruising_speed_difference), -draw(s.emergency_speed_deficit)]
    leader_speed = (speed + np.choose(regimes, differences)).clip(0.0, None)
    shares, decelerations = draw(s.acceleration_share), draw(s.initial_deceleration)
    accelerations = [shares * free_acceleration, decelerations, 0.0, s.emergency_acceleration]
    # Eq. 5 solved for the gap.
    interaction = (free_acceleration - np.choose(regimes, accelerations)) / p.max_acceleration
    return speed, leader_speed, desired_gap(speed, speed - leader_speed, p) / np.sqrt(interaction)
