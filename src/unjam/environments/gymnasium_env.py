"""A Gymnasium environment of a scenario with one CAV, and the steps of scenarios for all environments."""

import warnings
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import copy, deepcopy
from functools import wraps
from math import isfinite
from threading import RLock
from typing import Any, ClassVar, Concatenate, NamedTuple, ParamSpec, Self, TypeVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from unjam.controller import make_expert
from unjam.drivers.car_following import Constant
from unjam.drivers.command import as_numbers
from unjam.drivers.observation import MAX_OBSERVATION, FeatureLike, as_features, memory_size, observation_size
from unjam.drivers.user_driver import DriverLike
from unjam.environments.external_driver import ExternalDriver
from unjam.errors import EpisodeError, InputError, MissingPartError, UnjamError, invalid_value, unknown_name
from unjam.measures.metrics import METRICS, RECORDED_ROAD_METRICS
from unjam.measures.step_metrics import StepMetricMeans
from unjam.parameters import check_integer, merge_changes, nest_keys
from unjam.physics.arrays import clip
from unjam.processes import has_display
from unjam.scenarios import make_scenario
from unjam.scenarios.file_watch import watch_files
from unjam.scenarios.road import OrderedRoad, RecordedRoad
from unjam.scenarios.scenario import Scenario
from unjam.seeds import warn_of_reserved_seed
from unjam.text import to_one_line
from unjam.worlds.backend import Backend, BackendLike, WorldOptions, check_support, open_backend, open_world
from unjam.worlds.drive import DriveLoop
from unjam.worlds.episode import check_can_drive, check_policy_inputs
from unjam.worlds.reward import Outcome, RewardLike, is_packaged_reward, make_reward, step_reward_terms, time_gap
from unjam.worlds.road_world import RoadWorld

Observations = NDArray[np.float32]
ResetOptions = dict[str, Any] | None  # parameters of the scenario for one episode
P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")


class CopyableLock:
    """A reentrant lock; a copy of its owner gets a new lock."""

    def __init__(self) -> None:
        self.rlock = RLock()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()


class CopiedWhole:
    """A base class whose shallow copies are deep copies, because environments must not share a simulation."""

    def __copy__(self) -> Self:
        """Return an independent copy, as `copy.deepcopy` does."""
        return deepcopy(self)


