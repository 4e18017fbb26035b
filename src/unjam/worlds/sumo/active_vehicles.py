"""Vehicles that enter and leave a road with ends."""

from collections.abc import Callable, Sequence

from unjam.worlds.sumo.simulation import Simulation


class ActiveVehicles:
    """The vehicles on a road with ends, and counts of arrivals, teleports and collisions."""

    def __init__(self) -> None:
        self.is_cav: dict[str, bool] = {}
        """whether each vehicle on the road is a CAV, in order of entry"""
        self.teleported: dict[str, bool] = {}
        """the same for vehicles that SUMO has teleported and not yet reinserted"""
        self.collided = set[str]()
        self.arrivals = self.teleports = 0

    def reset_counts(self) -> None:
        """Forget arrivals, teleports and collisions so far."""
        self.arrivals = self.teleports = 0
        self.collided.clear()

    def update(self, simulation: Simulation, is_cav: Callable[[str], bool]) -> tuple[list[str], Sequence[str]]:
        """Update after a simulation step, and return the names of vehicles that left and of those that entered.

        `is_cav` decides whether a vehicle that has just entered is a CAV.
        """
        entered, arrived = simulation.departed_vehicles(), simulation.arrived_vehicles()
        teleporting = simulation.teleporting_vehicles()
        self.arrivals += len(arrived)
        self.teleports += len(teleporting)
        self.teleported |= {name: self.is_cav[name] for name in teleporting if name in self.is_cav}
        left = [*arrived, *teleporting]
        for name in left:
            self.is_cav.pop(name, None)
        for name in arrived:  # SUMO may teleport a vehicle to the end of its route
            self.teleported.pop(name, None)
        for name in entered:
            self.is_cav[name] = is_cav(name)
        for name in filter(self.teleported.__contains__, simulation.reinserted_vehicles()):
            self.is_cav[name] = self.teleported.pop(name)
        return left, entered

    def add_collision(self, colliding: Sequence[str], simulation: Simulation) -> None:
        """Count a collision in the last step; vehicles that SUMO removes for it are teleports, not arrivals."""
        self.collided.update(colliding)
        removed = set(colliding).intersection(simulation.arrived_vehicles())
        removed -= set(simulation.teleporting_vehicles())  # one that is teleported to its end has arrived
        self.arrivals -= len(removed)
        self.teleports += len(removed)
