"""A road, stepped from outside, and with one CAV as a Gymnasium environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from unjam.controller import make_expert
from unjam.drivers.car_following import Constant
from unjam.drivers.command import Command, Limits
from unjam.drivers.driver import Decision, Driver, Memory, NoiseSampler
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import (
    FeatureInputs,
    FeatureName,
    check_features,
    compute_observation,
    feature_fields,
    observation_size,
)
from unjam.environments.threads import CopyableLock, synchronized
from unjam.errors import EpisodeError, InputError, MissingPartError, UnjamError, invalid_value, unknown_name
from unjam.processes import has_display
from unjam.scenarios import make_scenario
from unjam.worlds.drive import DriveLoop
from unjam.worlds.episode import check_can_drive, check_policy_inputs
from unjam.worlds.episode_reward import validate_reward_terms
from unjam.worlds.reward import Outcome, make_reward, time_gap
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.backends import Backend
from unjam.worlds.sumo.sandboxed import open_simulation
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Traffic

Observations = NDArray[np.float32]

MAX_OBSERVATION = 50.0
"""bound of every number of an observation; larger ones are cut"""


class ExternalDriver(Driver):
    """An expert to whose accelerations somebody outside adds: `actions`, set before each decision."""

    def __init__(self, expert: Driver, features: Sequence[FeatureName], limits: Limits) -> None:
        """Let `expert` drive within `limits`; features `names` are what is shown outside."""
        self.expert, self.features, self._limits = expert, tuple(features), limits
        self.actions: Any = np.zeros(0)
        """[m/s2], shape (CAVs,)"""

    @property
    def measured_fields(self) -> frozenset[str]:
        """What the expert and the features look at."""
        return self.expert.measured_fields | feature_fields(self.features)

    @property
    def policy_inputs(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What is shown outside, and what networks in the expert see."""
        return (*self.features, *self.expert.policy_inputs)

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's."""
        return self.expert.initial_memory(n)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the expert makes of the warm-up."""
        return self.expert.recall(memory, history)

    def observation(self, state: LocalState, memory: Memory) -> Any:
        """Return what is shown outside now, shape (CAVs, numbers), and keep what the expert wants."""
        wanted, self._next_memory = self.expert.act(state, memory)
        self._expert_acceleration = self._limits.clip(wanted)
        return compute_observation(
            self.features, FeatureInputs(state, self._expert_acceleration, self.expert, self._next_memory)
        )

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the sum of what the expert wanted when it was looked at and what was added since."""
        if not len(state.speed):
            return Decision(Command(np.zeros(0)), np.zeros(0), np.zeros(0), None, memory)
        headways = self.expert.time_gaps(state, memory)
        command = Command(self._limits.clip(self._expert_acceleration + self.actions), headways)
        return Decision(command, self._expert_acceleration, self.actions, None, self._next_memory)


@dataclass(frozen=True)
class RoadStepResult:
    """What one decision led to."""

    cav_ids: list[str]
    """who is on the road now"""
    observations: Observations
    """theirs, shape (CAVs, numbers)"""
    departed: dict[str, Observations]
    """who left the road in this decision, with what each saw before it"""
    reward: float
    reward_terms: dict[str, float]
    """the reward's terms by name"""
    terminated: bool
    """whether there was a collision"""
    truncated: bool
    """whether the horizon is reached, or no CAV will be on the road any more"""


