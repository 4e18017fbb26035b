"""Induction loops on a road: which vehicles pass, when, and at which speed."""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

from unjam.scenarios.scenario import sumo_seed
from unjam.scenarios.user_network import UserNetwork
from unjam.worlds.sumo.inputs import sumo_inputs
from unjam.worlds.sumo.networks import xml_document
from unjam.worlds.sumo.simulation import Simulation


class InductionLoop(NamedTuple):
    """An induction loop at a position along a lane [m]."""

    lane: str
    position: float


class DetectorPassage(NamedTuple):
    """A vehicle that drove over a loop."""

    loop: int
    vehicle: str
    time: float
    """at which its front bumper reached the loop [s]"""
    speed: float
    """mean speed above the loop [m/s]; NaN if it changed lanes before its rear had passed"""


def load_with_loops(
    simulation: Simulation, scenario: UserNetwork, seed: Sequence[int], loops: Sequence[InductionLoop]
) -> None:
    """Load human-only traffic of a road and seed, with induction loops; raise `EpisodeError` if SUMO refuses it."""
    road, _ = scenario.draw_from_seed(seed)
    elements = [
        {"id": loop_name(number), "lane": loop.lane, "pos": loop.position, "period": 3600, "file": "NUL"}
        for number, loop in enumerate(loops)
    ]
    inputs = sumo_inputs(scenario, road)._replace(traffic_xml=xml_document("additional", "inductionLoop", elements))
    simulation.load(inputs, scenario.simulation_step, sumo_seed(seed))


def loop_name(number: int) -> str:
    """Return the name of a loop in SUMO."""
    return f"unjam_loop_{number}"


def passages(simulation: Simulation, loops: Sequence[InductionLoop], steps: int) -> list[DetectorPassage]:
    """Simulate a number of steps, or until no vehicle is expected, and return the passages.

    A vehicle that leaves a loop by changing lanes counts without a speed, as with SUMO's own detectors
    (https://sumo.dlr.de/docs/Simulation/Output/Induction_Loops_Detectors_(E1).html).
    """
    found: dict[tuple[int, str, float], DetectorPassage] = {}
    for _ in range(steps):
        simulation.step()
        for number, loop in enumerate(loops):
            for vehicle, length, entry_time, exit_time, _ in simulation.vehicles_on_loop(loop_name(number)):
                key = number, vehicle, entry_time
                if exit_time > entry_time and key not in found:  # -1 while the vehicle is on the loop
                    has_passed = _has_passed(simulation, vehicle, length, loop)
                    speed = length / (exit_time - entry_time) if has_passed else nan
                    found[key] = DetectorPassage(*key, speed)
        if not simulation.expects_vehicles():
            break
    return list(found.values())


def _has_passed(simulation: Simulation, vehicle: str, length: float, loop: InductionLoop) -> bool:
    """Return whether a vehicle that has just left a loop passed it completely, without a lane change."""
    if vehicle in simulation.arrived_vehicles():
        return True
    if vehicle in simulation.teleporting_vehicles():
        return False
    ((lane, position),) = simulation.lane_positions([vehicle])
    is_same_edge = lane.rpartition("_")[0] == loop.lane.rpartition("_")[0]
    return not is_same_edge or position - length >= loop.position
