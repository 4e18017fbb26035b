"""Agents of a user, in a file of their own: a learner and an algorithm, neither of which needs Stable-Baselines3."""

from typing import Any

import numpy as np
import torch

from unjam.drivers.network import Network
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Collector, IterationLog, Tensors
from unjam.learners.experience import discounted_returns
from unjam.learners.learner import Learner, Update


def linear_network(weights: np.ndarray, authority: float, exploration_std: float) -> Network:
    return Network(((weights[:-1, None], weights[-1:]),), authority, exploration_std)


class Reinforce(Learner):
    """REINFORCE with a linear policy."""

    def __init__(self, spec: AgentSpec, learning_rate: float = 0.05) -> None:
        self.spec, self.learning_rate = spec, learning_rate
        self.weights = np.zeros(spec.inputs + 1)

    def network(self) -> Network:
        return linear_network(self.weights, self.spec.authority, self.spec.exploration_std)

    def learn(self, update: Update) -> None:
        rows, authority = update.rows, self.spec.authority
        inputs = np.hstack([rows.observations[:, : self.spec.inputs], np.ones((len(rows.rewards), 1))])
        squashed, returns = np.tanh(inputs @ self.weights), discounted_returns(rows, self.spec.gamma)
        advantages = (returns - returns.mean()) / (returns.std() + 1e-9)
        deviation = (rows.actions - authority * squashed) / self.spec.exploration_std**2
        scores = (deviation * authority * (1.0 - squashed**2))[:, None] * inputs
        self.weights = self.weights + self.learning_rate * advantages @ scores / len(scores)

    def state(self) -> tuple[dict[str, Any], Tensors]:
        return {}, {"weights": torch.from_numpy(self.weights)}

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        self.weights = tensors["weights"].numpy()


class EvolutionStrategy:
    """Evolution strategies with antithetic pairs of linear policies, which drive the same traffic."""

    def __init__(self, spec: AgentSpec, pairs: int = 2, step: float = 0.1) -> None:
        self.spec, self.pairs, self.step = spec, pairs, step
        self.weights, self.best = np.zeros(spec.inputs + 1), float("-inf")

    def network(self) -> Network:
        return linear_network(self.weights, self.spec.authority, 0.0)

    def iterate(self, collect: Collector) -> IterationLog:
        gradient = np.zeros_like(self.weights)
        for direction in np.random.standard_normal((self.pairs, len(self.weights))):
            for sign in (1.0, -1.0):
                shifted = self.weights + sign * self.step * direction
                (episodes,) = collect(linear_network(shifted, self.spec.authority, 0.0))
                value = float(np.mean([episode.reward.sum() for episode in episodes]))
                gradient += sign * value * direction
                self.best = max(self.best, value)
        self.weights = self.weights + self.step * gradient / max(np.abs(gradient).max(), 1e-9)
        return IterationLog({"best_return": self.best})

    def state(self) -> tuple[dict[str, Any], Tensors]:
        return {"best": self.best}, {"weights": torch.from_numpy(self.weights)}

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        self.best, self.weights = values["best"], tensors["weights"].numpy()