class RoadStepper:
    """A road whose CAVs get their accelerations from outside, one decision at a time."""

    def __init__(
        self,
        scenario: str,
        changes: dict[str, Any],
        reward: str = "",
        expert: str = "",
        features: Sequence[FeatureName] = ("local",),
        backend: Backend = "libsumo",
    ) -> None:
        """Prepare a road as `RoadEnv` says; SUMO runs as `backend`, and is opened by the first `reset`."""
        self.scenario = make_scenario(scenario, changes)
        self._reward = make_reward(reward or self.scenario.reward)
        driver = make_expert(expert, self.scenario.control_step) if expert else Constant()
        self._driver = ExternalDriver(driver, features, self.scenario.acceleration_limits)
        check_can_drive(driver, self.scenario)
        if isinstance(features, str) or not features:
            raise invalid_value("features", features, "a list of features, like ('local', 'expert_acceleration')")
        check_features(features)
        check_policy_inputs(self._driver.features, self.scenario, "features")
        self._backend: Backend = backend
        self._simulation: Simulation | None = None
        self._traffic: Traffic | None = None
        bound = np.full(observation_size(self._driver.features, driver), MAX_OBSERVATION, np.float32)
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float32)
        """of one CAV"""
        low, high = (np.full(1, limit, np.float32) for limit in self.scenario.acceleration_limits)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        """of one CAV: acceleration [m/s2]"""
        self._seed: int | None = None
        self._episode_count = 0
        """started since that seed was given"""
        self.lock = CopyableLock()
        """held while the environment is called"""

    def reset(self, seed: int | None, generator: np.random.Generator) -> Observations:
        """Start an episode, run its warm-up, and return the first observations.

        It is that of `seed`; without one, the next after the last seed's, the first of all from `generator`.
        """
        if seed is not None:
            self._seed, self._episode_count = seed, 0
        if self._seed is None:
            self._seed = int(generator.integers(2**31))
        numbers = (self._seed, self._episode_count) if self._episode_count else (self._seed,)
        self._episode_count += 1
        if self._simulation is not None and self._simulation.is_lost:
            self.close()
        if self._simulation is None:
            own = self._backend == "libsumo"
            self._simulation = open_simulation(self.scenario) if own else Simulation(self._backend)
        self._traffic = traffic = make_traffic(
            self.scenario, numbers, self._simulation, measured_fields=self._driver.measured_fields
        )
        self._drive_loop = DriveLoop(traffic, self._driver)
        self._control_steps = iter(self._drive_loop)
        self._wait_for_cav()
        if not traffic.cav_ids:
            raise EpisodeError(f"no CAV entered the road in {traffic.control_steps} decisions")
        return self._observe()

    def step(self, actions: Any) -> RoadStepResult:
        """Make one decision: `actions`, shape (CAVs,), added to the expert's accelerations [m/s2].

        Where nobody is left, the road goes on without CAVs until the next one enters.
        """
        traffic, before, seen = self.traffic, list(self.traffic.cav_ids), self._observations
        self._driver.actions = np.asarray(actions, np.float64)
        if next(self._control_steps, None) is None:
            raise UnjamError("step: the episode is over; allowed: reset")
        kept = list(range(len(before)) if traffic.remaining_rows is None else traffic.remaining_rows)
        speeds, state = np.array(traffic.speeds), traffic.exact_state()
        headways = time_gap(state.leader_gap, state.speed)[: len(kept)]
        applied = traffic.last_applied_acceleration()[kept]
        crashed, waiting = np.array([traffic.has_crashed]), np.array([float(traffic.backlog)])
        outcome = Outcome(speeds[None], applied[None], headways[None], crashed, waiting)
        decision = slice(traffic.control_steps - 1, traffic.control_steps)
        terms = {name: float(one) for name, (one,) in validate_reward_terms(self._reward(outcome), decision).items()}
        left = {name: seen[row] for row, name in enumerate(before) if row not in kept}
        terminated = traffic.has_crashed
        self._wait_for_cav()  # a crash of people meanwhile ends the episode, but is nobody's doing
        truncated = not terminated and (traffic.has_ended or not traffic.cav_ids)
        observations = self._observe()
        return RoadStepResult(
            list(traffic.cav_ids), observations, left, sum(terms.values()), terms, terminated, truncated
        )

    def _wait_for_cav(self) -> None:
        """Let the road go on until a CAV is on it, or none will be before the episode ends."""
        traffic = self.traffic
        while traffic.expects_cavs and not (traffic.cav_ids or traffic.has_ended):
            next(self._control_steps)

    @property
    def traffic(self) -> Traffic:
        """The traffic of the running episode.

        Raises:
            UnjamError: there is none.
            LostError: other code in this process has started, stepped or closed a simulation through libsumo.
        """
        if self._traffic is None:
            raise UnjamError("no episode is running: call reset first")
        assert self._simulation is not None
        self._simulation.check()
        return self._traffic

    def _observe(self) -> Observations:
        """Return what each CAV observes now."""
        seen = self._driver.observation(self.traffic.local_state(), self._drive_loop.memory)
        self._observations = seen.clip(-MAX_OBSERVATION, MAX_OBSERVATION).astype(np.float32)
        return self._observations

    def close(self) -> None:
        """End SUMO; may be called twice."""
        self._traffic = None
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None


