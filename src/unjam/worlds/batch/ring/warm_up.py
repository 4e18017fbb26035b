"""Rings after their all-human warm-up: it is the same whoever drives afterwards, so each has one."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from unjam.drivers.local_state import LocalState
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.noise import NoiseState
from unjam.worlds.record import Floats

MAX_CACHED_CAVS = 2048
"""CAVs whose rings are kept: some 60 kB each, most of them what the CAV saw in the last minute"""

WarmUpKey = TypeVar("WarmUpKey", bound=Hashable)


class WarmUpState(NamedTuple):
    """One ring as its CAVs are handed over."""

    speed: Floats
    """[m/s], shape (vehicles + 1,), the first again at the end"""
    position: Floats
    """[m], shape (vehicles,)"""
    gap: Floats
    """to the vehicle ahead [m], likewise"""
    has_crashed: bool
    """whether people collided"""
    noise: NoiseState
    history: LocalState | None
    """what the CAVs perceived in the last minute, shape (CAVs, moments); None where that is not remembered"""

    crossing_memory: CrossingMemory | None = None
    """on a figure eight who waits, and who is on the crossing since when; None elsewhere"""

    @property
    def cav_count(self) -> int:
        """How many CAVs' past is kept, one at least."""
        return 1 if self.history is None else len(self.history.speed)


class WarmUpCache(dict[WarmUpKey, WarmUpState]):
    """Rings that were warmed up already; the newest are kept."""

    def get_states(
        self,
        keys: Sequence[WarmUpKey],
        upcoming: Sequence[WarmUpKey],
        warm_up: Callable[[Sequence[WarmUpKey]], Mapping[WarmUpKey, WarmUpState]],
    ) -> list[WarmUpState]:
        """Return each wanted ring.

        Where one must be warmed up, so are those of `is_approaching`: many at once take hardly longer than a few.
        """
        missing = not all(ring in self for ring in keys)
        new = [ring for ring in dict.fromkeys([*keys, *upcoming]) if missing and ring not in self]
        known = {**self, **warm_up(new)} if missing else self
        found = [known[ring] for ring in keys]
        if missing:
            left = sum(begun.cav_count for begun in known.values())
            self.clear()
            for ring, begun in known.items():
                if left <= MAX_CACHED_CAVS:
                    self[ring] = begun
                left -= begun.cav_count
        return found
