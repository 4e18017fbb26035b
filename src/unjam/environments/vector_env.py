"""Many roads of a batch as a Gymnasium vector environment, with NumPy arrays or torch tensors."""

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from operator import index
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from unjam.drivers.check import check_driver
from unjam.drivers.command import as_numbers
from unjam.drivers.observation import MAX_OBSERVATION, FeatureLike
from unjam.drivers.user_driver import DriverLike
from unjam.environments.external_driver import ExternalDriver
from unjam.environments.gymnasium_env import CopiedWhole, RoadStepper, check_single_cav, episode_seed
from unjam.errors import InputError, MissingPartError, UnjamError, import_optional, invalid_value
from unjam.measures.metrics import METRICS, RECORDED_ROAD_METRICS
from unjam.measures.step_metrics import step_metrics
from unjam.parameters import check_integer
from unjam.physics.arrays import Array, clip, copy_array, namespace, replace_entries
from unjam.scenarios import make_scenario
from unjam.scenarios.scenario import Scenario
from unjam.seeds import warn_of_reserved_seed
from unjam.text import format_count
from unjam.tree import map_leaves
from unjam.worlds.batch.noise import ArrayFactory, DrawNormal, draw_single_normal
from unjam.worlds.batch.ring.record import as_numpy
from unjam.worlds.batch.ring.recorded import RecordedBatch
from unjam.worlds.batch.ring.world import RingBatch
from unjam.worlds.batch.run import start_batch_drive
from unjam.worlds.batch.support import required_batch_kind, statistically_unsupported_reason
from unjam.worlds.episode import as_seed
from unjam.worlds.reward import MAX_REWARD_TERM, Outcome, RewardLike, check_tensor_terms, validate_reward_terms

EXPERT_CHECK_STEPS = 3  # number of random steps in which an expert must drive rows independently, without own state
MAX_ENVIRONMENTS = 1_000_000  # each environment takes at least 2 kB
ASYNC_MODE = "allowed: vectorization_mode='async', which simulates in SUMO"


class _ArrayKind(NamedTuple):
    """Array library, precision and noise of an environment."""

    to_array: ArrayFactory
    draw: DrawNormal | None  # draws the noise of all roads; None if each road has the noise of SUMO's episode
    to_single: Callable[[Array], Array]  # returns an array in single precision
    no_gradient: Callable[[], AbstractContextManager[object]]  # returns a context without gradients


def _numpy_kind(is_exact: bool, seed: Sequence[int]) -> _ArrayKind:
    to_array = partial(np.asarray, dtype=np.float64 if is_exact else np.float32)
    draw = None if is_exact else partial(draw_single_normal, np.random.default_rng(seed))
    return _ArrayKind(to_array, draw, lambda values: values.astype(np.float32), nullcontext)


def _torch_kind(is_exact: bool, seed: Sequence[int], device: str) -> _ArrayKind:
    torch = import_optional("torch")
    to_array = partial(torch.as_tensor, dtype=torch.float64 if is_exact else torch.float32, device=device)
    generator = torch.Generator(device).manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
    draw = None if is_exact else partial(torch.randn, generator=generator, dtype=torch.float32, device=device)
    return _ArrayKind(to_array, draw, lambda values: values.float(), torch.no_grad)


def with_masks(values: dict[str, Any], mask: Array) -> dict[str, Any]:
    """Return values by name, and with `_` before each name Gymnasium's mask of the environments that have them."""
    return values | {f"_{name}": mask for name in values}