class RoadEnv(gymnasium.Env[Observations, NDArray[Any]]):
    """One CAV among people, on the actual simulator.

    ``gymnasium.make("unjam/Ring-v0")``, ``"unjam/FigureEight-v0"``, ``"unjam/Merge-v0"``,
    ``"unjam/OnRamp-v0"``; every parameter of
    the scenario can be given: ``gymnasium.make("unjam/Ring-v0", scenario="ring-jammed", length=(230, 230))``.
    On a network of your own the CAV is the first that the share picks, in a confined process:
    ``gymnasium.make("unjam/UserNetwork-v0", scenario="my.sumocfg", penetration_rate=0.1)``.

    ===========  ===================================================================================
    Action       ``Box(-limit, limit, (1,), float32)``: acceleration [m/s2], limit 1 by default; with
                 ``expert``, what is added to the expert's
    Observation  ``Box(-50, 50, (5,), float32)``: own speed / 10 m/s; leader's speed - own / 5 m/s; gap
                 to the leader / 20 m; follower's speed - own / 5 m/s; gap to the follower / 20 m; more
                 with ``observe``
    Reward       the scenario's, or ``reward``; its terms are in ``info["reward_terms"]``
    Start        ``reset(seed=s)`` starts the very episode that ``unjam drive --seed s`` runs, warm-up
                 included
    Terminated   at a collision
    Truncated    at the horizon; on the merge also when the CAV leaves the road
    Time step    one decision: 0.1 s, on the merge 1 s
    ===========  ===================================================================================

    libsumo runs one simulation in a process: where the user or another environment has it, SUMO runs in a
    process of its own, several times slower, and a warning says so. A second thread waits until the first
    has returned.
    For several at once use ``gymnasium.make_vec("unjam/Ring-v0", num_envs=4, vectorization_mode="async")``.
    """

    metadata: ClassVar[dict[str, Any]] = {  # pyright: ignore[reportIncompatibleVariableOverride]
        "render_modes": ["human", "rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        scenario: str = "ring",
        reward: str = "",
        expert: str = "",
        features: Sequence[FeatureName] = ("local",),
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        """Prepare the environment; SUMO is opened by the first `reset`.

        Args:
            scenario: its name.
            reward: a name or `path.py:name`; empty: the scenario's own.
            expert: a driver to whose acceleration actions are added, named as in `unjam drive --driver`.
            observe: parts of the observation: `local`, `expert_acceleration`, `expert_memory`, `loop_length`,
                `place`.
            render_mode: `rgb_array`, or `human` for SUMO's own window.
            changes: to the scenario's parameters.

        Raises:
            InputError: something of it is wrong, or the road has several CAVs.
            MissingPartError: a window is asked for where there is no display.
        """
        if render_mode not in (None, "human", "rgb_array"):
            raise unknown_name("render_mode", render_mode, ("human", "rgb_array"))
        if render_mode == "human" and not has_display():
            raise MissingPartError("render_mode: 'human' needs a display; without one: 'rgb_array'")
        self.render_mode = render_mode
        backend = "gui" if render_mode == "human" else "libsumo"
        self._road = RoadStepper(scenario, changes, reward, expert, features, backend)
        if getattr(self._road.scenario, "cavs", None) != 1:
            raise InputError("cavs: several are not allowed here; allowed: 1; use unjam.parallel_env")
        self.observation_space = self._road.observation_space
        self.action_space = self._road.action_space

    @synchronized
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode: that of `seed`; without one, the next after the last seed's."""
        super().reset(seed=seed)
        observations = self._road.reset(seed, self.np_random)
        return observations[0], {"drawn_values": dict(self._road.traffic.road.drawn_values)}

    @synchronized
    def step(self, action: Any) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Make one decision."""
        done = self._road.step(np.asarray(action, np.float64).reshape(1))
        observation = next(iter(done.departed.values())) if done.departed else done.observations[0]
        truncated = done.truncated or (bool(done.departed) and not done.terminated)
        return observation, done.reward, done.terminated, truncated, {"reward_terms": done.reward_terms}

    @synchronized
    def render(self) -> Any:
        """Return the picture of this moment, shape (640, 640, 3); SUMO's window draws itself."""
        if self.render_mode != "rgb_array":
            return None
        from unjam.reports.video import draw_road

        traffic = self._road.traffic
        limit = traffic.road.limit_speed
        fastest = 2.0 * limit if np.isfinite(limit) else self._road.scenario.top_speed  # of your own: unknown
        return np.asarray(draw_road(traffic.scene(), fastest, f"mean {np.mean(traffic.speeds):.1f} m/s"))

    @synchronized
    def close(self) -> None:
        """End SUMO; may be called twice."""
        self._road.close()
