"""Run a .unjam controller with Python and NumPy only; copy this file with plain_experts.py and plain_safety.py.

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
from types import SimpleNamespace
from typing import Any

import numpy as np
from plain_experts import EXPERTS, State, clip, nearness, remember
from plain_safety import Actuator, highest


class Driver:
    """An expert, or a driver plus what a network has learned: its residual is repeated for some control steps."""

    def __init__(self, recipe: dict[str, Any], weights: dict[str, np.ndarray]) -> None:
        self.r, self.memory, self.age, self.held = recipe, SimpleNamespace(), 0, 0.0
        if recipe["kind"] in ("filtered", "history"):
            self.inner = Driver(recipe["driver"], weights)
            self.actuator = Actuator(recipe.get("actuator", {}), recipe["time_step"])
        elif recipe["kind"] == "residual":
            self.expert = Driver(recipe["expert"], weights)
            self.layers = [[weights[part["array"]] for part in layer] for layer in recipe["network"]["layers"]]
        elif recipe["kind"] in EXPERTS:
            self.p = SimpleNamespace(**recipe)
        else:
            raise ValueError(f"a driver of the kind {recipe['kind']} is not read here; read it with unjam")

    def act(self, s: State) -> float:
        """Return the wanted acceleration [m/s2]."""
        if self.r["kind"] in EXPERTS:
            return EXPERTS[self.r["kind"]](self.p, s, self.memory)
        if self.r["kind"] == "filtered":
            wanted = clip(self.inner.act(s), -self.r["action_limit"], self.r["action_limit"])
            self.memory = self.inner.memory
            safety, step = SimpleNamespace(**self.r["safety"]), self.r["time_step"]
            command = min(wanted, highest(safety, s, step, self.actuator))
            self.actuator.apply(command, s.speed)
            return command
        if self.r["kind"] == "history":
            wanted, own = self.inner.act(s), remember(self.memory, s, self.r["time_step"])
            self.memory.features = (*getattr(self.inner.memory, "features", ()), *own)
            return wanted
        limit = self.r["action_limit"]
        expert = clip(self.expert.act(s), -limit, limit)
        self.memory = self.expert.memory
        if self.age % self.r["action_repeat"] == 0:
            self.held = self.r["network"]["authority"] * math.tanh(self.network(s, expert))
        self.age += 1
        return clip(expert + self.held, -limit, limit)

    def network(self, s: State, expert: float) -> float:
        """Return the output of the network before it is bounded."""
        ahead, behind = s.leader_speed - s.speed, s.follower_speed - s.speed
        parts = {
            "local": (s.speed / 10.0, ahead / 5.0, s.leader_gap / 20.0, behind / 5.0, s.follower_gap / 20.0),
            "expert_acceleration": (expert,),
            "expert_memory": getattr(self.memory, "features", ()),
            "loop_length": (s.loop_length / 250.0,),
            "allowed_speed": ((s.allowed_speed - s.speed) / 10.0,),
            "merge_proximity": nearness(s.distance_to_merge),
            "distance_to_merge": (clip(s.distance_to_merge / 1000.0, -1.0, 2.0),),
            "lane_speeds": tuple((speed - s.speed) / 10.0 for speed in s.lane_speeds),
            "road_speeds": tuple((speed - s.speed) / 10.0 for speed in s.road_speeds),
            "adjacent_lanes": (
                *((speed - s.speed) / 5.0 for speed in s.adjacent_speeds),
                *(gap / 20.0 for gap in s.adjacent_gaps),
            ),
            "penetration_rate": (s.penetration_rate,),
            "route_position": (s.route_position / 100.0,),
            "lap_position": (math.cos(lap := 2.0 * math.pi * s.route_position / s.loop_length), math.sin(lap)),
        }
        if unknown := [part for part in self.r["inputs"] if part not in parts]:
            raise ValueError(f"a policy with the input {unknown[0]} is not read here; read it with unjam")
        units = np.array([number for part in self.r["inputs"] for number in parts[part]])
        for weight, bias in self.layers[:-1]:
            units = np.maximum(units @ weight + bias, 0.0)
        weight, bias = self.layers[-1]
        return float(units @ weight[:, 0] + bias[0])


def arrays(part: bytes) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file: the length of a header, the header in JSON, then the numbers."""
    begin = 8 + int.from_bytes(part[:8], "little")
    found = {name: about for name, about in json.loads(part[8:begin]).items() if name != "__metadata__"}
    numbers = {name: part[begin:][slice(*about["data_offsets"])] for name, about in found.items()}
    return {name: np.frombuffer(numbers[name], "<f8").reshape(about["shape"]) for name, about in found.items()}


class Controller:
    """One vehicle's controller: `act` once every `time_step` seconds."""

    def __init__(self, path: str) -> None:
        with zipfile.ZipFile(path) as archive:
            self.manifest = json.loads(archive.read("manifest.json"))
            parts = {name: archive.read(name) for name in self.manifest["sha256"]}
        for name, part in parts.items():
            if hashlib.sha256(part).hexdigest() != self.manifest["sha256"][name]:
                raise ValueError(f"{path}: {name} is damaged")
        self.driver = Driver(self.manifest["driver"], arrays(parts["weights.safetensors"]))
        self.sample = arrays(parts["sample.safetensors"]) if "sample.safetensors" in parts else {}
        self.time_step, action = self.manifest["time_step"], self.manifest["action"]
        self.limit = max(-action["low"], action["high"])

    def act(self, *perceived: Any, **named: Any) -> float:
        """The acceleration to drive with [m/s2], for the fields of `State`."""
        return clip(self.driver.act(State(*perceived, **named)), -self.limit, self.limit)


if __name__ == "__main__":
    controller = Controller(sys.argv[1])
    if not controller.sample:
        sys.exit("it can drive, but has no sample to compare with; `unjam export` records one")
    names = [name for name in State._fields if name in controller.sample]
    recorded = zip(*(controller.sample[name].tolist() for name in (*names, "acceleration")), strict=True)
    off = [abs(controller.act(**dict(zip(names, seen, strict=True))) - told) for *seen, told in recorded]
    print(f"{len(off)} control steps, at most {max(off):.1e} m/s2 from what was recorded")
    sys.exit(int(max(off) > 1e-9))
