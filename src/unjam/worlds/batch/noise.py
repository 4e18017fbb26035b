"""The noise of many episodes at once: each world's as SUMO's episode of its seed draws it, or quicker."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Array, namespace
from unjam.worlds.closed_road import NOISE_BLOCK_STEPS

ArrayFactory = Callable[[NDArray[np.float64]], Array]
"""makes arrays of the kind and precision in which a batch is stepped"""


class BatchNoise(Protocol):
    """Standard normal numbers for W worlds."""

    def human_noise(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        ...

    def drop_block(self) -> None:
        """Drop what is left of a block: CAVs take over."""
        ...

    def exploration_noise(self, step_index: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,), for its network's exploration."""
        ...

    def episode_noise(self, count: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers): always those of its world."""
        ...


class NoiseState(NamedTuple):
    """Where the noise of one world's people is."""

    generator: Mapping[str, Any]
    """state of its bit generator"""
    remaining_block: NDArray[np.float64]
    """of the block that was drawn last, the next step at the end, shape (steps, vehicles)"""


class SeededNoise:
    """What SUMO's episodes draw: each world has generators of its own."""

    def __init__(
        self,
        seeds: Sequence[Sequence[np.random.SeedSequence]],
        vehicle_count: int,
        exploration_shape: tuple[int, int],
        to_array: ArrayFactory,
    ) -> None:
        """Take the seeds of each world, of `Scenario.draw_from_seed`, and how many decisions of how many CAVs."""
        self._human_generators = [np.random.default_rng(noise) for noise, *_ in seeds]
        self._exploration_seeds = [exploration for _, exploration, *_ in seeds]
        self._block = np.empty((len(seeds), NOISE_BLOCK_STEPS, vehicle_count))
        self._exploration_shape, self._to_array = exploration_shape, to_array
        self._remaining_steps: list[Array] = []
        self._exploration: Array = None

    def human_noise(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        if not self._remaining_steps:
            for generator, place in zip(self._human_generators, self._block, strict=True):
                generator.standard_normal(out=place)
            block = np.ascontiguousarray(self._block.transpose(1, 2, 0))
            self._remaining_steps = list(self._to_array(block))[::-1]
        return self._remaining_steps.pop()

    def states(self) -> list[NoiseState]:
        """Return where each world's noise is, NumPy arrays."""
        left = np.array(self._remaining_steps).reshape(-1, *self._block.shape[2:], len(self._human_generators))
        return [
            NoiseState(generator.bit_generator.state, left[:, :, world].copy())
            for world, generator in enumerate(self._human_generators)
        ]

    def restore(self, states: Sequence[NoiseState]) -> None:
        """Go on from where each world's noise was; all must have as much left."""
        for generator, state in zip(self._human_generators, states, strict=True):
            generator.bit_generator.state = dict(state.generator)
        self._remaining_steps = list(self._to_array(np.stack([state.remaining_block for state in states], 2)))

    def drop_block(self) -> None:
        """Drop what is left of a block."""
        self._remaining_steps = []

    def exploration_noise(self, step_index: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,)."""
        if self._exploration is None:
            each = [
                np.random.default_rng(seed).standard_normal(self._exploration_shape) for seed in self._exploration_seeds
            ]
            self._exploration = self._to_array(np.stack(each, 2).reshape(len(each[0]), -1))
        return self._exploration[step_index]

    def episode_noise(self, count: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers)."""
        if self._exploration is None:
            each = [np.random.default_rng(seed).standard_normal(count) for seed in self._exploration_seeds]
            self._exploration = self._to_array(np.tile(each, (self._exploration_shape[1], 1)))
        return self._exploration


class QuickNoise:
    """One generator for all worlds: other numbers than SUMO's episodes draw, of the same kind."""

    def __init__(
        self, draw: Callable[[tuple[int, ...]], Array], vehicle_count: int, cav_count: int, world_count: int
    ) -> None:
        """Take what draws standard normal numbers of a shape."""
        self._draw, self._human_shape, self._exploration_shape = (
            draw,
            (vehicle_count, world_count),
            (cav_count * world_count,),
        )
        self._world_count, self._exploration = world_count, cast(Array, None)

    def human_noise(self) -> Array:
        """Return a number for each vehicle in this step, shape (vehicles, W)."""
        return self._draw(self._human_shape)

    def drop_block(self) -> None:
        """Do nothing: nothing is drawn ahead."""

    def exploration_noise(self, step_index: int) -> Array:
        """Return a number for each CAV, shape (CAVs * W,)."""
        return self._draw(self._exploration_shape)

    def episode_noise(self, count: int) -> Array:
        """Return so many numbers for each CAV, shape (CAVs * W, numbers)."""
        if self._exploration is None:
            each = self._draw((self._world_count, count))
            self._exploration = namespace(each).tile(each, (self._exploration_shape[0] // self._world_count, 1))
        return self._exploration


def make_noise(
    seeds: Sequence[Sequence[np.random.SeedSequence]],
    vehicle_count: int,
    exploration_shape: tuple[int, int],
    to_array: ArrayFactory,
    draw: Callable[[tuple[int, ...]], Array] | None,
) -> BatchNoise:
    """Return noise as SUMO's episodes draw it; where `draw` is given, quicker. Arguments as of both."""
    if draw is None:
        return SeededNoise(seeds, vehicle_count, exploration_shape, to_array)
    return QuickNoise(draw, vehicle_count, exploration_shape[1], len(seeds))
