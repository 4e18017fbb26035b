"""The jam absorber of the merge: waits before a jam until it has gone, then goes off quickly."""

from typing import ClassVar

import numpy as np
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState, Observed
from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, as_column, namespace

SEEN = 60.0
"""a jam farther away is not yet waited for [m]"""
NOBODY = 99.0
"""gap from which on there is no leader [m]"""
OVERRUN = 50.0
"""[m] beyond `last_position`, where it waits no longer"""


@dataclass(frozen=True, config=STRICT)
class JamAbsorber(Driver):
    """Follows its leader linearly; where that one is caught in a jam, it crawls until there is room ahead.

    While it crawls less arrives at the bottleneck than leaves it, and the jam ahead of it dissolves; those
    behind it then pass at speed. It crawls only within a stretch before the bottleneck, so it must know its
    position along the road; where there is none it only follows. After jam-absorption driving, "slow in, fast
    out": Nishi et al. 2013, Transp. Res. B 50:116-129.
    """

    name: ClassVar[str] = "jam-absorber"
    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True
    observed_memory: ClassVar[tuple[Observed, ...]] = (Observed("it waits for a jam to go", 1.0, ""),)

    jam_speed: NotNegative = 10.0
    """a leader slower than this is caught in a jam [m/s]"""
    crawling_speed: NotNegative = 3.5
    """speed while it waits [m/s]"""
    room: Positive = 22.0
    """gap at which it may go on [m], where the leader is fast enough"""
    going_speed: NotNegative = 8.3
    """what is fast enough [m/s]"""
    first_position: float = -580.0
    """along the road, from where it may begin to wait [m]"""
    last_position: float = -270.0
    """up to where it may begin to wait [m]"""
    gap_gain: NotNegative = 0.25
    """acceleration for each metre of gap too much [1/s2]"""
    speed_gain: NotNegative = 1.2
    """acceleration for each m/s that the leader is faster [1/s]"""
    time_gap: NotNegative = 1.4
    """wanted gap over own speed [s]"""
    standstill_gap: NotNegative = 4.0
    """wanted gap of a standing vehicle [m]"""
    push: NotNegative = 0.0
    """acceleration besides [m/s2]; without a `gap_gain` it so closes up as far as the shield lets it"""

    def initial_memory(self, n: int) -> Memory:
        """Return that nobody waits."""
        return {"waits": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration, and who waits from now on."""
        xp, zero = namespace(state.speed), state.speed * 0.0
        place, gap, ahead = state.route_position, state.leader_gap, state.leader_speed
        within = (place > self.first_position) & (place < self.last_position)
        jam = within & (ahead < self.jam_speed) & (gap < SEEN)
        waits = xp.where(jam, zero + 1.0, memory["waits"])
        gone = ((gap >= self.room) & (ahead >= self.going_speed)) | (gap >= NOBODY)
        too_far = place > self.last_position + OVERRUN
        waits = xp.where(gone | too_far, zero, waits)
        excess = gap - self.standstill_gap - self.time_gap * state.speed
        follow = self.gap_gain * excess + self.speed_gain * (ahead - state.speed) + self.push
        crawl = xp.minimum(self.crawling_speed - state.speed, follow)
        return xp.where(waits > 0.0, crawl, follow), {"waits": waits}

    def memory_features(self, memory: Memory) -> Array:
        """Return whether it waits, shape (n, 1)."""
        return as_column(memory["waits"])
