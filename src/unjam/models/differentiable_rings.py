"""Rings in torch, with gradients of rewards and states with respect to the accelerations of CAVs."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, SupportsIndex, cast

import torch
from torch import Tensor

from unjam.drivers.command import Command, as_numbers
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.user_driver import object_label
from unjam.errors import InputError, invalid_value
from unjam.models.rollouts import check_device
from unjam.models.settings import Device
from unjam.physics.kinematics import gap_on_loop
from unjam.scenarios import ScenarioLike, make_scenario
from unjam.scenarios.ring import Ring
from unjam.scenarios.scenario import VEHICLE_LENGTH
from unjam.tree import map_leaves
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import initial_batch_memory, warm_up_states
from unjam.worlds.batch.support import unsupported_reason
from unjam.worlds.episode import as_seed
from unjam.worlds.reward import RewardLike, check_tensor_terms, make_reward


class DifferentiableRings(RingBatch):
    """W rings that torch simulates together, with gradients by autograd.

    Episodes are equal to those of `run_episode` with the same seeds, except for rounding. `local_state()` returns the
    observations of the CAVs: tensors of shape (CAVs * W,), with the first CAV of all rings, then the second, and so on.
    `speeds` [m/s] has the shape (vehicles, W). `crashed_roads` marks rings with a collision, and `has_ended` says
    whether the episodes are over.
    """

    reward_terms: Mapping[str, Tensor] = MappingProxyType({})
    """terms of the rewards of the last step by name, shape (W,)"""

    def __init__(
        self,
        scenario: ScenarioLike,
        seeds: Sequence[SupportsIndex | Sequence[int]],
        device: Device = "cpu",
        dtype: torch.dtype = torch.float64,
        reward: RewardLike = "",
        generator: torch.Generator | None = None,
    ) -> None:
        """Start an episode on each ring after the warm-up.

        Args:
            scenario: a ring, its class, or its name.
            seeds: a seed for each ring, as in `run_episode`; it also determines the length.
            device: device of all tensors.
            dtype: type of all tensors; in `torch.float32` episodes differ from `run_episode` after some minutes.
            reward: a name, or a function of an `Outcome` of tensors; empty: the reward of the scenario.
            generator: generator of the noise of human drivers that replaces the seeds and is faster. Human drivers then
                do not also follow the last vehicle on the next lane of SUMO's ring, which changes little.

        Raises:
            InputError: there are no seeds, the scenario is no ring that batches support, or sensors have errors.
            MissingPartError: the device is not available.
        """
        check_device(device)
        if dtype not in (torch.float32, torch.float64):
            raise invalid_value("dtype", str(dtype), "torch.float32, torch.float64")
        road = make_scenario(scenario)
        if not isinstance(seeds, Iterable) or not (seed_numbers := [as_seed(seed) for seed in seeds]):
            raise invalid_value("seeds", seeds, "one or more")
        if not isinstance(road, Ring):
            raise invalid_value("scenario", road.title, "a ring")
        if reason := unsupported_reason(road):
            raise InputError(f"scenario: {reason}")
        if not road.sensors.is_exact:
            raise InputError("sensors: errors have no gradient; allowed: exact sensors")
        draw = generator and partial(torch.randn, generator=generator, dtype=dtype, device=device)
        to_tensor = partial(torch.as_tensor, dtype=dtype, device=device)
        super().__init__([road] * len(seed_numbers), seed_numbers, to_tensor, keep_record=False, draw=draw)
        self._reward = make_reward(reward or road.reward)
        if road.warmup and generator is None:
            self.warm_up_states = warm_up_states([(road, seed, frozenset()) for seed in seed_numbers], ())
        with torch.no_grad():
            self._history = self.start(is_controlled=True)

    @property
    def positions(self) -> Tensor:
        """Positions of all front bumpers along the road [m], not wrapped, shape (vehicles, W)."""
        return self._position

    @property
    def gaps(self) -> Tensor:
        """Gaps of all vehicles to the vehicle ahead [m], shape (vehicles, W)."""
        return self._gap

    @property
    def loop_lengths(self) -> Tensor:
        """Lengths of the rings [m], shape (W,)."""
        return self._loop_lengths

    def set_state(self, speeds: Tensor, positions: Tensor) -> None:
        """Set the speeds [m/s] and positions [m] of all vehicles, shape (vehicles, W); gradients flow back to both.

        Raise `InputError` if a shape is wrong, a number is not finite, a speed is negative, or the order is wrong.
        """
        shape = self._position.shape
        speeds, positions = self._as_tensor("speeds", speeds, shape), self._as_tensor("positions", positions, shape)
        if bool((speeds < 0.0).any()):
            raise invalid_value("speeds", float(speeds.min()), ">= 0")
        gaps = gap_on_loop(positions, positions.roll(-1, 0), self._loop_lengths, VEHICLE_LENGTH)
        laps = ((gaps + VEHICLE_LENGTH).sum(0) / self._loop_lengths).round()
        if bool((laps != 1.0).any()):
            ring = int((laps != 1.0).nonzero()[0])
            raise InputError(f"positions: those of ring {ring} are not in order; allowed: each vehicle behind the next")
        self._speed, self._position, self._gap = torch.cat([speeds, speeds[:1]]), positions, gaps

    def _as_tensor(self, name: str, values: Any, shape: Sequence[int]) -> Tensor:
        """Return numbers of the user as a tensor; raise `InputError` unless they are finite and of this shape."""
        allowed = f"finite numbers of shape {tuple(shape)}"
        tensor = cast(Tensor, as_numbers(values, name, allowed, self._to_array))
        if tensor.shape != tuple(shape):
            raise invalid_value(f"{name}: shape", tuple(tensor.shape), str(tuple(shape)))
        if not bool((is_finite := tensor.isfinite()).all()):
            index = int((~is_finite).flatten().nonzero()[0])
            value, ring = float(tensor.flatten()[index]), index % len(self.roads)  # rings vary fastest
            raise InputError(f"{name}: {value} of ring {ring} is not allowed; allowed: {allowed}")
        return tensor

    def initial_memory(self, driver: Any) -> Memory:
        """Return the memory of a driver, or of an object with `initial_memory(n)`, after the warm-up, as tensors.

        Raise `InputError` for a driver that only accepts NumPy arrays, or an object without `initial_memory`.
        """
        is_array_driver = isinstance(driver, Driver) and driver.requirements().needs_numpy
        if is_array_driver or not hasattr(driver, "initial_memory"):
            allowed = "a driver that takes tensors, like 'pi' or policy_driver(module)"
            name = driver.describe() if is_array_driver else object_label(driver)
            raise invalid_value("driver", name, allowed)
        memory = initial_batch_memory(driver, len(self.roads), self.cav_count)
        memory = memory if self._history is None else driver.recall(memory, self._history)
        return map_leaves(self._to_array, memory)

    def step(self, acceleration: Tensor) -> Tensor:
        """Simulate one control step, and return the reward of each ring, shape (W,), the sum of `reward_terms`.

        The scenario and its safety filter limit `acceleration` [m/s2], shape (CAVs * W,). After a collision or the
        horizon, the rewards of a ring are zero. Raise `InputError` if the shape is wrong or a number is not finite.
        """
        was_running = self._is_running
        self.advance(Command(self._as_tensor("step: acceleration", acceleration, (self.cav_count,))))
        terms = self._reward(self.last_outcome())
        check_tensor_terms(self._reward, terms)
        self.reward_terms = {name: values * was_running for name, values in terms.items()}
        return torch.stack([*self.reward_terms.values()]).sum(0)

    def detach(self, memory: Memory | None = None) -> Memory:
        """Stop gradients to earlier steps, and return the driver's `memory` without gradients."""
        self.detach_state()
        return map_leaves(lambda values: values.detach(), memory or {})
