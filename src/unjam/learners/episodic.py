"""What all learners share: an iteration is made of whole episodes, and learned from at once.

Learners of Stable-Baselines3 are extended at the two methods that are meant for it: `collect_rollouts` gets
episodes from the workers, `train` learns from their rows.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import RolloutReturn

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.learners.divergence import Gaussians, total_variation
from unjam.learners.imagination import Imagination
from unjam.learners.policy import policy_spaces
from unjam.learners.rows import Rows, join_rows, rows_of
from unjam.learners.settings import PolicySettings
from unjam.scenarios.scenario import Scenario
from unjam.worlds.record import Episode

Collect = Callable[[Network, int], Sequence[Episode]]
"""(policy, iteration) -> the episodes of this iteration, driven with exploration"""

NEVER = 2**31
COMPARED_ROWS = 2000
"""at most so many of the visited states tell how far an update has moved the policy"""


@dataclass(frozen=True)
class Iteration:
    """What one iteration did: Algorithm 1, once around."""

    number: int
    """from 1"""
    episodes: Sequence[Episode]
    actual_steps: int
    """of all iterations so far"""
    virtual_steps: int
    """of all iterations so far"""
    virtual: dict[str, Any]
    """what there is to say of the virtual environment; empty without one"""
    log: dict[str, float]
    """what the learner says about its update"""
    seconds: dict[str, float]
    """wall time of each part"""


@dataclass(frozen=True)
class Training:
    """What a learner learns on, whichever it is."""

    inputs: int
    """how many numbers the policy sees"""
    scenario: Scenario
    policy: PolicySettings
    seed: int
    """of the whole run"""
    collect: Collect
    after_iteration: Callable[[Iteration], None]
    imagination: Imagination | None = None
    """the virtual environment; None: model-free"""


class Update(NamedTuple):
    """What one update learns from."""

    actual: Rows | None
    virtual: Rows | None
    share: float
    """of all that the iteration's updates do"""

    @property
    def rows(self) -> Rows:
        """Actual and virtual rows together."""
        return join_rows([part for part in (self.actual, self.virtual) if part is not None])


