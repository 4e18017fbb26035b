"""Runs a .unjam controller with Python and NumPy alone: copy this file beside your own program.

    controller = Controller("ring.unjam")
    while driving:  # once every controller.time_step seconds, for one vehicle
        acceleration = controller.act(speed, leader_speed, leader_gap, follower_speed, follower_gap)

Run: python examples/run_controller.py ring.unjam    compares it with the sample that was recorded with it
"""

import hashlib
import json
import math
import sys
import zipfile
from collections import deque
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np


class State(NamedTuple):
    """What a vehicle perceives, SI units; gaps are bumper to bumper, 100 m where nobody is."""

    speed: float
    leader_speed: float
    leader_gap: float
    follower_speed: float
    follower_gap: float
    route_position: float = math.nan
    loop_length: float = math.nan


# Experts: the wanted acceleration, for parameters p, state s and memory m.


def clip(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


def mean(p: Any, m: Any, speed: float) -> float:
    """The mean of what was seen so far, over a sliding window."""
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
    command = getattr(m, "command", s.speed if p.first_command == "own-speed" else 0.0)
    room = (s.leader_gap - p.gap_lower) / (p.gap_upper - p.gap_lower)
    target = average + p.catch_up_speed * clip(room, 0.0, 1.0)
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
        return min(following, p.free_gain * (p.set_speed - s.speed))
    before = getattr(m, "acceleration", 0.0)
    m.acceleration = before + min(1.0, p.time_step / p.lag) * (following - before)
    return m.acceleration


def bcm(p: Any, s: State, m: Any) -> float:
    between = (s.leader_speed - s.speed) - (s.speed - s.follower_speed)
    towards = p.desired_speed_gain * (p.desired_speed - s.speed)
    return p.gap_gain * (s.leader_gap - s.follower_gap) + p.speed_gain * between + towards


def ovm(p: Any, s: State, m: Any) -> float:
    share = clip((s.leader_gap - p.stop_gap) / (p.go_gap - p.stop_gap), 0.0, 1.0)
    optimal = p.largest_speed / 2.0 * (1.0 - math.cos(math.pi * share))
    return p.gap_gain * (optimal - s.speed) + p.speed_gain * (s.leader_speed - s.speed)


def pacer(p: Any, s: State, m: Any) -> float:
    if p.varying:
        raise ValueError("pacer: varying is not known here: its paces are unjam's own")
    loop, free = s.loop_length, s.leader_gap
    was = 0.0 if free < p.regathering_gap * loop else getattr(m, "features", (0.0,))[0]
    m.features = (float(free >= p.gathering_gap * loop or was > 0.0),)
    (pace, *rest), place = p.harmonics or (loop / p.lap_time,), 2.0 * math.pi * s.route_position / loop
    for number, (cosine, sine) in enumerate(zip(rest[::2], rest[1::2], strict=True), start=1):
        pace += cosine * math.cos(number * place) + sine * math.sin(number * place)
    pace = max(pace + p.gain * (free - p.wanted_gap * loop), 1.0)
    return ((pace if m.features[0] else p.gathering_speed) - s.speed) / p.time_constant


def constant(p: Any, s: State, m: Any) -> float:
    return p.acceleration


EXPERTS = {"idm": idm, "pi": pi, "follower-stopper": follower_stopper, "acc": acc, "lacc": acc, "bcm": bcm}
EXPERTS |= {"ovm": ovm, "pacer": pacer, "constant": constant}


class Driver:
    """An expert, or a driver plus what a network has learned: its residual is held for some decisions."""

    def __init__(self, recipe: dict[str, Any], weights: dict[str, np.ndarray], prefix: str = "") -> None:
        self.r, self.memory, self.age, self.held = recipe, SimpleNamespace(), 0, 0.0
        if recipe["kind"] == "named":
            self.p = SimpleNamespace(**recipe["parameters"])
            return
        self.expert = Driver(recipe["expert"], weights, f"{prefix}expert.")
        count = sum(f"{prefix}{index}.weight" in weights for index in range(len(weights)))
        self.layers = [[weights[f"{prefix}{i}.{part}"] for part in ("weight", "bias")] for i in range(count)]

    def act(self, s: State) -> float:
        if self.r["kind"] == "named":
            return EXPERTS[self.r["name"]](self.p, s, self.memory)
        limit = self.r["action_limit"]
        expert = clip(self.expert.act(s), -limit, limit)
        self.memory = self.expert.memory
        if self.age % self.r["hold"] == 0:
            self.held = self.r["authority"] * math.tanh(self.network(s, expert))
        self.age += 1
        return clip(expert + self.held, -limit, limit)

    def network(self, s: State, expert: float) -> float:
        ahead, behind = s.leader_speed - s.speed, s.follower_speed - s.speed
        parts = {
            "local": (s.speed / 10.0, ahead / 5.0, s.leader_gap / 20.0, behind / 5.0, s.follower_gap / 20.0),
            "expert_acceleration": (expert,),
            "expert_memory": getattr(self.memory, "features", ()),
            "loop_length": (s.loop_length / 250.0,),
            "route_position": (s.route_position / 100.0,),
            "place": (math.cos(lap := 2.0 * math.pi * s.route_position / s.loop_length), math.sin(lap)),
        }
        units = np.array([number for part in self.r["parts"] for number in parts[part]])
        for weight, bias in self.layers[:-1]:
            units = np.maximum(units @ weight + bias, 0.0)
        weight, bias = self.layers[-1]
        return float(units @ weight[:, 0] + bias[0])


def arrays(part: bytes) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file: the length of a header, the header in JSON, then the numbers."""
    begin = 8 + int.from_bytes(part[:8], "little")
    found = {name: about for name, about in json.loads(part[8:begin]).items() if name != "__metadata__"}
    numbers = {name: part[begin:][slice(*about["data_offsets"])] for name, about in found.items()}
    return {
        name: np.frombuffer(numbers[name], "<f8").reshape(about["shape"]) for name, about in found.items()
    }


class Controller:
    """One vehicle's controller: `act` once every `time_step` seconds."""

    def __init__(self, path: str) -> None:
        with zipfile.ZipFile(path) as archive:
            self.manifest = json.loads(archive.read("manifest.json"))
            parts = {name: archive.read(name) for name in self.manifest["sha256"]}
        for name, part in parts.items():
            if hashlib.sha256(part).hexdigest() != self.manifest["sha256"][name]:
                raise ValueError(f"{path}: {name} is damaged")
        self.sample = arrays(parts["sample.safetensors"])
        self.time_step, self.limit = self.manifest["time_step"], self.manifest["action"]["high"]
        self.driver = Driver(self.manifest["driver"], arrays(parts["weights.safetensors"]))

    def act(self, *perceived: float) -> float:
        """The acceleration to drive with [m/s2], for the fields of `State`."""
        return clip(self.driver.act(State(*perceived)), -self.limit, self.limit)


if __name__ == "__main__":
    controller = Controller(sys.argv[1])
    recorded = zip(*(controller.sample[name] for name in (*State._fields, "acceleration")), strict=True)
    off = [abs(controller.act(*map(float, perceived)) - answer) for *perceived, answer in recorded]
    print(f"{len(off)} decisions, at most {max(off):.1e} m/s2 from what was recorded")
    sys.exit(int(max(off) > 1e-9))
