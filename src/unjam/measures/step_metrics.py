"""Metrics of episodes that are means over control steps, without the record of an episode."""

from unjam.physics.arrays import Array, clamp_min, namespace, square_root
from unjam.worlds.reward import Outcome


def step_metrics(outcome: Outcome) -> dict[str, Array]:
    """Return metrics of control steps by their names in `METRICS`, shape (rows,) each.

    Their means over an episode are its metrics on roads where all vehicles are present all the time. The variance is
    the mean square minus the square of the mean, without an array of deviations: it is exact to some 1e-7 of the mean
    square in single precision.
    """
    speeds, count = outcome.speeds, outcome.speeds.shape[-1]
    mean, mean_square = speeds.sum(-1) / count, namespace(speeds).einsum("rv,rv->r", speeds, speeds) / count
    return {
        "mean_speed": mean,
        "speed_std_fleet": square_root(clamp_min(mean_square - mean * mean, 0.0)),
        "cav_mean_speed": outcome.cav_speeds.sum(-1) / outcome.cav_speeds.shape[-1],
        "mean_abs_accel": abs(outcome.accelerations).sum(-1) / outcome.accelerations.shape[-1],
    }
