"""Upper limits of vehicles' speeds in SUMO, from several sources at once: set-speed caps of CAVs, and speed limits."""

from collections.abc import Hashable
from math import inf

from unjam.worlds.sumo.simulation import Simulation


class SpeedCaps:
    """The caps of all vehicles; a vehicle without one has its own maximum speed."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._caps: dict[str, dict[Hashable, float]] = {}
        self.own_max_speeds: dict[str, float] = {}
        """maximum speeds of the vehicles that have a cap, without it [m/s]"""

    def capped(self, source: Hashable) -> list[str]:
        """Return the vehicles that have a cap from a source; some of them may have left the road."""
        return [name for name, caps in self._caps.items() if source in caps]

    def set(self, name: str, source: Hashable, cap: float) -> None:
        """Set the cap of a vehicle on the road from one source [m/s]; infinite: none."""
        caps = self._caps.get(name)
        if caps is None:
            if cap == inf:
                return
            caps = self._caps[name] = {}
            self.own_max_speeds[name] = self._simulation.max_speed(name)
        if cap < inf:
            caps[source] = cap
        elif caps.pop(source, None) is None:
            return
        self._simulation.set_max_speed(name, min(self.own_max_speeds[name], *caps.values(), inf))
        if not caps:
            self.forget(name)

    def forget(self, name: str) -> None:
        """Forget a vehicle that has no cap, or has left the road."""
        self._caps.pop(name, None)
        self.own_max_speeds.pop(name, None)
