"""A task without a road, quick to learn: be at the target, which the observation tells."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from unjam.drivers import LocalState, PISaturation
from unjam.drivers.network import Network
from unjam.learners.algorithm_1 import Collected, Iteration, Training, Validated, algorithm_1
from unjam.learners.learner import AgentSpec, make_learner
from unjam.learners.settings import (
    LearnerSettings,
    PolicySettings,
    PPOSettings,
    SACSettings,
    TD3Settings,
    TRPOSettings,
)
from unjam.scenarios import Ring
from unjam.worlds.episode import Task
from unjam.worlds.record import Episode, Trajectory

INPUTS, DECISIONS = 2, 100
LENGTHS = (220.0, 270.0)
QUICK: dict[str, LearnerSettings] = {
    "trpo": TRPOSettings(critic_epochs=3),
    "ppo": PPOSettings(epochs=5),
    "sac": SACSettings(start_steps=0, updates_per_step=0.01, batch=16, buffer_rows=1000),
    "td3": TD3Settings(start_steps=0, updates_per_step=0.01, batch=16, buffer_rows=1000),
}
"""settings with which each learner is quick"""

Target = Callable[[np.ndarray], np.ndarray]


def constant_target(observations: np.ndarray) -> np.ndarray:
    return np.full(len(observations), 0.4)


def sloped_target(observations: np.ndarray) -> np.ndarray:
    return 0.5 * observations[:, 0]


def episode_of(network: Network, seed: tuple[int, ...], hold: int, target: Target) -> Episode:
    """An episode in which a residual is held for `hold` decisions."""
    generator = np.random.default_rng(seed)
    choices = DECISIONS // hold
    observations = generator.uniform(-1.0, 1.0, size=(choices + 1, INPUTS))
    chosen = network.explore(observations[:-1], generator.normal(size=choices))
    residual = np.repeat(chosen, hold)
    wanted = np.repeat(target(observations[:-1]), hold)
    nothing = np.zeros(DECISIONS)
    trajectory = Trajectory(
        vehicle="cav_0",
        start=0,
        states=LocalState(*[np.zeros(DECISIONS + 1)] * len(LocalState._fields)),
        observations=observations,
        expert=nothing,
        residual=residual,
        applied=residual,
        shield=nothing,
        terms={"near": -((residual - wanted) ** 2)},
        memory={},
        hold=hold,
        terminated=False,
    )
    drawn = {"length": LENGTHS[seed[-1] % 2]}
    speeds = np.zeros((DECISIONS + 1, 1))
    return Episode(seed=seed, status="completed", drawn=drawn, speeds=speeds, trajectories=(trajectory,))


@dataclass
class Toy:
    """A learner of the task, and what its iterations told."""

    policy: PolicySettings = field(default_factory=lambda: PolicySettings(hidden=(16,), exploration_std=0.2))
    settings: LearnerSettings | None = None
    agent: str = "trpo"
    seed: int = 0
    target: Target = constant_target
    episodes: int = 8
    hold: int = 1
    iterations: list[Iteration] = field(default_factory=list)
    networks: list[Network] = field(default_factory=list)

    def __post_init__(self) -> None:
        spec = AgentSpec(INPUTS, int(self.policy.critic_sees_road), 1.0, self.policy, self.seed)
        self.learner = make_learner(self.settings or QUICK[self.agent], spec)
        self.training = Training([Task(Ring(), PISaturation())], self.policy, self.seed, self.learner)

    def collect(self, network: Network, iteration: int) -> Collected:
        self.networks.append(network)
        return [
            [
                episode_of(network, (self.seed, iteration, index), self.hold, self.target)
                for index in range(self.episodes)
            ]
        ]

    def run(self, actual_steps: int) -> None:
        algorithm_1(self.training, actual_steps, self.collect, lambda _: None, self.write)

    def write(self, iteration: Iteration, _: Validated) -> None:
        self.iterations.append(iteration)

    def learn(self, iterations: int) -> "Toy":
        self.run(iterations * self.episodes * DECISIONS)
        return self

    def parameters(self) -> dict[str, torch.Tensor]:
        return self.training.state()[1]


def mean_return(iteration: Iteration) -> float:
    return float(np.mean([episode.trajectories[0].reward.sum() for episode in iteration.episodes[0]]))


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    """Whether both are the same to the last bit, NaN included."""
    return one.keys() == other.keys() and all(
        one[name].numpy().tobytes() == other[name].numpy().tobytes() for name in one
    )
