"""Drives a vehicle of a running SUMO by a .unjam controller, over TraCI; needs traci and run_controller.py.

    sumo -c my.sumocfg --step-length 0.1 --remote-port 8813 &
    python examples/traci_client.py ring.unjam 8813 VEHICLE

A controller decides at times of its own, so SUMO's step must divide them: with its step of 1 s a controller
of 0.1 s would drive on for ten times as long as its filter allows for. The vehicle's type should have the
car-following model Krauss: SUMO then carries out each command exactly until it is unsafe. The vehicle is told
of its leader and its follower alone: a controller that looks at more, such as its place on a loop or speeds
ahead, is refused. Whoever can reach that port can steer SUMO: do not open it to a network.
"""

import sys
from collections.abc import Iterator
from typing import Any

import traci
from run_controller import Controller, State

LARGEST_GAP = 100.0
"""[m]; where no vehicle is near"""
OBEDIENT = {"Accel": 20.0, "Decel": 20.0, "EmergencyDecel": 20.0, "ApparentDecel": 20.0, "MinGap": 0.5}
"""limits of SUMO's own that are wider than any command; only its check for a safe speed stays"""
LOOK_FARTHER = (
    "pacer jam-absorber cruise jam-ahead adaptive-acc loop_length route_position lap_position merge_proximity"
)
LOOK_FARTHER += " distance_to_merge allowed_speed lane_speeds road_speeds adjacent_lanes penetration_rate"
"""experts and features that need more than `observe` returns, or the ACC of the vehicle"""


def observe(vehicles: Any, name: str) -> State:
    """What the vehicle observes now. The minimum gap of the follower is added to gaps of SUMO."""
    speed, seen = vehicles.getSpeed(name), []
    leader, gap = vehicles.getLeader(name, LARGEST_GAP) or ("", 0.0)
    follower, gap_behind = vehicles.getFollower(name, LARGEST_GAP)
    for other, distance, keeper in ((leader, gap, name), (follower, gap_behind, follower)):
        bumper = distance + vehicles.getMinGap(keeper) if other else LARGEST_GAP
        there = bumper < LARGEST_GAP
        seen += [vehicles.getSpeed(other) if there else speed, min(max(bumper, 0.0), LARGEST_GAP)]
    return State(speed, *seen)


def words(recipe: Any) -> Iterator[str]:
    """All words of a driver's recipe, the names of its experts and features among them."""
    if isinstance(recipe, str):
        yield recipe
    elif isinstance(recipe, dict | list):
        for part in recipe.values() if isinstance(recipe, dict) else recipe:
            yield from words(part)


def drive(sumo: Any, controller: Controller, name: str) -> int:
    """Drive the vehicle from its entry to its exit; return the number of control steps."""
    if more := sorted({*LOOK_FARTHER.split()} & {*words(controller.manifest["driver"])}):
        raise SystemExit(f"the controller looks at more than leader and follower: {', '.join(more)}")
    step, control_steps = sumo.simulation.getDeltaT(), 0
    vehicles, held = sumo.vehicle, round(controller.time_step / step)
    if abs(held * step - controller.time_step) > 1e-9:
        asked = f"it decides every {controller.time_step:g} s: start SUMO with --step-length"
        raise SystemExit(f"SUMO's step of {step:g} s does not fit the controller; {asked} {controller.time_step:g}")
    while name not in vehicles.getIDList():
        if not sumo.simulation.getMinExpectedNumber():
            raise SystemExit(f"no vehicle {name!r} has entered")
        sumo.simulationStep()
    for limit, value in {**OBEDIENT, "Tau": step, "Imperfection": 0.0}.items():
        getattr(vehicles, f"set{limit}")(name, value)
    while name in vehicles.getIDList():
        acceleration = controller.act(*observe(vehicles, name))
        control_steps += 1
        for _ in range(held):
            if name in vehicles.getIDList():
                vehicles.setSpeed(name, max(0.0, vehicles.getSpeed(name) + acceleration * step))
                sumo.simulationStep()
    return control_steps


if __name__ == "__main__":
    file, port, vehicle = sys.argv[1:]
    connection = traci.connect(int(port), host="127.0.0.1")
    print(f"{vehicle}: {drive(connection, Controller(file), vehicle)} control steps")
    connection.close()
