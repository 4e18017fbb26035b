"""Motion of a vehicle in one step and until standstill, exactly as in SUMO's Euler update.

Arguments have any shapes, which broadcast together; units are m, s, m/s and m/s2.
Source: https://sumo.dlr.de/docs/Simulation/Basic_Definition.html
"""

from unjam.physics.arrays import Array, clamp_min, namespace, square_root

HALTING_SPEED = 0.1
"""speed below which SUMO counts a vehicle as standing [m/s]"""


def next_speed(speed: Array, acceleration: Array, time_step: float) -> Array:
    """Return the speed after a step, v' = max(0, v + a dt); vehicles do not drive backwards."""
    return clamp_min(speed + acceleration * time_step, 0.0)


def next_position(position: Array, new_speed: Array, time_step: float) -> Array:
    """Return the position after a step, x' = x + v' dt, with the speed *after* the step."""
    return position + new_speed * time_step


def distance_driven(speed: Array, new_speed: Array, time_step: float, steps: int) -> Array:
    """Return the distance driven in `steps` steps in which the speed changes linearly; one step gives v' dt."""
    return time_step * (steps * speed + (steps + 1) / 2 * (new_speed - speed))


def gap_on_loop(position: Array, leader_position: Array, loop_length: Array, leader_length: float) -> Array:
    """Return the bumper-to-bumper gap on a closed road from positions of front bumpers, which may exceed its length."""
    return (leader_position - position) % loop_length - leader_length


def stopping_distance(speed: Array, braking: Array, time_step: float) -> Array:
    """Return the distance that a vehicle drives if it brakes with `braking` from the next step on [m].

    With v_j = max(0, v - j b h) after j steps of length h, the distance is h (v_1 + v_2 + ...). Its first
    n = floor(v / (b h)) terms are not zero, so that the sum is h (n v - b h n (n + 1) / 2).
    """
    change = braking * time_step
    steps = namespace(speed).floor(speed / change)
    return time_step * steps * (speed - change * (steps + 1.0) / 2.0)


def max_speed_to_stop(distance: Array, braking: float, time_step: float) -> Array:
    """Return the highest speed after this step from which a vehicle still stops within `distance` [m/s].

    The speed v solves v h + `stopping_distance`(v) = `distance`, which is piecewise linear in v. It is at least zero.
    """
    change = braking * time_step
    room = clamp_min(distance, 0.0) / time_step
    steps = namespace(room).floor((square_root(1.0 + 8.0 * room / change) - 1.0) / 2.0)
    return (room + change * steps * (steps + 1.0) / 2.0) / (steps + 1.0)
