"""The safety filter of a .unjam controller in plain Python; docs/safety.md has the proofs."""

import math
from types import SimpleNamespace
from typing import Any

from plain_experts import State


class Actuator:
    """Delay and lag with which a vehicle carries out commands; without entries in the recipe there are none."""

    def __init__(self, recipe: dict[str, Any], step: float) -> None:
        lag = recipe.get("lag", 0.0)
        self.step, self.decay = step, math.exp(-step / lag) if lag else 0.0
        self.acceleration, self.pending = 0.0, [0.0] * round(recipe.get("delay", 0.0) / step)

    def apply(self, command: float, speed: float) -> None:
        """Add a command; the oldest pending command becomes effective in this step."""
        arriving, *self.pending = *self.pending, command
        acceleration = self.acceleration * self.decay + arriving * (1.0 - self.decay)
        self.acceleration = max(acceleration, -speed / self.step)

    def equivalent_speed(self, speed: float, acceleration: float, braking: float) -> float:
        """Return the speed of a car without lag that drives at least as far."""
        return speed + self.step * self.decay / (1.0 - self.decay) * (acceleration + braking)


def highest(f: SimpleNamespace, s: State, step: float, actuator: Actuator) -> float:
    """Return the highest acceleration after which the CAV can still stop and keep its time gap [m/s2]."""
    if not f.active:
        return math.inf
    leader, room = max(s.leader_speed - f.speed_error, 0.0), s.leader_gap - f.gap_error - f.standstill_gap
    within_time_gap = time_gap_bound(f, s.speed, leader, room, step, actuator) if f.time_gap else math.inf
    speed = actuator.equivalent_speed(s.speed, actuator.acceleration, f.braking)
    for command in actuator.pending:
        speed = max(speed + command * step, actuator.equivalent_speed(0.0, 0.0, f.braking))
        room -= speed * step
    allowed = speed_to_stop_within(room + stopping(leader, f.leader_braking, step), f.braking, step)
    return max(min((allowed - speed) / step, within_time_gap), -f.braking)


def time_gap_bound(f: SimpleNamespace, v: float, leader: float, room: float, step: float, actuator: Actuator) -> float:
    """Return the highest command with which the time gap is kept if both then brake with `time_gap_braking` [m/s2]."""
    c, change, decay, a = f.time_gap_braking, f.time_gap_braking * step, actuator.decay, actuator.acceleration
    if not decay and not actuator.pending:
        later, end = max(leader - change, 0.0), room + stopping(leader, c, step)
        near = (end - stopping(later, c, step)) / (f.time_gap + step)
        far = speed_to_stop_within(end - c * (f.time_gap + step / 2.0) ** 2 / 2.0, c, step)
        return (min(near, max(far, later + f.time_gap * c)) - v) / step
    for command in actuator.pending:
        a = max(a * decay + command * (1.0 - decay), -v / step)
        v, leader = v + a * step, max(leader - change, 0.0)
        room += (leader - v) * step
    fading = step * decay / (1.0 - decay) * (a + c)
    equivalent, remaining, distance, allowed = v + fading, 1.0, 0.0, 20.0 + c
    for number in range(1, int((equivalent + allowed * step) / change) + 2):
        remaining *= decay
        v, leader = equivalent - change * number - fading * remaining, max(leader - change, 0.0)
        room += (leader - v) * step
        gained = step * (1.0 - remaining)
        distance += step * gained
        allowed = min(allowed, (room - f.time_gap * v) / (distance + f.time_gap * gained))
    return allowed - c


def stopping(speed: float, braking: float, step: float) -> float:
    """Return the stopping distance of a car that brakes from the next step on [m]."""
    steps = math.floor(speed / (braking * step))
    return step * steps * (speed - braking * step * (steps + 1) / 2)


def speed_to_stop_within(distance: float, braking: float, step: float) -> float:
    """Return the highest speed after this step from which a car can stop within a distance [m/s]."""
    room, change = max(distance, 0.0) / step, braking * step
    steps = math.floor((math.sqrt(1.0 + 8.0 * room / change) - 1.0) / 2.0)
    return (room + change * steps * (steps + 1) / 2.0) / (steps + 1.0)
