"""What the paper reports, for tables side by side."""

from typing import NamedTuple


class Reported(NamedTuple):
    """A row of the paper's Table 1 or 2."""

    reward: float
    speed: float
    """`average speed`: the CAV's own, start-up and exploration included [m/s]"""
    std: float
    """`speed std`: of the CAV's own speed over time [m/s]"""


PAPER: dict[tuple[str, str], Reported] = {
    ("ring", "trpo"): Reported(1699.15, 3.42, 0.55),
    ("ring", "ppo"): Reported(1057.14, 3.43, 0.75),
    ("ring", "sac"): Reported(1048.97, 3.24, 0.38),
    ("ring", "proposed"): Reported(1753.66, 4.04, 0.48),
    ("ring", "mb-trpo"): Reported(1717.45, 3.55, 0.73),
    ("ring", "no-initial-policy"): Reported(1633.28, 3.53, 0.57),
    ("figure-eight", "trpo"): Reported(542.42, 1.84, 1.43),
    ("figure-eight", "ppo"): Reported(228.86, 1.60, 1.20),
    ("figure-eight", "sac"): Reported(435.72, 2.30, 1.94),
    ("figure-eight", "proposed"): Reported(862.81, 6.41, 2.04),
    ("merge", "trpo"): Reported(420.07, 15.26, 2.46),
    ("merge", "ppo"): Reported(415.02, 14.67, 2.77),
    ("merge", "sac"): Reported(449.72, 16.47, 2.38),
    ("merge", "proposed"): Reported(492.93, 17.44, 2.22),
}
"""Tables 1 and 2, by road and variant"""