class Episodes:
    """Running episodes on the roads of a batch, with the driver of their CAVs."""

    def __init__(self, world: Any, driver: ExternalDriver, to_array: ArrayFactory) -> None:
        self.world, self._driver, self._memory = world, driver, start_batch_drive(world, driver, to_array).memory
        self.observe()

    def advance(self, actions: Array) -> Outcome:
        """Simulate one control step with actions of shape (W,), and return its outcome, which must not be changed."""
        self._driver.actions = actions
        decision, world = self._driver.decide(self._state, self._memory), self.world
        self._memory = decision.memory
        world.advance(decision.command)
        return world.last_outcome()

    def observe(self) -> None:
        """Compute the observations of the current state; call it once in each control step."""
        self._state = self.world.local_state()
        observation = self._driver.observation(self._state, self._memory)
        self.observations = clip(observation, -MAX_OBSERVATION, MAX_OBSERVATION)

    def detach(self) -> None:
        """Detach the state, so that no gradients flow through earlier steps."""
        self.world.detach_state()
        self._memory = map_leaves(lambda values: values.detach(), self._memory)
        self.observe()  # the driver stores its acceleration

    def replace(self, rows: list[int], source: Any, source_rows: list[int]) -> None:
        """Continue in `rows` with `source_rows` of episodes that have just been started."""
        self.world.replace_roads(rows, source.world, source_rows)
        self._driver.replace_rows(rows, source._driver, source_rows)
        self.observations = replace_entries(self.observations, rows, source.observations, source_rows)