class SpacesOnly(gymnasium.Env[np.ndarray, np.ndarray]):
    """The environment that Stable-Baselines3 asks for its spaces; nobody steps it."""

    def __init__(self, observation_space: spaces.Box, action_space: spaces.Box) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self._nothing = np.zeros(observation_space.low.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return zeros: Stable-Baselines3 resets before it learns."""
        return self._nothing, {}


class Episodic(BaseAlgorithm):
    """A learner whose rollouts are whole episodes from worker processes; stands before one of SB3's."""

    def __init__(
        self,
        training: Training,
        policy: type[BasePolicy],
        policy_arguments: dict[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        """Make SB3's learner with its own `arguments`."""
        settings, scenario = training.policy, training.scenario
        critic_inputs = len(scenario.drawn_ranges) if settings.critic_sees_road else 0
        super().__init__(
            policy=policy,
            env=SpacesOnly(
                *policy_spaces(training.inputs, critic_inputs, settings.authority * scenario.action_limit)
            ),
            policy_kwargs={
                "settings": settings,
                "inputs": training.inputs,
                "action_limit": scenario.action_limit,
                **(policy_arguments or {}),
            },
            seed=training.seed,
            device="cpu",
            **arguments,
        )
        self.set_logger(Logger(None, []))
        self.training = training
        self.iteration = 0
        """iterations done"""
        self._episodes: Sequence[Episode] = ()
        self._seconds: dict[str, float] = {}

    def run(self, actual_steps: int) -> None:
        """Learn until this many actual steps were made in all, earlier runs of this learner included.

        Raises:
            UnjamError: an observation, a reward or a parameter is not finite; it names the first.
        """
        try:
            self.learn(actual_steps - self.num_timesteps, log_interval=NEVER, reset_num_timesteps=False)
        except ValueError:  # what torch says of a distribution with such a parameter
            self._check_parameters()
            raise

    def network(self) -> Network:
        """Return the policy's NumPy twin."""
        return self.policy.network()  # pyright: ignore[reportCallIssue]

    def exploring_network(self) -> Network:
        """Return the network that drives, exploring, the next episodes of this learner."""
        return self.network()

    def collect_rollouts(self, *arguments: Any, **named: Any) -> Any:
        """Collect the episodes of one iteration; count their actual steps, whatever the learner counts."""
        started = time.perf_counter()
        self.iteration += 1
        self._episodes = self.training.collect(self.exploring_network(), self.iteration)
        steps = sum(episode.steps for episode in self._episodes)
        self.num_timesteps += steps
        self._seconds = {"actual": time.perf_counter() - started}
        # What off-policy learners of SB3 ask for; the others ask only whether it is true.
        return RolloutReturn(steps, len(self._episodes), continue_training=True)

    def measure_units(self, rows: Rows) -> None:
        """Take the units of returns from the first iteration's actual rows."""

    def gaussians(self, observations: torch.Tensor) -> Gaussians:
        """Return the distribution of the residual at these observations, before any squashing."""
        raise NotImplementedError

    @property
    def wants_virtual(self) -> bool:
        """Whether virtual rows are of use in this iteration."""
        return True

    def updates(self) -> Iterator[Update]:
        """Yield what to learn from, one update after the other; then tell of the iteration.

        Actual rows alone are what units come from. Virtual rows are those of the policy as it is then.
        """
        imagination = self.training.imagination
        actual = self._rows()
        for name in ("observations", "rewards"):
            if not np.isfinite(getattr(actual, name)).all():
                raise UnjamError(f"learner: {name} of iteration {self.iteration} are not finite")
        if self.iteration == 1:
            self.measure_units(actual)
        some = torch.as_tensor(actual.observations[:: -(-len(actual.rewards) // COMPARED_ROWS)])
        before = self.gaussians(some)
        self._seconds |= dict.fromkeys(("fit", "imagine", "update") if imagination else ("update",), 0.0)
        if imagination is None:
            yield from self._timed([Update(actual, None, 1.0)])
        else:
            with self._timing("fit"):
                imagination.learn(self._episodes, self.iteration)
            yield from self._timed(self._with_virtual(actual, imagination))
        log = {key.partition("/")[2]: float(value) for key, value in self.logger.name_to_value.items()}
        distances = total_variation(before, self.gaussians(some))
        log |= {"eps_pi_mean": float(distances.mean()), "eps_pi_max": float(distances.max())}
        if imagination is not None:
            bound = imagination.bound(log["eps_pi_max"], self.gamma)  # pyright: ignore[reportAttributeAccessIssue]
            imagination.facts["bound"] = bound
        self.training.after_iteration(
            Iteration(
                self.iteration,
                self._episodes,
                self.num_timesteps,
                imagination.steps if imagination else 0,
                imagination.facts if imagination else {},
                log,
                self._seconds,
            )
        )

    def _with_virtual(self, actual: Rows, imagination: Imagination) -> Iterator[Update]:
        """Yield the updates of an iteration with a virtual environment."""
        settings = imagination.settings

        def imagined(part: int = 0, parts: int = 1) -> Rows | None:
            with self._timing("imagine"):
                return imagination.imagine(self.network(), self.iteration, part, parts)

        if not self.wants_virtual:
            yield Update(actual, None, 1.0)
        elif settings.update == "union":
            yield Update(actual, imagined(), 1.0)
        else:
            parts = settings.updates
            yield Update(actual, None, 1.0 / (parts + 1))
            for part in range(parts):
                rows = imagined(part, parts)
                if rows is not None:
                    yield Update(None, rows, 1.0 / (parts + 1))

    def _timed(self, updates: Iterable[Update]) -> Iterator[Update]:
        """Yield updates, and count the time until the next one is asked for as that of the update."""
        for update in updates:
            seed_iteration(self.training.seed, self.iteration)
            with self._timing("update"):
                yield update
            self._check_parameters()

    def _check_parameters(self) -> None:
        """Raise `UnjamError` where an update has made a parameter that is not finite."""
        for name, parameter in self.policy.named_parameters():
            if not parameter.isfinite().all():
                raise UnjamError(f"learner: {name} is not finite in iteration {self.iteration}")

    @contextmanager
    def _timing(self, part: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self._seconds[part] += time.perf_counter() - started

    def _rows(self) -> Rows:
        scenario, sees_road = self.training.scenario, self.training.policy.critic_sees_road
        pairs = [
            (trajectory, scenario.drawn_scaled(episode.drawn) if sees_road else ())
            for episode in self._episodes
            for trajectory in episode.trajectories
        ]
        return rows_of([trajectory for trajectory, _ in pairs], [extra for _, extra in pairs])


def seed_iteration(run_seed: int, iteration: int) -> None:
    """Seed every generator that an update uses, from the run's seed and the iteration alone.

    So a run that goes on from a checkpoint draws what the uninterrupted one would have drawn.
    """
    torch_seed, numpy_seed = np.random.SeedSequence([run_seed, iteration, 1]).generate_state(2)
    torch.manual_seed(int(torch_seed))
    np.random.seed(int(numpy_seed))
