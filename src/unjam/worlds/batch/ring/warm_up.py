"""States of rings after their all-human warm-up, which the driver of the CAVs does not influence."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import NamedTuple, TypeVar

from unjam.drivers.local_state import LocalState
from unjam.worlds.batch.figure_eight.crossing import CrossingMemory
from unjam.worlds.batch.noise import NoiseState
from unjam.worlds.record import Floats

MAX_CACHED_CAVS = 2048
"""CAVs on cached rings: some 60 kB each, mostly the history of the CAV's last minute"""

WarmUpKey = TypeVar("WarmUpKey", bound=Hashable)
WarmUpFunction = Callable[[Sequence[WarmUpKey]], Mapping[WarmUpKey, "WarmUpState"]]


class WarmUpState(NamedTuple):
    """State of one ring at the moment when its CAVs are handed over."""

    speed: Floats
    """speeds [m/s], shape (vehicles + 1,), with the first one again at the end"""
    position: Floats
    """positions [m], shape (vehicles,)"""
    gap: Floats
    """gaps to the vehicle ahead [m], shape (vehicles,)"""
    has_crashed: bool
    """whether human drivers collided"""
    noise: NoiseState
    history: LocalState | None
    """what the CAVs observed in the last minute, shape (CAVs, moments); None if it is not remembered"""
    crossing_memory: CrossingMemory | None = None
    """memory of the crossing of a figure eight; None on rings"""


class WarmUpCache(dict[WarmUpKey, WarmUpState]):
    """The newest warm-up states."""

    def get_states(
        self, keys: Sequence[WarmUpKey], upcoming: Sequence[WarmUpKey], warm_up: WarmUpFunction[WarmUpKey]
    ) -> list[WarmUpState]:
        """Return the state of each key; `warm_up` simulates missing ones, together with those of `upcoming`."""
        if all(key in self for key in keys):
            return [self[key] for key in keys]
        known = {**self, **warm_up([key for key in dict.fromkeys([*keys, *upcoming]) if key not in self])}
        counts = [1 if state.history is None else len(state.history.speed) for state in known.values()]
        remaining_cavs = sum(counts)
        self.clear()
        for (key, state), count in zip(known.items(), counts, strict=True):
            if remaining_cavs <= MAX_CACHED_CAVS:
                self[key] = state
            remaining_cavs -= count
        return [known[key] for key in keys]
