"""What a world is: where a driver drives. The simulator, the virtual environment, a recording, a mock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from unjam.drivers.command import Command, Limits, accelerations
from unjam.drivers.local_state import LocalState
from unjam.physics.arrays import Array
from unjam.tree import Arrays

Recorded = TypeVar("Recorded", covariant=True)

OnProgress = Callable[[int], None]
"""called now and then with how many decisions have been made"""


@dataclass(frozen=True)
class Driven:
    """What a driver decided in a world, decision by decision."""

    decisions: list[tuple[Array, Array, Array]] = field(default_factory=list)
    """the expert's share, the residual, and what the network saw; nothing where there is no network"""
    last_observation: Array | None = None
    """what the network would have seen at the end"""
    memories: list[Arrays] = field(default_factory=list)
    """what the expert remembered before the first decision of each CAV by itself, in order of entry"""
    hold: int = 1
    """decisions for which one residual was held"""


class World(Protocol[Recorded]):
    """Moves n CAVs as they are told, and says what they perceive; `unjam.worlds.drive` alone calls it."""

    limits: Limits
    """within which accelerations are kept"""
    single: bool
    """whether its only CAV perceives and is driven in plain numbers instead of arrays of one row"""
    entered: int
    """CAVs that the driver was given so far"""

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> LocalState | None:
        """Begin, and hand the CAVs over, unless they stay human (`controlled` false).

        Returns:
            What the CAVs perceived before, for drivers that remember it: arrays of shape (CAVs, moments),
            oldest first; None where there is nothing to remember.
        """
        ...

    @property
    def rows(self) -> int:
        """CAVs on the road now: the rows of what drivers are given and answer."""
        ...

    @property
    def kept(self) -> Sequence[int] | None:
        """Rows before the last decision that are still there, newcomers being behind them; None: the same."""
        ...

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to decide."""
        ...

    def perceive(self) -> LocalState:
        """Return what the CAVs perceive now: arrays of shape (CAVs,), or plain numbers of a single one."""
        ...

    def advance(self, command: Command | None) -> None:
        """Carry out one decision of every CAV; None: they stay human.

        Raises:
            InputError: a command cannot be carried out: it is not finite, or there are not as many as CAVs.
        """
        ...

    def noise(self) -> Array:
        """Return standard normal noise for one look of a network: shape (CAVs,), or a plain number."""
        ...

    def record(self, driven: Driven) -> Recorded:
        """Return what happened, with what the driver decided."""
        ...


class RecordedWorld:
    """States that were recorded go by, whatever a driver does: what would it do, what does it remember?"""

    single = False
    kept = None

    def __init__(self, states: LocalState, limits: Limits) -> None:
        """Take the states of n CAVs at T moments, arrays of shape (T, n)."""
        self.states, self.limits = states, limits
        self.rows = self.entered = states.speed.shape[1]
        self._names = [f"row {number}" for number in range(self.rows)]
        self._answers: list[list[float]] = []

    def start(self, controlled: bool, on_progress: OnProgress | None = None) -> None:
        """Begin at the first moment; nothing was before."""
        self._answers = []

    @property
    def ended(self) -> bool:
        """Whether all moments have gone by."""
        return len(self._answers) == len(self.states.speed)

    def perceive(self) -> LocalState:
        """Return what was perceived at this moment; after the last one, at the last."""
        moment = min(len(self._answers), len(self.states.speed) - 1)
        return self.states.at(moment)

    def advance(self, command: Command | None) -> None:
        """Note what was asked for, and go on to the next moment."""
        self._answers.append(accelerations(command, self.limits, self._names, len(self._answers)))

    def noise(self) -> Any:
        """Return none: nobody explores here."""
        return np.zeros(self.rows)

    def record(self, driven: Driven) -> NDArray[np.float64]:
        """Return what was asked for, within the limits [m/s2], shape (T, n)."""
        return np.array(self._answers)
