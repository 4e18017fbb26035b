"""The pacer of the figure eight: leads all others in one queue that never meets its own tail."""

from math import pi
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState, Observed
from unjam.parameters import STRICT, NotNegative, Positive
from unjam.physics.arrays import Array, as_column, namespace

Harmonics = tuple[float, ...]

TUNED: dict[float, Harmonics] = {
    422.2: (7.88, -1.09, 1.26, -1.46, 2.5),
    449.0: (8.22, -0.81, 2.37, -1.75, 1.46),
    462.5: (8.51, -1.8, 1.96, -1.31, 0.86),
    475.9: (8.7, -1.83, 1.96, -1.35, 0.95),
    489.3: (8.93, -1.86, 1.96, -1.4, 1.05),
}
"""pace over the lap for each length of a lap [m]: mean and harmonics as in `Pacer.harmonics` [m/s].

Of the figure eight with radii 30, 32, 33, 34 and 35 m, found by results/experts/tune_pacer.py;
at 34 m one between those of its neighbours, which holds on more seeds than what the search found there.
"""


@dataclass(frozen=True, config=STRICT)
class Pacer(Driver):
    """Waits until all have gathered behind it, then leads them round at a pace that they can keep together.

    On the figure eight a queue that is longer than half a lap meets its own tail at the crossing. Driven
    slowly at first, the CAV collects everybody into one queue; then it drives a lap in `lap_time`, or at a
    pace that varies over the lap. It must know where it is on the road.
    """

    plain_numbers: ClassVar[bool] = True
    tensors: ClassVar[bool] = True
    needs_loop: ClassVar[bool] = True
    observed_memory: ClassVar[tuple[Observed, ...]] = (Observed("all have gathered", 1.0, ""),)

    lap_time: Positive = 69.0
    """time for a lap [s]: 6.5 m/s at a radius of 32 m, 7.1 m/s at 35 m"""
    harmonics: Annotated[Harmonics, Field(max_length=9)] = ()
    """(V, a1, b1, a2, b2, ...) [m/s] instead of `lap_time`: pace V + a1 cos x + b1 sin x + a2 cos 2x + ...,
    where x is the place on the lap, 0 to 2 pi from its start"""
    varying: bool = False
    """whether to use, instead of `lap_time`, harmonics tuned for the figure eight of the nearest radius"""
    gathering_speed: NotNegative = 2.0
    """speed while the others gather behind [m/s]"""
    gathering_gap: Annotated[float, Field(ge=0, lt=1)] = 0.4
    """share of the lap that must be free ahead before the pace begins"""
    time_constant: Positive = 0.1
    """time over which the wanted speed is reached [s]"""

    def initial_memory(self, n: int) -> Memory:
        """Return that nobody has gathered yet."""
        return {"gathered": np.zeros(n)}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the acceleration towards the pace, and whether all have gathered by now."""
        xp = namespace(state.speed)
        free = state.leader_gap - self.gathering_gap * state.loop_length
        gathered = xp.where(free >= 0.0, free * 0.0 + 1.0, memory["gathered"])
        wanted = xp.where(gathered > 0.0, self._pace(state), free * 0.0 + self.gathering_speed)
        return (wanted - state.speed) / self.time_constant, {"gathered": gathered}

    def _pace(self, state: LocalState) -> Array:
        loop = state.loop_length
        if self.varying:
            xp = namespace(loop)
            pace, nearest = loop * 0.0, loop * 0.0 + float("inf")
            for lap, harmonics in TUNED.items():
                closer = abs(loop - lap) < nearest
                pace = xp.where(closer, _at(state, harmonics), pace)
                nearest = xp.where(closer, abs(loop - lap), nearest)
            return pace
        return _at(state, self.harmonics) if self.harmonics else loop / self.lap_time

    def memory_features(self, memory: Memory) -> Array:
        """Return whether all have gathered, shape (n, 1)."""
        return as_column(memory["gathered"])


def _at(state: LocalState, harmonics: Harmonics) -> Array:
    """Return the pace where the vehicles are."""
    xp = namespace(state.speed)
    mean, *rest = harmonics
    place = 2.0 * pi * state.route_position / state.loop_length
    pace = place * 0.0 + mean
    for number, (cosine, sine) in enumerate(zip(rest[::2], rest[1::2], strict=True), start=1):
        pace = pace + cosine * xp.cos(number * place) + sine * xp.sin(number * place)
    return pace
