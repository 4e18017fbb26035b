"""How far a vehicle drives until it stands, step by step as the simulator moves it."""

from unjam.physics.arrays import Array, at_least, namespace, square_root


def stopping_distance(speed: Array, braking: float, step: float) -> Array:
    """Return how far a vehicle drives that brakes with `braking` from the next step on [m].

    With v_j = max(0, v - j b h) after j steps of length h that is h (v_1 + v_2 + ...), of which the n = floor
    (v / (b h)) first are not zero: h (n v - b h n (n + 1) / 2). It grows with v, and is at least
    v^2 / (2 b) - v h / 2, by at most b h^2 / 8 more.

    Shapes: any. Units: m/s, m/s2, s.
    Source: SUMO's Euler update, https://sumo.dlr.de/docs/Simulation/Basic_Definition.html
    """
    change = braking * step
    steps = namespace(speed).floor(speed / change)
    return step * steps * (speed - change * (steps + 1.0) / 2.0)


def speed_to_stop_within(distance: Array, braking: float, step: float) -> Array:
    """Return the highest speed after this step from which a vehicle still stands within `distance` [m/s].

    It drives one step at the answer v and then brakes: v h + `stopping_distance`(v) = `distance`, which is
    piecewise linear in v; n is the number of whole steps of braking. Zero where the distance is not positive.

    Shapes: any. Units: m, m/s2, s.
    """
    change = braking * step
    room = at_least(distance, 0.0) / step
    steps = namespace(room).floor((square_root(1.0 + 8.0 * room / change) - 1.0) / 2.0)
    return (room + change * steps * (steps + 1.0) / 2.0) / (steps + 1.0)
