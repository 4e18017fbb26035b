"""The noise of many episodes at once: each world's as SUMO's episode of its seed draws it, or quicker."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Array, namespace
from unjam.worlds.closed import NOISE_BLOCK

Numbers = Callable[[NDArray[np.float64]], Array]
"""makes arrays of the kind and precision in which a batch is stepped"""


class Noise(Protocol):
    """Standard normal numbers for W worlds."""

    def of_people(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        ...

    def begin_anew(self) -> None:
        """Drop what is left of a block: CAVs take over."""
        ...

    def of_networks(self, decision: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,), for its network's exploration."""
        ...

    def lasting(self, numbers: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers): always those of its world."""
        ...


class NoiseState(NamedTuple):
    """Where the noise of one world's people is."""

    generator: Mapping[str, Any]
    """state of its bit generator"""
    left: NDArray[np.float64]
    """of the block that was drawn last, the next step at the end, shape (steps, vehicles)"""


class SeededNoise:
    """What SUMO's episodes draw: each world has generators of its own."""

    def __init__(
        self,
        seeds: Sequence[Sequence[np.random.SeedSequence]],
        vehicles: int,
        decisions: tuple[int, int],
        numbers: Numbers,
    ) -> None:
        """Take the seeds of each world, of `Scenario.of_seed`, and how many decisions of how many CAVs."""
        self._people = [np.random.default_rng(noise) for noise, *_ in seeds]
        self._networks = [exploration for _, exploration, *_ in seeds]
        self._drawn = np.empty((len(seeds), NOISE_BLOCK, vehicles))
        self._decisions, self._numbers = decisions, numbers
        self._left: list[Array] = []
        self._exploration: Array = None

    def of_people(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        if not self._left:
            for generator, place in zip(self._people, self._drawn, strict=True):
                generator.standard_normal(out=place)
            block = np.ascontiguousarray(self._drawn.transpose(1, 2, 0))
            self._left = list(self._numbers(block))[::-1]
        return self._left.pop()

    def states(self) -> list[NoiseState]:
        """Return where each world's noise is, NumPy arrays."""
        left = np.array(self._left).reshape(-1, *self._drawn.shape[2:], len(self._people))
        return [
            NoiseState(generator.bit_generator.state, left[:, :, world].copy())
            for world, generator in enumerate(self._people)
        ]

    def go_on(self, states: Sequence[NoiseState]) -> None:
        """Go on from where each world's noise was; all must have as much left."""
        for generator, state in zip(self._people, states, strict=True):
            generator.bit_generator.state = dict(state.generator)
        self._left = list(self._numbers(np.stack([state.left for state in states], 2)))

    def begin_anew(self) -> None:
        """Drop what is left of a block."""
        self._left = []

    def of_networks(self, decision: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,)."""
        if self._exploration is None:
            each = [np.random.default_rng(seed).standard_normal(self._decisions) for seed in self._networks]
            self._exploration = self._numbers(np.stack(each, 2).reshape(len(each[0]), -1))
        return self._exploration[decision]

    def lasting(self, numbers: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers)."""
        if self._exploration is None:
            each = [np.random.default_rng(seed).standard_normal(numbers) for seed in self._networks]
            self._exploration = self._numbers(np.tile(each, (self._decisions[1], 1)))
        return self._exploration


class QuickNoise:
    """One generator for all worlds: other numbers than SUMO's episodes draw, of the same kind."""

    def __init__(
        self, draw: Callable[[tuple[int, ...]], Array], vehicles: int, cavs: int, worlds: int
    ) -> None:
        """Take what draws standard normal numbers of a shape."""
        self._draw, self._people, self._networks = draw, (vehicles, worlds), (cavs * worlds,)
        self._worlds, self._exploration = worlds, cast(Array, None)

    def of_people(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        return self._draw(self._people)

    def begin_anew(self) -> None:
        """Do nothing: nothing is drawn ahead."""

    def of_networks(self, decision: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,)."""
        return self._draw(self._networks)

    def lasting(self, numbers: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers)."""
        if self._exploration is None:
            each = self._draw((self._worlds, numbers))
            self._exploration = namespace(each).tile(each, (self._networks[0] // self._worlds, 1))
        return self._exploration


def noise_of(
    seeds: Sequence[Sequence[np.random.SeedSequence]],
    vehicles: int,
    decisions: tuple[int, int],
    numbers: Numbers,
    draw: Callable[[tuple[int, ...]], Array] | None,
) -> Noise:
    """Return noise as SUMO's episodes draw it; where `draw` is given, quicker. Arguments as of both."""
    if draw is None:
        return SeededNoise(seeds, vehicles, decisions, numbers)
    return QuickNoise(draw, vehicles, decisions[1], len(seeds))
