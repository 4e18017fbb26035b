"""How a vehicle moves in one step: exactly as SUMO moves it."""

from unjam.physics.arrays import Array, at_least


def next_speed(speed: Array, acceleration: Array, time_step: float) -> Array:
    """Return the speed one step later, v' = max(0, v + a dt): vehicles do not drive backwards.

    Shapes: any, broadcast together. Units: m/s, m/s2, s.
    Source: SUMO's Euler update, https://sumo.dlr.de/docs/Simulation/Basic_Definition.html
    """
    return at_least(speed + acceleration * time_step, 0.0)


def next_position(position: Array, new_speed: Array, time_step: float) -> Array:
    """Return the position one step later, x' = x + v' dt, with the speed *after* the step.

    Shapes: any, broadcast together. Units: m, m/s, s.
    Source: SUMO's Euler update, https://sumo.dlr.de/docs/Simulation/Basic_Definition.html
    """
    return position + new_speed * time_step


def distance_driven(speed: Array, new_speed: Array, time_step: float, steps: int) -> Array:
    """Return how far a vehicle gets in `steps` steps in which its speed changes evenly to `new_speed`.

    Each step is the Euler step of `next_position`, so that one step gives v' dt.
    Shapes: any, broadcast together. Units: m/s, s; the answer in m.
    """
    return time_step * (steps * speed + (steps + 1) / 2 * (new_speed - speed))


def gap_on_loop(position: Array, leader_position: Array, loop_length: Array, leader_length: float) -> Array:
    """Return the bumper-to-bumper gap to the leader on a closed road.

    Positions are those of front bumpers along the road; they may run past the loop's length.
    Shapes: any, broadcast together. Units: m.
    """
    return (leader_position - position) % loop_length - leader_length
