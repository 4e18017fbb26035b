"""Random numbers of many episodes at once, which equal those of SUMO's episodes, or are drawn faster."""

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from unjam.physics.arrays import Array, Floats, namespace
from unjam.worlds.ordered_road import NOISE_BLOCK_STEPS

ArrayFactory = Callable[[Floats], Array]
"""returns an array in the library and precision of a batch"""
DrawNormal = Callable[[tuple[int, ...]], Array]
"""draws standard normal numbers of a given shape"""
WorldSeeds = Sequence[Sequence[np.random.SeedSequence]]
"""seeds of the generators of each world, from `Scenario.draw_from_seed`"""


def draw_single_normal(generator: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return single-precision normal numbers, faster than NumPy. Source: Box and Muller 1958, Ann. Math. Stat."""
    size = prod(shape)
    uniform = generator.random((2, (size + 1) // 2), np.float32)
    radius, angle = np.sqrt(-2.0 * np.log(1.0 - uniform[0])), 2.0 * np.pi * uniform[1]
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:size].reshape(shape)


class NoiseState(NamedTuple):
    """State of the human drivers' noise in one world."""

    generator: Mapping[str, Any]
    """state of the NumPy generator"""
    remaining_block: Floats
    """unused steps of the last block in reverse order, shape (steps, vehicles)"""


class SeededNoise:
    """Standard normal numbers for W worlds with their own generators; they equal those of SUMO's episodes."""

    def __init__(self, seeds: WorldSeeds, vehicles: int, shape: tuple[int, int], to_array: ArrayFactory) -> None:
        self._human_generators = [np.random.default_rng(noise) for noise, *_ in seeds]
        self._exploration_seeds = [exploration for _, exploration, *_ in seeds]
        self._block = np.empty((len(seeds), NOISE_BLOCK_STEPS, vehicles))
        self._exploration_shape, self._to_array = shape, to_array
        self._remaining_steps: list[Array] = []
        self._exploration: Array = None

    def human_noise(self) -> Array:
        """Return the numbers of this simulation step, shape (vehicles, W)."""
        if not self._remaining_steps:
            for generator, block in zip(self._human_generators, self._block, strict=True):
                generator.standard_normal(out=block)
            blocks = np.ascontiguousarray(self._block.transpose(1, 2, 0))
            self._remaining_steps = list(self._to_array(blocks))[::-1]
        return self._remaining_steps.pop()

    def states(self) -> list[NoiseState]:
        """Return the state of the noise of each world with NumPy arrays."""
        steps = np.array(self._remaining_steps).reshape(-1, *self._block.shape[2:], len(self._human_generators))
        generators = enumerate(self._human_generators)
        return [NoiseState(generator.bit_generator.state, steps[:, :, world].copy()) for world, generator in generators]

    def restore(self, states: Sequence[NoiseState]) -> None:
        """Continue from states with remaining blocks of the same length."""
        for generator, state in zip(self._human_generators, states, strict=True):
            generator.bit_generator.state = dict(state.generator)
        self._remaining_steps = list(self._to_array(np.stack([state.remaining_block for state in states], 2)))

    def replace_worlds(self, worlds: Sequence[int], source: "SeededNoise", source_worlds: Sequence[int]) -> None:
        """Continue in some worlds with generators of `source`, which has no unused steps of a block."""
        for world, source_world in zip(worlds, source_worlds, strict=True):
            generator = self._human_generators[world] = source._human_generators[source_world]
            self._exploration_seeds[world] = source._exploration_seeds[source_world]
            draws = self._to_array(generator.standard_normal((len(self._remaining_steps), self._block.shape[2])))
            for step, values in zip(reversed(self._remaining_steps), draws, strict=True):
                step[:, world] = values

    def drop_block(self) -> None:
        """Drop the unused steps of the block, as SUMO's episodes do when CAVs take over."""
        self._remaining_steps = []

    def exploration_noise(self, step_index: int) -> Array:
        """Return the exploration noise of all CAVs in a control step, shape (CAVs * W,)."""
        if self._exploration is None:
            draws = np.stack(self._draw_exploration(self._exploration_shape), 2)
            self._exploration = self._to_array(draws.reshape(len(draws), -1))
        return self._exploration[step_index]

    def episode_noise(self, count: int) -> Array:
        """Return `count` numbers for each CAV, shape (CAVs * W, count); they are equal for all CAVs of a world."""
        if self._exploration is None:
            draws = self._draw_exploration(count)
            self._exploration = self._to_array(np.tile(draws, (self._exploration_shape[1], 1)))
        return self._exploration

    def _draw_exploration(self, shape: Any) -> list[Floats]:
        return [np.random.default_rng(seed).standard_normal(shape) for seed in self._exploration_seeds]


class QuickNoise:
    """Standard normal numbers for W worlds from one generator; they differ from those of SUMO's episodes."""

    def __init__(self, draw: DrawNormal, vehicle_count: int, cav_count: int, world_count: int) -> None:
        self._draw, self._human_shape, self._cav_count = draw, (vehicle_count, world_count), cav_count
        self._exploration: Array = None

    def human_noise(self) -> Array:
        """Return the numbers of this simulation step, shape (vehicles, W)."""
        return self._draw(self._human_shape)

    def replace_worlds(self, worlds: Sequence[int], source: "QuickNoise", source_worlds: Sequence[int]) -> None:
        """Do nothing, because all worlds share one generator."""

    def drop_block(self) -> None:
        """Do nothing, because no block is drawn in advance."""

    def exploration_noise(self, step_index: int) -> Array:
        """Return the exploration noise of all CAVs in a control step, shape (CAVs * W,)."""
        return self._draw((self._cav_count * self._human_shape[1],))

    def episode_noise(self, count: int) -> Array:
        """Return `count` numbers for each CAV, shape (CAVs * W, count); they are equal for all CAVs of a world."""
        if self._exploration is None:
            draws = self._draw((self._human_shape[1], count))
            self._exploration = namespace(draws).tile(draws, (self._cav_count, 1))
        return self._exploration
