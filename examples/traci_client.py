"""Drive a vehicle of a running SUMO by a .unjam controller over TraCI; needs traci and run_controller.py.

    sumo -c my.sumocfg --step-length 0.1 --remote-port 8813 &
    python examples/traci_client.py ring.unjam 8813 VEHICLE

The control step of the controller must be a multiple of the step of SUMO: with steps of 1 s, each command of a
controller with a control step of 0.1 s would last ten times as long as its filter assumes. The type of the vehicle
should have the car-following model Krauss: SUMO then carries out each command exactly unless it is unsafe. The
controller observes the leader and the follower only; controllers that need more, such as the position on a loop or
speeds ahead, are refused. All programs that reach the port can control SUMO: do not open it to a network.
"""

import sys
from collections.abc import Iterator
from typing import Any

import traci
from run_controller import Controller, State

LARGEST_GAP = 100.0
"""gap where no vehicle is near [m]"""
OBEDIENT = {"Accel": 20.0, "Decel": 20.0, "EmergencyDecel": 20.0, "ApparentDecel": 20.0, "MinGap": 0.5}
"""limits of SUMO that are wider than any command; only its check for a safe speed remains"""
LOOK_FARTHER = (
    "pacer jam-absorber cruise jam-ahead adaptive-acc loop_length route_position lap_position merge_proximity"
)
LOOK_FARTHER += " distance_to_merge allowed_speed lane_speeds road_speeds adjacent_lanes penetration_rate"
"""experts and features that need more than `observe` returns, or the ACC of the vehicle"""


def observe(vehicles: Any, name: str) -> State:
    """Return what the vehicle observes; gaps of SUMO do not contain the minimum gap of the following vehicle."""
    speed, seen = vehicles.getSpeed(name), []
    leader, gap = vehicles.getLeader(name, LARGEST_GAP) or ("", 0.0)
    follower, gap_behind = vehicles.getFollower(name, LARGEST_GAP)
    for other, distance, keeper in ((leader, gap, name), (follower, gap_behind, follower)):
        bumper = distance + vehicles.getMinGap(keeper) if other else LARGEST_GAP
        there = bumper < LARGEST_GAP
        seen += [vehicles.getSpeed(other) if there else speed, min(max(bumper, 0.0), LARGEST_GAP)]
    return State(speed, *seen)


def words(recipe: Any) -> Iterator[str]:
    """Yield all texts of the recipe of a driver, including the names of its experts and features."""
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