class RoadVectorEnv(CopiedWhole, VectorEnv[Any, Any, Any]):
    """W environments like `RoadEnv`, simulated together without SUMO.

    ``gymnasium.make_vec("unjam/Ring-v0", num_envs=4096)``, with the arguments of `RoadEnv`. Spaces, observations,
    rewards and ends are those of `RoadEnv`. With the same seeds, episodes on rings and recorded roads equal SUMO's
    except for rounding, and episodes on figure eights have the same distribution.

    ================  ==============================================================================================
    Roads             rings, figure eights, recorded roads
    Seeds             ``reset(seed=s)`` gives environment i the seed s + i; or a list of seeds. Without a seed, each
                      environment starts the next episode after that of its last seed
    End of episodes   ``AutoresetMode.NEXT_STEP``: the step after the end of an episode ignores its action, and returns
                      the first observation of the next episode with reward 0. ``reset(options={"reset_mask": mask})``
                      restarts some environments
    ``info``          ``reward_terms``; at the end of an episode ``episode_metrics``: ``return``, ``steps``, and metrics
                      of ``unjam drive`` that are means over time, on recorded roads also those of fuel, gaps, flow and
                      waves; at its start ``drawn_values``
    ================  ==============================================================================================
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _alternative = ASYNC_MODE  # end of the message for a scenario that is not possible
    _step_sums = staticmethod(step_metrics)  # returns values by name that are summed over control steps, shape (W,)

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str = "ring",
        reward: RewardLike = "",
        expert: str | DriverLike = "",
        features: Sequence[FeatureLike] = ("local",),
        exact: bool = True,
        device: str = "",
        **changes: Any,
    ) -> None:
        """Prepare the environments; arguments are those of `RoadEnv`, or as follows.

        Args:
            num_envs: number of environments, W.
            exact: whether each episode equals that of `RoadEnv` with its seed, in double precision. Otherwise episodes
                have the same distribution: all roads share a fast noise generator, human drivers follow only the
                vehicle ahead, and numbers have single precision.
            device: `cpu`, `cuda` or another device of torch for actions and all values that `reset` and `step` return;
                gradients flow through these tensors unless `torch.no_grad` is set. Empty: NumPy arrays.

        Raises:
            InputError: an argument is wrong, or a batch cannot simulate the scenario.
            MissingPartError: torch or the device is not available.
        """
        for name in ("backend", "render_mode"):
            if changes.pop(name, None):
                raise InputError(f"{name}: is not an option of batches; {ASYNC_MODE}")
        num_envs = check_integer("num_envs", num_envs, 1, MAX_ENVIRONMENTS)
        if not isinstance(exact, bool):
            raise invalid_value("exact", exact, "True or False")
        checked = make_scenario(scenario, changes)
        if reason := statistically_unsupported_reason(checked) or self._unsupported_reason(checked):
            raise InputError(f"scenario: {checked.title} is not possible in a batch ({reason}); {self._alternative}")
        self._road = RoadStepper(scenario, changes, reward, expert, features, "batch")
        expert_driver = self._road.copy_driver().expert
        if device and expert_driver.requirements().needs_numpy:
            raise invalid_value("expert", expert, "one that takes tensors, like 'pi'; or device='', NumPy")
        if expert and not device:
            check_driver(expert_driver, steps=EXPERT_CHECK_STEPS)
        self._make_kind = partial(_torch_kind, device=device) if device else _numpy_kind
        self._exact, self.device, self._is_numpy, self.num_envs = exact, device, not device, num_envs
        self._kind = self._make_array_kind((0,))
        self.single_observation_space = self._space_of_environment(self._road.observation_space)
        self.single_action_space = self._space_of_environment(self._road.action_space)
        self._actions_shape = num_envs, *self.single_action_space.shape
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._seeds: list[int | None] = [None] * num_envs
        self._episode_counts = [0] * num_envs  # including prepared episodes
        self._episodes: Episodes | None = None
        self._prepared: dict[int, tuple[Episodes, int]] = {}  # next episode of environments, and its row
        self._motions = deque[Array](maxlen=checked.max_episode_steps + 1)
        """motion in the last control steps on recorded roads; empty on other roads"""
        self._ended_rows: list[int] = []  # environments whose episode ended in the last step

    def _unsupported_reason(self, scenario: Scenario) -> str:
        """Return why this class does not support a scenario that batches can simulate; empty if it does."""
        if not issubclass(required_batch_kind(scenario).world, RingBatch):
            return "vehicles enter and leave: slots are required, for instance slots=8"
        check_single_cav(scenario)
        return ""

    def _space_of_environment(self, space: spaces.Box) -> spaces.Box:
        """Return the space of one environment, given that of one CAV."""
        return space

    def _make_array_kind(self, seed: Sequence[int]) -> _ArrayKind:
        try:
            return self._make_kind(self._exact, seed)
        except (RuntimeError, AssertionError, TypeError):  # errors of torch
            message = f"device: {self.device!r} is not available to torch; allowed: 'cpu', or '' for NumPy"
            raise MissingPartError(message) from None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode in each environment, or in those of `options["reset_mask"]`, booleans of shape (W,)."""
        self._check_open()
        rows, seeds = self._rows_to_reset({} if options is None else options), self._seeds_of_environments(seed)
        warn_of_reserved_seed(*seeds)
        for row in rows:
            row_seed = seeds[row]
            if row_seed is None and self._seeds[row] is None:
                row_seed = int(self.np_random.integers(2**31))
            if row_seed is not None:
                self._seeds[row], self._episode_counts[row] = row_seed, 0
                self._prepared.pop(row, None)
        if len(rows) == self.num_envs and not self._prepared:
            self._kind = self._make_array_kind((self._seeds[0] or 0, self._episode_counts[0]))
            self._episodes = self._start_episodes(rows)
            self._zeros = self._kind.to_array(np.zeros(self.num_envs))
            self._totals: defaultdict[str, Array] = defaultdict(lambda: self._zeros)
            """sums of the reward and of the metrics over the current episodes, by name, shape (W,)"""
            self._motions.clear()
            self._record_motion()
        else:
            self._restart(rows)
        self._ended_rows = [row for row in self._ended_rows if row not in set(rows)]
        return self._kind.to_single(self._running_episodes.observations), self._start_info(rows)

    def _rows_to_reset(self, options: dict[str, Any]) -> list[int]:
        if not isinstance(options, dict):
            raise invalid_value("options", options, "a dict with 'reset_mask'")
        if unknown := options.keys() - {"reset_mask"}:
            raise InputError(f"options: {min(unknown)!r} is not allowed; allowed: 'reset_mask'")
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise InputError(f"options: reset_mask is not {self.num_envs} booleans, at least one of them True")
        if self._episodes is None and not mask.all():
            raise InputError("options: reset_mask is not allowed in the first reset")
        return np.flatnonzero(mask).tolist()

    def _seeds_of_environments(self, seed: Any) -> list[int | None]:
        if isinstance(seed, int | np.integer):
            super().reset(seed=as_seed(seed)[0])
            return list(range(int(seed), int(seed) + self.num_envs))
        try:
            values = [None] * self.num_envs if seed is None else seed
            seeds = [None if value is None else as_seed(index(value))[0] for value in values]
        except TypeError:
            raise invalid_value("seed", seed, "an integer, or one for each environment") from None
        if len(seeds) != self.num_envs:
            count = format_count(len(seeds), "seed")
            raise InputError(f"seed: {count} not allowed; allowed: {self.num_envs}, or a single one")
        return seeds

    def make_batch(self, rows: Sequence[int]) -> Any:
        """Return a batch with the next episodes of some environments, which have not been started."""
        seeds = [episode_seed(self._seeds[row] or 0, self._episode_counts[row]) for row in rows]
        for row in rows:
            self._episode_counts[row] += 1
        return self._make_world(required_batch_kind(self._road.scenario).world, seeds)

    def _make_world(self, kind: Any, seeds: list[tuple[int, ...]]) -> Any:
        scenarios, arrays = [self._road.scenario] * len(seeds), self._kind
        return kind(scenarios, seeds, arrays.to_array, keep_record=False, draw=arrays.draw)

    def _start_episodes(self, rows: list[int]) -> Episodes:
        return Episodes(self.make_batch(rows), self._road.copy_driver(), self._kind.to_array)

    def _restart(self, rows: list[int]) -> None:
        """Continue in some environments with their next episodes, which are prepared for all environments at once."""
        if not self._prepared.keys() >= set(rows):
            missing = [row for row in range(self.num_envs) if row not in self._prepared]
            episodes = self._start_episodes(missing)
            self._prepared |= {row: (episodes, index) for index, row in enumerate(missing)}
        groups = defaultdict[Episodes, list[tuple[int, int]]](list)
        for row in rows:
            source, source_row = self._prepared.pop(row)
            groups[source].append((row, source_row))
        for source, pairs in groups.items():
            target_rows, source_rows = map(list, zip(*pairs, strict=True))
            self._running_episodes.replace(target_rows, source, source_rows)
        for name, total in self._totals.items():
            self._totals[name] = replace_entries(total, rows, self._zeros, rows)
        if self._motions:
            self._motions.pop()  # replaced by the start of the new episodes
            self._record_motion()

    def _record_motion(self) -> None:
        if isinstance(world := self._running_episodes.world, RecordedBatch):
            with self._kind.no_gradient():
                self._motions.append(world.motion)

    def _check_open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environments are closed; allowed: new environments of gymnasium.make_vec")

    def close_extras(self, **kwargs: Any) -> None:
        """Release the episodes; `step` and `reset` then raise `ClosedEnvironmentError`."""
        self._episodes, self._prepared = None, {}

    @property
    def _running_episodes(self) -> Episodes:
        self._check_open()
        if self._episodes is None:
            raise UnjamError("no episode is running: call reset first")
        return self._episodes

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Simulate one control step with actions of shape (W, 1) [m/s2]; restart episodes that ended before."""
        episodes, restarted = self._running_episodes, self._ended_rows
        outcome = episodes.advance(self._as_actions(actions))
        episodes.observe()
        self._record_motion()
        terms, has_stepped = self._reward_terms(outcome), ~self._mask(restarted)
        rewards = sum(terms.values())
        if restarted:
            rewards = namespace(rewards).where(has_stepped, rewards, 0.0)
        terminated = outcome.has_crashed & has_stepped
        truncated = episodes.world.completed_roads & has_stepped & ~terminated
        info = with_masks({"reward_terms": with_masks(terms, has_stepped)}, has_stepped)
        with self._kind.no_gradient():
            for name, values in {"return": rewards, **self._step_sums(outcome)}.items():
                self._totals[name] = self._totals[name] + values
            ended = terminated | truncated
            self._ended_rows = np.flatnonzero(as_numpy(ended)).tolist() if bool(ended.any()) else []
            if self._ended_rows:
                info |= with_masks({"episode_metrics": with_masks(self._metrics(outcome, ended), ended)}, ended)
            if restarted:
                self._restart(restarted)
                info |= self._start_info(restarted)
        return self._kind.to_single(episodes.observations), rewards, terminated, truncated, info

    def detach(self) -> Array:
        """Detach the state, so that no gradients flow through earlier steps, and return the detached observations.

        Raise `InputError` without `device`: NumPy arrays have no gradients.
        """
        if self._is_numpy:
            raise InputError("detach: NumPy arrays have no gradients; allowed: device='cpu' or another device of torch")
        self._running_episodes.detach()
        return self._kind.to_single(self._running_episodes.observations)

    def _as_actions(self, actions: Any) -> Array:
        shape = self._actions_shape
        allowed = f"finite numbers of shape {shape}"
        values = as_numbers(actions, "step: actions", allowed, self._kind.to_array)
        if tuple(values.shape) not in (shape, shape[:-1]):
            raise InputError(f"step: actions of shape {tuple(values.shape)} are not allowed; allowed: {shape}")
        values = self._clear_ignored_actions(values.reshape(shape[:-1]))
        if not bool((is_finite := namespace(values).isfinite(values)).all()):
            index = tuple(np.argwhere(as_numpy(is_finite) == 0.0)[0])
            reason = f"{float(values[index])} of environment {index[0]} is not allowed"
            raise InputError(f"step: actions: {reason}; allowed: {allowed}")
        return values

    def _clear_ignored_actions(self, actions: Array) -> Array:
        """Return actions with zeros for episodes that have ended, where they are ignored."""
        rows = self._ended_rows
        return replace_entries(actions, rows, namespace(actions).zeros_like(actions), rows) if rows else actions

    def _reward_terms(self, outcome: Outcome) -> dict[str, Array]:
        reward = self._road.reward
        if self._road.has_user_reward:  # the user's function may change its arguments
            outcome = Outcome(*map(copy_array, outcome))
            if self._is_numpy:
                return dict(validate_reward_terms(reward, outcome, row_name="environment"))
        terms = reward(outcome)
        if self._road.has_user_reward:
            check_tensor_terms(reward, terms)
        is_valid = all(getattr(values, "shape", None) == (self.num_envs,) for values in terms.values())
        if not is_valid or (self._is_numpy and not np.all(np.abs(sum(terms.values())) <= MAX_REWARD_TERM)):
            terms = validate_reward_terms(reward, outcome, row_name="environment")
        return {name: self._kind.to_array(values) for name, values in terms.items()}

    def _metrics(self, outcome: Outcome, ended: Array) -> dict[str, Array]:
        """Return the metrics of the episodes that have ended, and zeros for other episodes."""
        steps = self._running_episodes.world.control_step_counts
        sums = {name: total for name, total in self._totals.items() if name != "return"}
        metrics = {"return": self._totals["return"], "steps": steps, **self._episode_metrics(sums, outcome, steps)}
        if self._motions:
            metrics |= self._recorded_road_metrics(self._ended_rows)
        return {name: namespace(values).where(ended, values, 0.0) for name, values in metrics.items()}

    def _episode_metrics(self, sums: dict[str, Array], outcome: Outcome, steps: Array) -> dict[str, Array]:
        """Return metrics of episodes from sums over their control steps, and the outcome of the last step."""
        return {name: total / steps for name, total in sums.items()}

    def _recorded_road_metrics(self, rows: list[int]) -> dict[str, Array]:
        """Return the metrics of ended episodes on recorded roads, and zeros for other episodes."""
        world, values = self._running_episodes.world, np.zeros((len(RECORDED_ROAD_METRICS), self.num_envs))
        for row in rows:
            motions = [motion[row] for motion in [*self._motions][-1 - int(world.control_step_counts[row]) :]]
            episode = world.episode_of(row, as_numpy(namespace(motions[0]).stack(motions)))
            values[:, row] = [METRICS[name].function(episode) for name in RECORDED_ROAD_METRICS]
        return dict(zip(RECORDED_ROAD_METRICS, map(self._kind.to_array, values), strict=True))

    def _mask(self, rows: list[int]) -> Array:
        """Return a mask of the environments `rows`, shape (W,)."""
        return replace_entries(self._zeros > 0.0, rows, self._zeros == 0.0, rows)

    def _start_info(self, rows: list[int]) -> dict[str, Any]:
        is_new = self._mask(rows)
        roads = self._running_episodes.world.roads
        drawn = {}
        for name in roads[0].drawn_values:
            values = np.zeros(self.num_envs)
            values[rows] = [roads[row].drawn_values[name] for row in rows]
            drawn[name] = self._kind.to_array(values)
        return with_masks({"drawn_values": with_masks(drawn, is_new)}, is_new)