def synchronized(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Decorate a method of an environment: a second thread waits until the first thread has returned."""

    @wraps(method)
    def call(self: S, /, *arguments: P.args, **keywords: P.kwargs) -> T:
        with self._road.lock.rlock:  # pyright: ignore[reportAttributeAccessIssue]
            return method(self, *arguments, **keywords)

    return call


def as_action(action: Any, name: str) -> float:
    """Return the action of one CAV as a float [m/s2]; raise `InputError` unless it is one finite number."""
    allowed, is_float_array = "one finite number", type(action) is np.ndarray and action.dtype.kind == "f"
    values = action if is_float_array else as_numbers(action, f"step: {name}", allowed)
    if values.size != 1 or not isfinite(number := values.item()):
        raise InputError(f"step: {name}: {to_one_line(repr(action), 60)} is not allowed; allowed: {allowed}")
    return number


def episode_seed(seed: int, episode_count: int) -> tuple[int, ...]:
    """Return the seed of the episode of an environment that follows `episode_count` episodes since `seed`."""
    return (seed, episode_count) if episode_count else (seed,)


def no_cav_error(scenario: Scenario, episode: str = "") -> EpisodeError:
    """Return the error for an episode without a control step of a CAV; `episode` is the name in the message."""
    allowed = f"a horizon of more than {scenario.horizon} control steps, or more CAVs"
    return EpisodeError(f"reset: {episode}no CAV enters the road before the episode ends; allowed: {allowed}")


def check_single_cav(scenario: Scenario) -> None:
    """Raise `InputError` unless a scenario has one CAV."""
    if getattr(scenario, "cavs", None) != 1:
        raise InputError("cavs: several are not allowed here; allowed: 1; use unjam.parallel_env")


class RoadStepResult(NamedTuple):
    """The result of one control step, with the CAVs on the road after it."""

    cav_ids: list[str]
    observations: Observations  # shape (CAVs, numbers)
    departed: dict[str, Observations]  # last observations of the CAVs that left the road in this step
    reward: float
    reward_terms: dict[str, float]
    terminated: bool
    truncated: bool  # whether the horizon is reached, or no further CAV will be on the road


class RoadStepper:
    """Simulates a scenario one control step at a time, with given accelerations of its CAVs."""

    def __init__(
        self,
        scenario: str,
        changes: dict[str, Any],
        reward: RewardLike = "",
        expert: str | DriverLike = "",
        features: Sequence[FeatureLike] = ("local",),
        backend: BackendLike = "sumo",
        has_single_cav: bool = False,
    ) -> None:
        """Prepare a scenario with arguments as `RoadEnv`; `has_single_cav` replaces a penetration rate by one CAV."""
        self.scenario = make_scenario(scenario, changes)
        if has_single_cav and getattr(self.scenario, "cavs", 1) is None:
            changes = {**changes, "cavs": 1}
            self.scenario = make_scenario(scenario, changes)
        self._scenario_name, self._changes = scenario, changes
        self.episode_scenario = self.scenario
        """scenario of the last reset, with its options"""
        self._watch = watch_files([self.scenario], scenario, backend)
        reward = reward or self.scenario.reward
        self.reward, self.has_user_reward = make_reward(reward), not is_packaged_reward(reward)
        driver = make_expert(expert, self.scenario.control_step) if expert else Constant()
        inputs = as_features(features)
        for name in ("expert_acceleration", "expert_memory"):
            if not expert and name in inputs:
                raise InputError(f"features: {name!r} is not allowed; allowed: with an expert, like 'pi'")
        if "expert_memory" in inputs and not memory_size(driver):  # no error, because exported policies may contain it
            text = f"features: 'expert_memory' adds no numbers: the expert {driver.describe()} has no memory features"
            warnings.warn(text, stacklevel=3)
        self._driver = ExternalDriver(driver, inputs, self.scenario.acceleration_limits)
        self._backend = backend
        with open_backend(backend) as checked_backend:
            self._check_scenario(self.scenario, checked_backend)
        self._open_backend: Backend | None = None
        self._world: RoadWorld | None = None
        self._backend_context, self._world_context = ExitStack(), ExitStack()
        bound = np.full(observation_size(self._driver.features, driver), MAX_OBSERVATION, np.float32)
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float32)
        low, high = (np.full(1, limit, np.float32) for limit in self.scenario.acceleration_limits)
        self.action_space = spaces.Box(low, high, dtype=np.float32)  # action space of one CAV: an acceleration [m/s2]
        self._seed: int | None = None
        self._episode_count = 0  # number of episodes since this seed
        self.lock = CopyableLock()  # held during calls of the environment

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for a copy; raise `InputError` after a reset: a simulation cannot be copied."""
        if self._world is not None:
            raise InputError("environment: a copy after reset is not allowed; allowed: before, or a new environment")
        return self.__dict__

    def _check_scenario(self, scenario: Scenario, backend: Backend) -> None:
        check_can_drive(self._driver.expert, scenario)
        check_policy_inputs(self._driver.features, scenario, "features")
        check_support(backend, scenario)

    def _change_scenario(self, options: dict[str, Any], backend: Backend) -> Scenario:
        """Return the scenario with `options` for one episode; raise `InputError` if they are not allowed."""
        if not isinstance(options, dict):
            raise invalid_value("reset: options", options, "a dict of parameters of the scenario")
        scenario = make_scenario(self._scenario_name, merge_changes(nest_keys(self._changes), nest_keys(options)))
        for name in ("cavs", "action_limit"):
            value, allowed = getattr(scenario, name, None), getattr(self.scenario, name, None)
            if value != allowed:
                raise invalid_value(f"reset: options: {name}", value, f"{allowed}, as in the constructor")
        self._check_scenario(scenario, backend)
        return scenario

    def reset(self, seed: int | None, generator: np.random.Generator, options: ResetOptions = None) -> Observations:
        """Start an episode, run its warm-up, and return the first observations.

        The episode is that of `seed`; without a seed, it is the next episode after the last seed, or has a seed of
        `generator`. `options` change the scenario for this episode only. Raise `InputError` if a file of the scenario
        has changed.
        """
        seed = None if seed is None else check_integer("seed", seed, 0)
        warn_of_reserved_seed(seed)
        self._watch.check()
        if self._open_backend is None:
            self._open_backend = self._backend_context.enter_context(open_backend(self._backend))
        scenario = self.scenario if options is None else self._change_scenario(options, self._open_backend)
        if seed is not None:
            self._seed, self._episode_count = seed, 0
        if self._seed is None:
            self._seed = int(generator.integers(2**31))
        world_seed = episode_seed(self._seed, self._episode_count)
        self._episode_count += 1
        self.end_episode()  # even if the next episode cannot start
        self.episode_scenario = scenario
        requirements = self._driver.requirements(scenario.interface)
        world_options = WorldOptions(requirements.measured_fields, accepts_floats=not requirements.needs_arrays)
        world_context = open_world(self._open_backend, scenario, world_seed, world_options)
        self._world = world = self._world_context.enter_context(world_context)
        self._drive_loop = DriveLoop(world, self._driver)
        self._control_steps = iter(self._drive_loop)
        self._steps, self._return = 0, 0.0
        self._metric_means = StepMetricMeans() if isinstance(world.road, OrderedRoad) else None
        self._wait_for_cav()
        if not world.cav_ids or world.has_ended:  # there is no control step of a CAV
            self.end_episode()
            raise no_cav_error(scenario)
        return self._observe()

    def step(self, actions: Any) -> RoadStepResult:
        """Simulate one control step with `actions` [m/s2], (CAVs,), and further steps until a CAV is on the road."""
        world, previous_ids, last_observations = self.world, list(self.world.cav_ids), self._observations
        self._driver.actions = float(actions[0]) if world.is_scalar else np.asarray(actions, np.float64)
        if next(self._control_steps, None) is None:
            raise UnjamError("step: the episode is over; allowed: reset")
        rows, state, accelerations = world.remaining_rows, world.exact_state(), world.last_applied_acceleration()
        departed = {}
        if rows is not None:
            accelerations = accelerations[list(rows)]
            departed = {cav_id: last_observations[row] for row, cav_id in enumerate(previous_ids) if row not in rows}
        time_gaps, speed = time_gap(state.leader_gap, state.speed), state.speed
        if not world.is_scalar:
            time_gaps, speed = time_gaps[: len(accelerations)], np.array(speed[: len(accelerations)])
            accelerations = np.array(accelerations)  # a backend may change its arrays later
        crash_and_backlog = bool(world.has_crashed), float(world.backlog)
        outcome = Outcome(np.array(world.speeds), accelerations, time_gaps, *crash_and_backlog, speed)
        terms = step_reward_terms(self.reward, outcome, world.control_steps - 1, self.has_user_reward)
        terminated, reward = world.has_crashed, sum(terms.values())
        self._steps, self._return = self._steps + 1, self._return + reward
        if self._metric_means is not None:
            self._metric_means.add(outcome)
        if not world.cav_ids:
            self._wait_for_cav()  # no termination if human drivers crash now, because no CAV has caused it
        truncated = not terminated and (world.has_ended or not world.cav_ids)
        return RoadStepResult(list(world.cav_ids), self._observe(), departed, reward, terms, terminated, truncated)

    def step_info(self, result: RoadStepResult, has_ended: bool) -> dict[str, Any]:
        """Return `reward_terms` and, at the end, `episode_metrics`: on open roads only `return` and `steps`."""
        if not has_ended:
            return {"reward_terms": result.reward_terms}
        means = {} if self._metric_means is None else self._metric_means.means()
        metrics = {"return": self._return, "steps": self._steps, **means}
        if isinstance(self.world.road, RecordedRoad):
            episode = self.world.record_so_far()
            metrics |= {name: METRICS[name].function(episode) for name in RECORDED_ROAD_METRICS}
        return {"reward_terms": result.reward_terms, "episode_metrics": metrics}

    def _wait_for_cav(self) -> None:
        """Continue the simulation until a CAV is on the road, or no CAV can enter before the episode ends."""
        world = self.world
        while world.expects_cavs and not (world.cav_ids or world.has_ended):
            next(self._control_steps)

    def copy_driver(self) -> ExternalDriver:
        """Return a driver with the same expert and features, for other CAVs."""
        return copy(self._driver)

    @property
    def world(self) -> RoadWorld:
        """World of the running episode; raise `UnjamError` without one."""
        if self._world is None:
            raise UnjamError("no episode is running: call reset first")
        return self._world

    def _observe(self) -> Observations:
        observation = self._drive_loop.observe()
        low, high = -MAX_OBSERVATION, MAX_OBSERVATION
        if self.world.is_scalar:  # faster than a call of NumPy
            self._observations = np.array([[clip(value, low, high) for value in observation]], np.float32)
        else:
            self._observations = clip(observation, low, high).astype(np.float32)
        return self._observations

    def end_episode(self) -> None:
        """End the running episode, if any."""
        self._world = None
        self._world_context.close()

    def close(self) -> None:
        """Close the backend; further calls have no effect."""
        self.end_episode()
        self._open_backend = None
        self._backend_context.close()


class RoadEnv(CopiedWhole, gymnasium.Env[Observations, NDArray[Any]]):
    """One CAV among human drivers, in SUMO or another backend.

    ``gymnasium.make("unjam/Ring-v0")``, ``"unjam/FigureEight-v0"``, ``"unjam/Merge-v0"``, ``"unjam/OnRamp-v0"``,
    ``"unjam/Recorded-v0"``, with any parameter of the scenario:
    ``gymnasium.make("unjam/Ring-v0", scenario="ring-jammed", length=(230, 230))``.
    On roads with ends one CAV replaces the penetration rate.
    On a user network the CAV is the first that the penetration rate selects, and SUMO runs in a sandboxed process:
    ``gymnasium.make("unjam/UserNetwork-v0", scenario="my.sumocfg", penetration_rate=0.1)``.

    ===========  ===================================================================================================
    Action       ``Box(-limit, limit, (1,), float32)``: acceleration [m/s2], limit 1 by default; with ``expert``, the
                 addition to its acceleration
    Observation  ``Box(-50, 50, (5,), float32)``: own speed / 10 m/s; leader speed - own speed / 5 m/s; leader gap /
                 20 m; follower speed - own speed / 5 m/s; follower gap / 20 m. ``features`` selects others:
                 ``local`` (these five), ``expert_acceleration``, ``expert_memory``, ``penetration_rate``; on closed
                 roads ``loop_length``, ``lap_position``; on roads that provide them ``route_position``,
                 ``allowed_speed``, ``distance_to_merge``, ``merge_proximity``, ``lane_speeds``, ``road_speeds``,
                 ``adjacent_lanes``; a `PolicyInput`, ``path.py:name``, or a function of a `LocalState`
    Reward       that of the scenario, or ``reward``; its terms are in ``info["reward_terms"]``
    Metrics      ``info["episode_metrics"]`` in the last step, as of `RoadVectorEnv`
    Start        ``reset(seed=s)`` starts the same episode as ``unjam drive --seed s``, with its warm-up; on open roads
                 it returns when the CAV has entered, and ``info["control_steps"]`` of the horizon have passed
    Terminated   at a collision
    Truncated    at the horizon; on the merge also when the CAV leaves the road
    Time step    one control step: 0.1 s, on the merge 1 s
    ===========  ===================================================================================================

    libsumo can run one simulation per process. If other code or another environment uses it, SUMO runs in a separate
    process, several times slower, with a warning. A second thread waits until the first thread has returned.
    Many environments at once, without SUMO: `RoadVectorEnv`; in SUMO:
    ``gymnasium.make_vec("unjam/Ring-v0", num_envs=4, vectorization_mode="async")``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # pyright: ignore

    def __init__(
        self,
        scenario: str = "ring",
        reward: RewardLike = "",
        expert: str | DriverLike = "",
        features: Sequence[FeatureLike] = ("local",),
        render_mode: str | None = None,
        backend: BackendLike = "sumo",
        **changes: Any,
    ) -> None:
        """Prepare the environment; the backend is opened by the first `reset`.

        Args:
            scenario: its name.
            reward: a name, `path.py:name`, or a function of an `Outcome`; empty: that of the scenario.
            expert: a driver to which actions are added: a name as in `unjam drive --driver`, a driver, a class or an
                object with `act` and `initial_memory`, or a function of a `LocalState`.
            features: observed features: names such as `local`, `expert_acceleration`, `expert_memory`, or
                functions of a `LocalState`. Functions run in the process of the environment.
            render_mode: `rgb_array`, or `human` for SUMO's own window.
            backend: the simulator: `sumo`, `batch`, `path.py:name`, or an object.
            changes: other values for parameters of the scenario.

        Raises:
            InputError: an argument is wrong, or the scenario has several CAVs.
            MissingPartError: a window is requested without a display.
        """
        if render_mode not in (None, "human", "rgb_array"):
            raise unknown_name("render_mode", render_mode, ("human", "rgb_array"))
        if render_mode == "human" and not has_display():
            raise MissingPartError("render_mode: 'human' needs a display; without one: 'rgb_array'")
        for name in ("slots", "num_envs"):
            if name in changes:
                allowed = "gymnasium.make_vec and, with slots, unjam.parallel_env"
                raise InputError(f"{name}: it is not allowed in a single environment of one CAV; allowed in: {allowed}")
        self.render_mode, self._spec = render_mode, None
        if render_mode == "human" and backend != "sumo":
            raise invalid_value("render_mode", render_mode, "rgb_array, except with backend='sumo'")
        backend = "sumo-gui" if render_mode == "human" else backend
        self._road = RoadStepper(scenario, changes, reward, expert, features, backend, has_single_cav=True)
        check_single_cav(self._road.scenario)
        self.observation_space = self._road.observation_space
        self.action_space = self._road.action_space

    @synchronized
    def reset(self, *, seed: int | None = None, options: ResetOptions = None) -> tuple[Observations, dict[str, Any]]:
        """Start the episode of `seed`; without a seed, start the next episode after the last seed.

        `options` change parameters of the scenario for this episode only, as `changes` of the constructor do:
        `reset(options={"length": 230})`. They cannot change the number of CAVs and the action limit.
        """
        observations = self._road.reset(seed, self.np_random, options)
        super().reset(seed=None if seed is None else int(seed))  # Gymnasium takes no integers of NumPy
        world = self._road.world
        return observations[0], {"drawn_values": dict(world.road.drawn_values), "control_steps": world.control_steps}

    @synchronized
    def step(self, action: Any) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance one control step."""
        result = self._road.step([as_action(action, "action")])
        observation = next(iter(result.departed.values())) if result.departed else result.observations[0]
        truncated = result.truncated or (bool(result.departed) and not result.terminated)
        info = self._road.step_info(result, result.terminated or truncated)
        return observation, result.reward, result.terminated, truncated, info

    @property
    def spec(self) -> EnvSpec | None:
        """Specification of `gymnasium.make`; its `max_episode_steps` is the horizon of the constructor.

        The number of steps is not registered, because Gymnasium would then end episodes with a longer horizon early.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._spec = spec
        if spec is not None and spec.max_episode_steps is None:
            spec.max_episode_steps = self._road.scenario.horizon

    @synchronized
    def render(self) -> Any:
        """Return an image of the current state, shape (640, 640, 3); None in other render modes."""
        if self.render_mode != "rgb_array":
            return None
        from unjam.reports.video import draw_road

        world = self._road.world
        limit_speed = world.road.limit_speed  # unknown on user networks
        max_speed = 2.0 * limit_speed if np.isfinite(limit_speed) else self._road.episode_scenario.top_speed
        return np.asarray(draw_road(world.scene(), max_speed, f"mean {np.mean(world.speeds):.1f} m/s"))

    @synchronized
    def close(self) -> None:
        """Close SUMO; further calls have no effect."""
        self._road.close()
