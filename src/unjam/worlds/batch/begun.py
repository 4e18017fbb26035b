"""Rings after their all-human warm-up: it is the same whoever drives afterwards, so each has one."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from unjam.drivers.local_state import LocalState
from unjam.worlds.batch.crossing import Memory
from unjam.worlds.batch.noise import NoiseState
from unjam.worlds.record import Floats

MOST_KEPT = 2048
"""CAVs whose rings are kept: some 60 kB each, most of them what the CAV saw in the last minute"""

Key = TypeVar("Key", bound=Hashable)


class Begun(NamedTuple):
    """One ring as its CAVs are handed over."""

    speed: Floats
    """[m/s], shape (vehicles + 1,), the first again at the end"""
    position: Floats
    """[m], shape (vehicles,)"""
    gap: Floats
    """to the vehicle ahead [m], likewise"""
    crashed: bool
    """whether people collided"""
    noise: NoiseState
    seen: LocalState | None
    """what the CAVs perceived in the last minute, shape (CAVs, moments); None where that is not remembered"""

    waits: Memory | None = None
    """on a figure eight who waits, and who is on the crossing since when; None elsewhere"""

    @property
    def cavs(self) -> int:
        """How many CAVs' past is kept, one at least."""
        return 1 if self.seen is None else len(self.seen.speed)


class BegunRings(dict[Key, Begun]):
    """Rings that were warmed up already; the newest are kept."""

    def of(
        self,
        wanted: Sequence[Key],
        coming: Sequence[Key],
        warm_up: Callable[[Sequence[Key]], Mapping[Key, Begun]],
    ) -> list[Begun]:
        """Return each wanted ring.

        Where one must be warmed up, so are those of `coming`: many at once take hardly longer than a few.
        """
        missing = not all(ring in self for ring in wanted)
        new = [ring for ring in dict.fromkeys([*wanted, *coming]) if missing and ring not in self]
        known = {**self, **warm_up(new)} if missing else self
        found = [known[ring] for ring in wanted]
        if missing:
            left = sum(begun.cavs for begun in known.values())
            self.clear()
            for ring, begun in known.items():
                if left <= MOST_KEPT:
                    self[ring] = begun
                left -= begun.cavs
        return found
