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
from unjam.drivers.driver import Decision, Driver, Memory, Noise
from unjam.drivers.local_state import LocalState
from unjam.drivers.observation import FeatureName, Seen, asked_by, check_features, observation_size, observe
from unjam.environments.threads import CopyableLock, one_thread_at_a_time
from unjam.errors import EpisodeError, InputError, MissingPartError, UnjamError, wrong, wrong_name
from unjam.processes import has_display
from unjam.scenarios import make_scenario
from unjam.worlds.drive import Drive
from unjam.worlds.earned import checked_terms
from unjam.worlds.episode import check_can_drive, check_can_see
from unjam.worlds.reward import Outcome, make_reward, time_headway
from unjam.worlds.sumo import make_traffic
from unjam.worlds.sumo.apart import simulation_for
from unjam.worlds.sumo.library import Backend
from unjam.worlds.sumo.simulation import Simulation
from unjam.worlds.sumo.traffic import Traffic

Observations = NDArray[np.float32]

LARGEST_OBSERVATION = 50.0
"""bound of every number of an observation; larger ones are cut"""


class Outside(Driver):
    """An expert to whose accelerations somebody outside adds: `actions`, set before each decision."""

    def __init__(self, expert: Driver, names: Sequence[FeatureName], limits: Limits) -> None:
        """Let `expert` drive within `limits`; features `names` are what is shown outside."""
        self.expert, self.names, self._within = expert, tuple(names), limits
        self.actions: Any = np.zeros(0)
        """[m/s2], shape (CAVs,)"""

    @property
    def asks(self) -> frozenset[str]:
        """What the expert and the features look at."""
        return self.expert.asks | asked_by(self.names)

    @property
    def sees(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What is shown outside, and what networks in the expert see."""
        return (*self.names, *self.expert.sees)

    def initial_memory(self, n: int) -> Memory:
        """Return the expert's."""
        return self.expert.initial_memory(n)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the expert makes of the warm-up."""
        return self.expert.recall(memory, history)

    def observation(self, state: LocalState, memory: Memory) -> Any:
        """Return what is shown outside now, shape (CAVs, numbers), and keep what the expert wants."""
        wanted, self._after = self.expert.act(state, memory)
        self._wanted = self._within.keep(wanted)
        return observe(self.names, Seen(state, self._wanted, self.expert, self._after))

    def decide(self, state: LocalState, memory: Memory, noise: Noise | None = None) -> Decision:
        """Return the sum of what the expert wanted when it was looked at and what was added since."""
        if not len(state.speed):
            return Decision(Command(np.zeros(0)), np.zeros(0), np.zeros(0), None, memory)
        headways = self.expert.time_headways(state, memory)
        command = Command(self._within.keep(self._wanted + self.actions), headways)
        return Decision(command, self._wanted, self.actions, None, self._after)


@dataclass(frozen=True)
class Step:
    """What one decision led to."""

    cavs: list[str]
    """who is on the road now"""
    observations: Observations
    """theirs, shape (CAVs, numbers)"""
    left: dict[str, Observations]
    """who left the road in this decision, with what each saw before it"""
    reward: float
    terms: dict[str, float]
    """the reward's terms by name"""
    terminated: bool
    """whether there was a collision"""
    truncated: bool
    """whether the horizon is reached, or no CAV will be on the road any more"""


class SteppedRoad:
    """A road whose CAVs get their accelerations from outside, one decision at a time."""

    def __init__(
        self,
        scenario: str,
        changes: dict[str, Any],
        reward: str = "",
        expert: str = "",
        observe_parts: Sequence[FeatureName] = ("local",),
        backend: Backend = "libsumo",
    ) -> None:
        """Prepare a road as `RoadEnv` says; SUMO runs as `backend`, and is opened by the first `reset`."""
        self.scenario = make_scenario(scenario, changes)
        self._reward = make_reward(reward or self.scenario.reward)
        driver = make_expert(expert, self.scenario.decision_step) if expert else Constant()
        self._driver = Outside(driver, observe_parts, self.scenario.limits)
        check_can_drive(driver, self.scenario)
        if isinstance(observe_parts, str) or not observe_parts:
            raise wrong("observe", observe_parts, "a list of features, like ('local', 'expert_acceleration')")
        check_features(observe_parts)
        check_can_see(self._driver.names, self.scenario, "observe")
        self._backend: Backend = backend
        self._simulation: Simulation | None = None
        self._traffic: Traffic | None = None
        bound = np.full(observation_size(self._driver.names, driver), LARGEST_OBSERVATION, np.float32)
        self.observation_space = spaces.Box(-bound, bound, dtype=np.float32)
        """of one CAV"""
        low, high = (np.full(1, limit, np.float32) for limit in self.scenario.limits)
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        """of one CAV: acceleration [m/s2]"""
        self._seed: int | None = None
        self._episodes = 0
        """started since that seed was given"""
        self.lock = CopyableLock()
        """held while the environment is called"""

    def reset(self, seed: int | None, generator: np.random.Generator) -> Observations:
        """Start an episode, run its warm-up, and return the first observations.

        It is that of `seed`; without one, the next after the last seed's, the first of all from `generator`.
        """
        if seed is not None:
            self._seed, self._episodes = seed, 0
        if self._seed is None:
            self._seed = int(generator.integers(2**31))
        numbers = (self._seed, self._episodes) if self._episodes else (self._seed,)
        self._episodes += 1
        if self._simulation is not None and self._simulation.is_lost:
            self.close()
        if self._simulation is None:
            own = self._backend == "libsumo"
            self._simulation = simulation_for(self.scenario) if own else Simulation(self._backend)
        self._traffic = traffic = make_traffic(
            self.scenario, numbers, self._simulation, asked=self._driver.asks
        )
        self._drive = Drive(traffic, self._driver)
        self._decisions = iter(self._drive)
        self._await_cav()
        if not traffic.cavs:
            raise EpisodeError(f"no CAV entered the road in {traffic.decisions} decisions")
        return self._look()

    def step(self, actions: Any) -> Step:
        """Make one decision: `actions`, shape (CAVs,), added to the expert's accelerations [m/s2].

        Where nobody is left, the road goes on without CAVs until the next one enters.
        """
        traffic, before, seen = self.traffic, list(self.traffic.cavs), self._seen
        self._driver.actions = np.asarray(actions, np.float64)
        if next(self._decisions, None) is None:
            raise UnjamError("step: the episode is over; allowed: reset")
        kept = list(range(len(before)) if traffic.kept is None else traffic.kept)
        speeds, state = np.array(traffic.speeds), traffic.exact_state()
        headways = time_headway(state.leader_gap, state.speed)[: len(kept)]
        applied = traffic.last_applied()[kept]
        crashed, waiting = np.array([traffic.crashed]), np.array([float(traffic.waiting)])
        outcome = Outcome(speeds[None], applied[None], headways[None], crashed, waiting)
        decision = slice(traffic.decisions - 1, traffic.decisions)
        terms = {name: float(one) for name, (one,) in checked_terms(self._reward(outcome), decision).items()}
        left = {name: seen[row] for row, name in enumerate(before) if row not in kept}
        terminated = traffic.crashed
        self._await_cav()  # a crash of people meanwhile ends the episode, but is nobody's doing
        truncated = not terminated and (traffic.ended or not traffic.cavs)
        observations = self._look()
        return Step(list(traffic.cavs), observations, left, sum(terms.values()), terms, terminated, truncated)

    def _await_cav(self) -> None:
        """Let the road go on until a CAV is on it, or none will be before the episode ends."""
        traffic = self.traffic
        while traffic.expects_cavs and not (traffic.cavs or traffic.ended):
            next(self._decisions)

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

    def _look(self) -> Observations:
        """Return what each CAV observes now."""
        seen = self._driver.observation(self.traffic.perceive(), self._drive.memory)
        self._seen = seen.clip(-LARGEST_OBSERVATION, LARGEST_OBSERVATION).astype(np.float32)
        return self._seen

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
    ``gymnasium.make("unjam/OwnNetwork-v0", scenario="my.sumocfg", cav_share=0.1)``.

    ===========  ===================================================================================
    Action       ``Box(-limit, limit, (1,), float32)``: acceleration [m/s2], limit 1 by default; with
                 ``expert``, what is added to the expert's
    Observation  ``Box(-50, 50, (5,), float32)``: own speed / 10 m/s; leader's speed - own / 5 m/s; gap
                 to the leader / 20 m; follower's speed - own / 5 m/s; gap to the follower / 20 m; more
                 with ``observe``
    Reward       the scenario's, or ``reward``; its terms are in ``info["terms"]``
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
        observe: Sequence[FeatureName] = ("local",),
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
            raise wrong_name("render_mode", render_mode, ("human", "rgb_array"))
        if render_mode == "human" and not has_display():
            raise MissingPartError("render_mode: 'human' needs a display; without one: 'rgb_array'")
        self.render_mode = render_mode
        backend = "gui" if render_mode == "human" else "libsumo"
        self._road = SteppedRoad(scenario, changes, reward, expert, observe, backend)
        if getattr(self._road.scenario, "cavs", None) != 1:
            raise InputError("cavs: several are not allowed here; allowed: 1; use unjam.parallel_env")
        self.observation_space = self._road.observation_space
        self.action_space = self._road.action_space

    @one_thread_at_a_time
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode: that of `seed`; without one, the next after the last seed's."""
        super().reset(seed=seed)
        observations = self._road.reset(seed, self.np_random)
        return observations[0], {"drawn": dict(self._road.traffic.road.drawn)}

    @one_thread_at_a_time
    def step(self, action: Any) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Make one decision."""
        done = self._road.step(np.asarray(action, np.float64).reshape(1))
        observation = next(iter(done.left.values())) if done.left else done.observations[0]
        truncated = done.truncated or (bool(done.left) and not done.terminated)
        return observation, done.reward, done.terminated, truncated, {"terms": done.terms}

    @one_thread_at_a_time
    def render(self) -> Any:
        """Return the picture of this moment, shape (640, 640, 3); SUMO's window draws itself."""
        if self.render_mode != "rgb_array":
            return None
        from unjam.reports.film import draw_road

        traffic = self._road.traffic
        limit = traffic.road.limit_speed
        fastest = 2.0 * limit if np.isfinite(limit) else self._road.scenario.top_speed  # of your own: unknown
        return np.asarray(draw_road(traffic.scene(), fastest, f"mean {np.mean(traffic.speeds):.1f} m/s"))

    @one_thread_at_a_time
    def close(self) -> None:
        """End SUMO; may be called twice."""
        self._road.close()
