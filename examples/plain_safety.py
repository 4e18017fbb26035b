"""The safety filter of a .unjam controller in plain Python: see docs/safety.md for what it proves."""

import math
from types import SimpleNamespace

from plain_experts import State


def highest(f: SimpleNamespace, s: State, step: float) -> float:
    """The highest acceleration after which it can still stop, and keep its time gap [m/s2]."""
    if not f.active:
        return math.inf
    leader, room = max(s.leader_speed - f.speed_error, 0.0), s.leader_gap - f.gap_error - f.standstill_gap
    allowed = speed_to_stop_within(room + stopping(leader, f.leader_braking, step), f.braking, step)
    if f.time_gap:
        c, later = f.time_gap_braking, max(leader - f.time_gap_braking * step, 0.0)
        end = room + stopping(leader, c, step)
        near = (end - stopping(later, c, step)) / (f.time_gap + step)
        far = speed_to_stop_within(end - c * (f.time_gap + step / 2.0) ** 2 / 2.0, c, step)
        allowed = min(allowed, near, max(far, later + f.time_gap * c))
    return max((allowed - s.speed) / step, -f.braking)


def stopping(speed: float, braking: float, step: float) -> float:
    """How far a car drives that brakes from the next step on [m]."""
    steps = math.floor(speed / (braking * step))
    return step * steps * (speed - braking * step * (steps + 1) / 2)


def speed_to_stop_within(distance: float, braking: float, step: float) -> float:
    """The highest speed after this step from which it still stands within a distance [m/s]."""
    room, change = max(distance, 0.0) / step, braking * step
    steps = math.floor((math.sqrt(1.0 + 8.0 * room / change) - 1.0) / 2.0)
    return (room + change * steps * (steps + 1) / 2.0) / (steps + 1.0)
