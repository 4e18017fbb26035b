"""Metrics of episodes that are means over control steps, without the record of an episode."""

from unjam.measures.metrics import STANDING_SPEED
from unjam.physics.arrays import Array, square_root
from unjam.worlds.reward import Outcome


def step_metrics(outcome: Outcome) -> dict[str, Array]:
    """Return metrics of control steps by their names in `METRICS`, shape (rows,) each.

    Their means over an episode are its metrics on roads where all vehicles are present all the time.
    """
    speeds, mean = outcome.speeds, outcome.speeds.mean(-1)
    return {
        "mean_speed": mean,
        "speed_std_fleet": square_root(((speeds - mean[..., None]) ** 2).mean(-1)),
        "share_standing": (speeds < STANDING_SPEED).sum(-1) / speeds.shape[-1],
        "cav_mean_speed": outcome.cav_speeds.mean(-1),
        "mean_abs_accel": abs(outcome.accelerations).mean(-1),
    }
