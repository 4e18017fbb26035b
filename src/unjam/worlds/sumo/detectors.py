"""Detectors on a road: who passed which induction loop, when, and how fast."""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

from unjam.scenarios.user_network import UserNetwork
from unjam.worlds.sumo.inputs import sumo_inputs, sumo_random_seed
from unjam.worlds.sumo.networks import xml_document
from unjam.worlds.sumo.simulation import Simulation


class InductionLoop(NamedTuple):
    """An induction loop in the road."""

    lane: str
    position: float
    """along the lane [m]"""


class DetectorPassage(NamedTuple):
    """A vehicle that drove over a loop."""

    loop: int
    """number of the loop"""
    vehicle: str
    time: float
    """when its front bumper came [s]"""
    speed: float
    """its mean while it was above the loop [m/s]; NaN where it left sideways, before its end had passed"""


def load_with_loops(
    simulation: Simulation, scenario: UserNetwork, seed: Sequence[int], loops: Sequence[InductionLoop]
) -> None:
    """Load the traffic that people alone have on this road and seed in an episode, with loops in the road.

    Raises:
        EpisodeError: SUMO refuses the files.
    """
    road, (_, _, sumo_seed, _) = scenario.draw_from_seed(seed)
    places = [
        {"id": loop_name(number), "lane": loop.lane, "pos": loop.position, "period": 3600, "file": "NUL"}
        for number, loop in enumerate(loops)
    ]
    files = sumo_inputs(scenario, road)._replace(traffic_xml=xml_document("additional", "inductionLoop", places))
    simulation.load(files, scenario.simulation_step, sumo_random_seed(sumo_seed))


def loop_name(number: int) -> str:
    """Return what a loop is called in SUMO."""
    return f"unjam_loop_{number}"


def passages(simulation: Simulation, loops: Sequence[InductionLoop], steps: int) -> list[DetectorPassage]:
    """Simulate so many steps, or until nobody is expected any more, and return who passed the loops.

    Who leaves a loop by changing lanes has passed it too, but tells no speed, as with SUMO's own detectors
    (https://sumo.dlr.de/docs/Simulation/Output/Induction_Loops_Detectors_(E1).html).
    """
    found: dict[tuple[int, str, float], DetectorPassage] = {}
    for _ in range(steps):
        simulation.step()
        for number, loop in enumerate(loops):
            for vehicle, length, came, left, _ in simulation.vehicles_on_loop(loop_name(number)):
                if left > came and (number, vehicle, came) not in found:  # it is -1 while it is still there
                    whole = _has_passed(simulation, vehicle, length, loop)
                    speed = length / (left - came) if whole else nan
                    found[number, vehicle, came] = DetectorPassage(number, vehicle, came, speed)
        if not simulation.expects_vehicles():
            break
    return list(found.values())


def _has_passed(simulation: Simulation, vehicle: str, length: float, loop: InductionLoop) -> bool:
    """Return whether a vehicle that has just left a loop did so with its end, not sideways."""
    if vehicle in simulation.arrived_vehicles():
        return True
    if vehicle in simulation.teleporting_vehicles():
        return False
    ((lane, along),) = simulation.lane_positions([vehicle])
    same_edge = lane.rpartition("_")[0] == loop.lane.rpartition("_")[0]
    return not same_edge or along - length >= loop.position
