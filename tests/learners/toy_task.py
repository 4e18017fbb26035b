"""A task without a road that is quick to learn, its target being a function of the observation; and policies."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.policies import BasePolicy

from unjam.drivers import LocalState, PISaturation
from unjam.drivers.local_state import COMMON_FIELDS
from unjam.drivers.network import Network
from unjam.learners.agent import AgentSpec, make_agent
from unjam.learners.algorithm import Collector, IterationLog, TaskEpisodes, run_iterations
from unjam.learners.algorithm_1 import Algorithm1
from unjam.learners.sb3_learner import policy_spaces
from unjam.learners.settings import LearnerSettings, PolicySettings, PPOSettings, SACSettings, TD3Settings, TRPOSettings
from unjam.models.settings import ModelSettings
from unjam.scenarios import Ring
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Trajectory

INPUTS, CONTROL_STEPS = 2, 100
LENGTHS = (220.0, 270.0)
QUICK: dict[str, LearnerSettings] = {
    "trpo": TRPOSettings(critic_epochs=3),
    "ppo": PPOSettings(epochs=5),
    "sac": SACSettings(learning_starts=0, gradient_steps_per_step=0.01, batch_size=16, buffer_size=1000),
    "td3": TD3Settings(learning_starts=0, gradient_steps_per_step=0.01, batch_size=16, buffer_size=1000),
}
"""settings with which each learner is quick"""

Target = Callable[[np.ndarray], np.ndarray]
Policy = TypeVar("Policy", bound=BasePolicy)
of_any_size = given(
    seed=st.integers(0, 2**31),
    inputs=st.integers(1, 9),
    hidden=st.lists(st.integers(1, 64), min_size=1, max_size=3),
    authority=st.floats(0.1, 2.0),
    rows=st.integers(1, 40),
)
"""parameters of policies of any size, and a number of rows"""


def constant_target(observations: np.ndarray) -> np.ndarray:
    return np.full(len(observations), 0.4)


def sloped_target(observations: np.ndarray) -> np.ndarray:
    return 0.5 * observations[:, 0]


def episode_of(network: Network, seed: tuple[int, ...], action_repeat: int, target: Target) -> Episode:
    """Return an episode in which each residual is repeated."""
    generator = np.random.default_rng(seed)
    action_count = CONTROL_STEPS // action_repeat
    observations = generator.uniform(-1.0, 1.0, size=(action_count + 1, INPUTS))
    residuals = network.explore(observations[:-1], generator.normal(size=action_count))
    residual = np.repeat(residuals, action_repeat)
    targets = np.repeat(target(observations[:-1]), action_repeat)
    zeros = np.zeros(CONTROL_STEPS)
    trajectory = Trajectory(
        vehicle="cav_0",
        start_step=0,
        states=LocalState(*[np.zeros(CONTROL_STEPS + 1)] * len(COMMON_FIELDS)),
        observations=observations,
        expert_acceleration=zeros,
        residual=residual,
        applied_acceleration=residual,
        filter_braking=zeros,
        shield_braking=zeros,
        reward_terms={"near": -((residual - targets) ** 2)},
        initial_memory={},
        action_repeat=action_repeat,
        terminated=False,
    )
    drawn = {"length": LENGTHS[seed[-1] % 2]}
    speeds = np.zeros((CONTROL_STEPS + 1, 1))
    return Episode(seed=seed, status="completed", drawn_values=drawn, speeds=speeds, trajectories=(trajectory,))


@dataclass
class Iteration:
    """The result of an iteration, numbered from 1; steps are totals of all iterations so far."""

    number: int
    environment_steps: int
    episodes: TaskEpisodes
    log: dict[str, float]
    model_steps: int
    model: Any
    seconds: dict[str, float]


def iteration_of(collect: Collector, log: IterationLog) -> Iteration:
    steps = collect.iteration, collect.environment_steps
    return Iteration(*steps, collect.episodes, dict(log.values), log.model_steps, log.model, dict(log.seconds))


class ToySpec(AgentSpec):
    @property
    def inputs(self) -> int:
        return INPUTS


@dataclass
class Toy:
    """A learner of the task, and its iterations."""

    policy: PolicySettings = field(default_factory=lambda: PolicySettings(hidden=(16,), exploration_std=0.2))
    settings: LearnerSettings | None = None
    agent: str = "trpo"
    seed: int = 0
    target: Target = constant_target
    episodes: int = 8
    action_repeat: int = 1
    string_gain: Callable[[Network], float] | None = None
    iterations: list[Iteration] = field(default_factory=list)
    networks: list[Network] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = self.settings or QUICK[self.agent]
        model = ModelSettings(model_ratio=0.0)
        tasks = [Task(Ring(), PISaturation())]
        self.spec = ToySpec(tasks, self.policy, model, settings.gamma, self.seed, self.string_gain)
        self.learner = make_agent(self.agent, settings, self.spec)
        self.algorithm = Algorithm1(self.spec, self.learner)
        self.collector = Collector(self.collect)

    def collect(self, network: Network, iteration: int) -> TaskEpisodes:
        self.networks.append(network)
        return [
            [
                episode_of(network, (self.seed, iteration, index), self.action_repeat, self.target)
                for index in range(self.episodes)
            ]
        ]

    def run(self, environment_steps: int) -> None:
        run_iterations(self.algorithm, self.collector, environment_steps, self.seed, self.write)

    def write(self, log: IterationLog) -> None:
        self.iterations.append(iteration_of(self.collector, log))

    def resume(self, state: Any, iteration: int) -> None:
        """Continue from a state after a number of iterations."""
        self.algorithm.restore(*state)
        self.collector.iteration = iteration
        self.collector.environment_steps = iteration * self.episodes * CONTROL_STEPS

    def learn(self, iterations: int) -> "Toy":
        self.run(iterations * self.episodes * CONTROL_STEPS)
        return self

    def parameters(self) -> dict[str, torch.Tensor]:
        return self.algorithm.state()[1]


def mean_return(iteration: Iteration) -> float:
    return float(np.mean([episode.trajectories[0].reward.sum() for episode in iteration.episodes[0]]))


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """Whether both are the same to the last bit, NaN included."""
    return one.keys() == other.keys() and all(
        one[name].numpy().tobytes() == other[name].numpy().tobytes() for name in one
    )


def make_policy(
    kind: Callable[..., Policy],
    settings: PolicySettings | None = None,
    inputs: int = 5,
    critic_inputs: int = 0,
    action_limit: float = 1.0,
    seed: int = 0,
) -> Policy:
    settings = settings or PolicySettings()
    torch.manual_seed(seed)
    spaces = policy_spaces(inputs, critic_inputs, settings.authority * action_limit)
    return kind(*spaces, lambda _: 1e-3, settings=settings, inputs=inputs, action_limit=action_limit)


def residual_of(policy: Any, rows: np.ndarray) -> np.ndarray:
    """The deterministic residual [m/s2] of a squashed policy, as SB3 unscales it from [-1, 1]."""
    with torch.no_grad():
        return policy.unscale_action(policy._predict(torch.as_tensor(rows), deterministic=True).numpy())[:, 0]


def shake(policy: torch.nn.Module, seed: int, scale: float = 1.0) -> None:
    """Give every weight a random value that keeps the units of a layer about as large as its inputs."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in policy.parameters():
            fan_in = parameter.shape[-1] if parameter.dim() == 2 else 4
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * scale / math.sqrt(fan_in))


def random_rows(rows: int, inputs: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2.0, 2.0, size=(rows, inputs)).astype(np.float32)
