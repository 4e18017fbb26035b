"""Detectors on a road: who passed which induction loop, when, and how fast."""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

from unjam.scenarios.own_network import OwnNetwork
from unjam.worlds.sumo.files import files_of
from unjam.worlds.sumo.networks import document
from unjam.worlds.sumo.simulation import Simulation


class Loop(NamedTuple):
    """An induction loop in the road."""

    lane: str
    position: float
    """along the lane [m]"""


class Passage(NamedTuple):
    """A vehicle that drove over a loop."""

    loop: int
    """number of the loop"""
    vehicle: str
    time: float
    """when its front bumper came [s]"""
    speed: float
    """its mean while it was above the loop [m/s]; NaN where it left sideways, before its end had passed"""


def load_with_loops(
    simulation: Simulation, scenario: OwnNetwork, seed: Sequence[int], loops: Sequence[Loop]
) -> None:
    """Load the traffic that people alone have on this road and seed in an episode, with loops in the road.

    Raises:
        EpisodeError: SUMO refuses the files.
    """
    road, (_, _, sumo_seed, _) = scenario.of_seed(seed)
    places = [
        {"id": loop_name(number), "lane": loop.lane, "pos": loop.position, "period": 3600, "file": "NUL"}
        for number, loop in enumerate(loops)
    ]
    files = files_of(scenario, road)._replace(traffic=document("additional", "inductionLoop", places))
    simulation.load(files, scenario.simulation_step, int(sumo_seed.generate_state(1)[0]) % 2**31)


def loop_name(number: int) -> str:
    """Return what a loop is called in SUMO."""
    return f"unjam_loop_{number}"


def passages(simulation: Simulation, loops: Sequence[Loop], steps: int) -> list[Passage]:
    """Simulate so many steps, or until nobody is expected any more, and return who passed the loops.

    Who leaves a loop by changing lanes has passed it too, but tells no speed, as with SUMO's own detectors
    (https://sumo.dlr.de/docs/Simulation/Output/Induction_Loops_Detectors_(E1).html).
    """
    found: dict[tuple[int, str, float], Passage] = {}
    for _ in range(steps):
        simulation.step()
        for number, loop in enumerate(loops):
            for vehicle, length, came, left, _ in simulation.on_loop(loop_name(number)):
                if left > came and (number, vehicle, came) not in found:  # it is -1 while it is still there
                    whole = _has_passed(simulation, vehicle, length, loop)
                    speed = length / (left - came) if whole else nan
                    found[number, vehicle, came] = Passage(number, vehicle, came, speed)
        if not simulation.more_expected():
            break
    return list(found.values())


def _has_passed(simulation: Simulation, vehicle: str, length: float, loop: Loop) -> bool:
    """Return whether a vehicle that has just left a loop did so with its end, not sideways."""
    if vehicle in simulation.arrived():
        return True
    if vehicle in simulation.lifted():
        return False
    ((lane, along),) = simulation.lane_places([vehicle])
    same_edge = lane.rpartition("_")[0] == loop.lane.rpartition("_")[0]
    return not same_edge or along - length >= loop.position
