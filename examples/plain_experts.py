"""The experts of unjam in plain Python: the commanded acceleration for parameters p, state s and memory m.

A controller needs only the expert to which its residual is added.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple


class State(NamedTuple):
    """What a vehicle observes, SI units; gaps are bumper to bumper, 100 m where no vehicle is."""

    speed: float
    leader_speed: float
    leader_gap: float
    follower_speed: float
    follower_gap: float
    route_position: float = math.nan
    loop_length: float = math.nan
    allowed_speed: float = math.nan
    distance_to_merge: float = math.nan
    lane_speeds: Sequence[float] = ()
    road_speeds: Sequence[float] = ()
    adjacent_gaps: Sequence[float] = ()
    adjacent_speeds: Sequence[float] = ()
    penetration_rate: float = 0.0
    congestion: Sequence[float] = ()


def clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def mean(p: Any, m: Any, speed: float) -> float:
    """Return the mean speed over a sliding window, or over all steps so far."""
    if not hasattr(m, "window"):
        m.window, m.total, m.seen = deque([0.0] * max(1, round(p.window / p.time_step))), 0.0, 0
    m.total, m.seen = m.total + speed - m.window.popleft(), m.seen + 1
    m.window.append(speed)
    return m.total / min(m.seen, len(m.window))


def idm(p: Any, s: State, m: Any) -> float:
    braking = 2.0 * math.sqrt(p.max_acceleration * p.comfortable_deceleration)
    room = s.speed * p.time_headway + s.speed * (s.speed - s.leader_speed) / braking
    pressed = ((p.minimum_gap + max(room, 0.0)) / max(s.leader_gap, 0.01)) ** 2
    return p.max_acceleration * (1.0 - (s.speed / p.desired_speed) ** p.exponent - pressed)


def pi(p: Any, s: State, m: Any) -> float:
    average = mean(p, m, s.speed)
    return toward(average, average, p, s, m)


def pi_from_gap(p: Any, s: State, m: Any) -> float:
    if not hasattr(m, "first"):
        m.first = max((s.leader_gap - p.human_standstill_gap) / p.human_time_headway, 0.0)
    average = mean(p, m, s.speed)
    left = clip(1.0 - (m.seen - 1) * (p.time_step / p.fade_time), 0.0, 1.0)
    return toward(average + left * (m.first - average), average, p, s, m)


def toward(wanted: float, average: float, p: Any, s: State, m: Any) -> float:
    """Return the acceleration of PI with saturation toward a wanted speed; the policy observes the average speed."""
    command = getattr(m, "command", s.speed if p.first_command == "own-speed" else 0.0)
    room = (s.leader_gap - p.gap_lower) / (p.gap_upper - p.gap_lower)
    target = wanted + p.catch_up_speed * clip(room, 0.0, 1.0)
    ahead = 2.0 * (s.leader_speed - s.speed)
    safe = max(ahead, p.safe_gap) if p.safe_gap_rule == "closing" else p.safe_gap
    alpha = clip((s.leader_gap - safe) / 2.0, 0.0, 1.0)
    beta = 1.0 - 0.5 * alpha
    m.command = beta * (alpha * target + (1.0 - alpha) * s.leader_speed) + (1.0 - beta) * command
    m.features = average / 10.0, m.command / 10.0
    return (m.command - s.speed) / max(p.time_constant, p.time_step)


def follower_stopper(p: Any, s: State, m: Any) -> float:
    average = mean(p, m, s.leader_speed)
    desired = average if p.desired_speed is None else p.desired_speed
    closing, borders = min(s.leader_speed - s.speed, 0.0), zip(p.gaps, p.decelerations, strict=True)
    stop, follow, free = (gap + closing**2 / (2.0 * braking) for gap, braking in borders)
    leading = min(s.leader_speed, desired)
    command = leading * clip((s.leader_gap - stop) / (follow - stop), 0.0, 1.0)
    command += (desired - leading) * clip((s.leader_gap - follow) / (free - follow), 0.0, 1.0)
    return (command - s.speed) / max(p.time_constant, p.time_step)


def acc(p: Any, s: State, m: Any) -> float:
    excess = s.leader_gap - p.standstill_gap - p.time_gap * s.speed
    following = p.gap_gain * excess + p.speed_gain * (s.leader_speed - s.speed)
    if not hasattr(p, "lag"):
        return min(following, p.set_speed_gain * (p.set_speed - s.speed))
    before = getattr(m, "acceleration", 0.0)
    m.acceleration = before + min(1.0, p.time_step / p.lag) * (following - before)
    return m.acceleration


def bcm(p: Any, s: State, m: Any) -> float:
    between = (s.leader_speed - s.speed) - (s.speed - s.follower_speed)
    towards = p.desired_speed_gain * (p.desired_speed - s.speed)
    return p.gap_gain * (s.leader_gap - s.follower_gap) + p.speed_gain * between + towards


def ovm(p: Any, s: State, m: Any) -> float:
    share = clip((s.leader_gap - p.stop_gap) / (p.go_gap - p.stop_gap), 0.0, 1.0)
    optimal = p.max_speed / 2.0 * (1.0 - math.cos(math.pi * share))
    return p.gap_gain * (optimal - s.speed) + p.speed_gain * (s.leader_speed - s.speed)


# Parameters of `use_tuned` by length of the lap [m]: harmonics, gap gain, target gap.
TUNED = {
    422.2: ((6.729, -2.092, 1.602, -0.929, 0.851, -0.096, 0.105), 0.051, 0.483),
    449.0: ((7.449, -2.059, 1.966, -0.94, 0.791, -0.028, 0.01), 0.047, 0.509),
    462.5: ((7.973, -1.865, 2.48, -0.422, 0.173, 0.027, 0.063), 0.038, 0.545),
    475.9: ((8.35, -2.057, 3.128, 0.477, 0.086, -0.086, 0.075), 0.04, 0.552),
    489.3: ((9.039, -1.791, 3.513, 1.051, 0.015, 0.024, 0.216), 0.044, 0.581),
}


def pacer(p: Any, s: State, m: Any) -> float:
    loop, free = s.loop_length, s.leader_gap
    if p.use_tuned:
        harmonics, gain, wanted = TUNED[min(TUNED, key=lambda lap: abs(loop - lap))]
        tuned = {"harmonics": harmonics, "gap_gain": gain, "target_gap": wanted}
        p = SimpleNamespace(**{**vars(p), **tuned, "gathering_gap": 0.5, "regathering_gap": 0.45})
    was = 0.0 if free < p.regathering_gap * loop else getattr(m, "features", (0.0,))[0]
    m.features = (float(free >= p.gathering_gap * loop or was > 0.0),)
    (pace, *rest), place = p.harmonics or (loop / p.lap_time,), 2.0 * math.pi * s.route_position / loop
    for number, (cosine, sine) in enumerate(zip(rest[::2], rest[1::2], strict=True), start=1):
        pace += cosine * math.cos(number * place) + sine * math.sin(number * place)
    pace = max(pace + p.gap_gain * (free - p.target_gap * loop), 1.0)
    return ((pace if m.features[0] else p.gathering_speed) - s.speed) / p.time_constant


def jam_absorber(p: Any, s: State, m: Any) -> float:
    place, gap, ahead = s.route_position, s.leader_gap, s.leader_speed
    jam = p.first_position < place < p.last_position and ahead < p.jam_speed and gap < 60.0
    waits = jam or getattr(m, "features", (0.0,))[0] > 0.0
    gone = (gap >= p.release_gap and ahead >= p.release_speed) or gap >= 99.0
    m.features = (float(waits and not gone and not place > p.last_position + 50.0),)
    excess = gap - p.standstill_gap - p.time_gap * s.speed
    follow = p.gap_gain * excess + p.speed_gain * (ahead - s.speed) + p.extra_acceleration
    return min(p.crawl_speed - s.speed, follow) if m.features[0] else follow


def cruise(p: Any, s: State, m: Any) -> float:
    return 100.0


def jam_ahead(p: Any, s: State, m: Any) -> float:
    told = (s.road_speeds if p.all_lanes else s.lane_speeds)[p.first_section : p.last_section + 1]
    ahead = sum(told) / len(told) if told else math.inf
    jammed = ahead < p.jam_speed_ratio * s.allowed_speed
    jammed = jammed and max(s.congestion[p.first_section : p.last_section + 1], default=0.0) >= 0.5
    slow = p.free_speed_ratio is None or ahead < p.free_speed_ratio * s.allowed_speed
    if not told or not (jammed if math.isnan(s.distance_to_merge) else s.distance_to_merge > 0.0 and slow):
        return cruise(p, s, m)
    wanted = ahead + p.speed_margin + p.margin_by_penetration * s.penetration_rate
    cap = min(max(wanted, p.min_speed), s.allowed_speed)
    return max((cap - s.speed) / p.time_constant, -p.max_deceleration)


def adaptive_acc(p: Any, s: State, m: Any) -> float:
    before = getattr(m, "mean", s.speed)
    m.mean = before + (1.0 - math.exp(-p.time_step / p.averaging_time)) * (s.speed - before)
    change, (_, leaves) = s.speed - m.mean, getattr(m, "features", (0.0, 0.0))
    if change > p.jam_front_speed_change:
        leaves = 1.0
    elif change < -p.jam_front_speed_change or m.mean > p.free_speed or m.mean < p.jam_speed:
        leaves = 0.0
    m.features = m.mean / 10.0, leaves
    headway, acceleration, braking = (1.0, 1.0, 0.7) if change < -p.jam_front_speed_change else (1.0, 1.0, 1.0)
    if -p.downstream_distance < s.distance_to_merge < p.upstream_distance:
        headway, acceleration, braking = 0.7, 1.5, 1.0
    if leaves:
        headway, acceleration, braking = 0.5, 2.0, 1.0
    fitting = SimpleNamespace(**vars(p))
    fitting.time_headway, fitting.max_acceleration = (p.time_headway * headway, p.max_acceleration * acceleration)
    fitting.comfortable_deceleration = p.comfortable_deceleration * braking
    fitting.desired_speed = p.desired_speed if math.isnan(s.allowed_speed) else s.allowed_speed
    return idm(fitting, s._replace(leader_gap=s.leader_gap if s.leader_gap < 100.0 else 1e6), m)


def advisory_speed(p: Any, s: State, m: Any) -> float:
    if not p.last_distance < s.distance_to_merge < p.first_distance:
        return cruise(p, s, m)
    return max((p.advised_speed - s.speed) / p.time_constant, -p.max_deceleration)


def smooth_acc(p: Any, s: State, m: Any) -> float:
    before = getattr(m, "mean", s.leader_speed)
    weight = 1.0 - math.exp(-p.time_step / p.averaging_time) if p.averaging_time else 1.0
    m.mean = before + weight * (s.leader_speed - before)
    m.features = (m.mean / 10.0,)
    excess = s.leader_gap - p.standstill_gap - p.time_gap * s.speed
    command = m.mean + p.leader_weight * (s.leader_speed - m.mean)
    command += clip(p.gap_gain * excess, -p.catch_up_speed, p.catch_up_speed)
    return (command - s.speed) / max(p.time_constant, p.time_step)


def constant(p: Any, s: State, m: Any) -> float:
    return p.acceleration


def nearness(way: float) -> tuple[float, ...]:
    """Return piecewise linear weights of 0, 250, 500, 1,000 and 2,000 m before a ramp joins; their sum is one."""
    places, found = (0.0, 250.0, 500.0, 1000.0, 2000.0), [1.0]
    for low, high in pairwise(places):
        share = clip((way - low) / (high - low), 0.0, 1.0)
        found[-1:] = [found[-1] - share, share]
    return tuple(found) if way > 0.0 else (0.0,) * len(places)


def remember(m: SimpleNamespace, s: State, time_step: float) -> tuple[float, ...]:
    """Return the mean and spread of the speed, and the mean gap, over 10, 40 and 160 s, for networks with history."""
    m.watched, m.means = getattr(m, "watched", 0) + 1, getattr(m, "means", [[0.0] * 3 for _ in range(3)])
    found: tuple[float, ...] = ()
    for span, means in zip((10.0, 40.0, 160.0), m.means, strict=True):
        weight = max(1.0 / m.watched, 1.0 - math.exp(-time_step / span))
        for number, now in enumerate((s.speed, s.speed**2, s.leader_gap)):
            means[number] += weight * (now - means[number])
        speed, square, gap = means
        found += speed / 10.0, math.sqrt(max(square - speed * speed, 0.0) + 1e-9) / 2.0, gap / 20.0
    return found


EXPERTS = {"idm": idm, "pi": pi, "follower-stopper": follower_stopper, "acc": acc, "lacc": acc, "bcm": bcm}
EXPERTS |= {"ovm": ovm, "pacer": pacer, "jam-absorber": jam_absorber, "constant": constant}
EXPERTS |= {"advisory-speed": advisory_speed, "smooth-acc": smooth_acc}
EXPERTS |= {"cruise": cruise, "jam-ahead": jam_ahead, "pi-from-gap": pi_from_gap, "adaptive-acc": adaptive_acc}
