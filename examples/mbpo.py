"""MBPO (Janner et al. 2019, arXiv:1906.08253) as an algorithm of a user's own.

Short rollouts branch off states of D_a in the package's learned model of rows, and soft actor-critic learns from
batches that mix environment and model rows: `unjam train ring --agent examples/mbpo.py:MBPO`, with options such as
`--set user.options.rounds=10`.
"""

from dataclasses import replace
from typing import Any

from unjam.drivers.network import Network
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Collector, IterationLog, Tensors, seed_iteration, tensors_with_prefix
from unjam.learners.experience import environment_experience, join_experience
from unjam.learners.learner import Update
from unjam.learners.model_rollouts import ModelRollouts
from unjam.learners.sac_td3 import SAC
from unjam.learners.settings import SACSettings


class MBPO:
    """Model-based policy optimization with the learners and models of the package."""

    def __init__(
        self,
        spec: AgentSpec,
        rounds: int = 4,
        rollout_steps: int = 50,
        real_ratio: float = 0.2,
        gradient_steps: int = 20,
        **sac: Any,
    ) -> None:
        """Make an agent with `rounds` of rollouts of `rollout_steps` control steps in each iteration.

        Each round ends with `gradient_steps` on batches with a share `real_ratio` of environment rows.
        """
        model = replace(spec.model, k_max=rollout_steps, rollout_starts="all")
        self.spec = replace(spec, model=model)
        self.settings = SACSettings(gamma=spec.gamma, **({"learning_starts": 0} | sac))
        self.sac = SAC(self.spec, self.settings)
        self.models = [ModelRollouts(self.spec, index) for index in range(len(spec.tasks))]
        self.rounds, self.real_ratio, self.gradient_steps = rounds, real_ratio, gradient_steps

    def network(self) -> Network:
        """Return the policy."""
        return self.sac.network()

    def iterate(self, collect: Collector) -> IterationLog:
        """Drive, fit the models, and learn from short model rollouts of the newest policy."""
        episodes = collect(self.sac.exploring_network(collect.environment_steps))
        rows = environment_experience(self.spec, episodes, collect.iteration)
        if collect.iteration == 1:
            self.sac.set_value_scale(rows)
        for model, own in zip(self.models, episodes, strict=True):
            model.learn(own, collect.iteration)
        self.sac.learn(Update(rows, None, 1.0, collect.environment_steps))  # into the replay buffer
        for number in range(self.rounds):
            parts = [each.roll_out(self.network(), collect.iteration, number, self.rounds) for each in self.models]
            branched = [part for part in parts if part is not None]
            seed_iteration(self.spec.seed, collect.iteration, number)
            if branched:
                self.learn_from_both(branched)
        self.sac.check_parameters(collect.iteration)
        model_steps = sum(model.model_steps for model in self.models)
        return IterationLog(self.sac.log(), model_steps, [model.facts for model in self.models])

    def learn_from_both(self, branched: list[Any]) -> None:
        """Update policy and critics with batches from the replay buffer and from rollouts."""
        buffer, rows = self.sac.buffer, join_experience(branched)
        self.sac.add_rows(buffer.new_model_buffer(len(rows.rewards)), rows)
        buffer.real_ratio = self.real_ratio
        self.sac.sb3.train(gradient_steps=self.gradient_steps, batch_size=self.settings.batch_size)
        buffer.model_buffer = None

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return learner and models."""
        values, tensors = self.sac.state()
        for model in self.models:
            values[model.name], own = model.state()
            tensors |= {f"{model.name}/{name}": tensor for name, tensor in own.items()}
        return values, tensors

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from what `state` returned."""
        self.sac.restore(values, tensors)
        for model in self.models:
            model.restore(values[model.name], tensors_with_prefix(f"{model.name}/", tensors))
