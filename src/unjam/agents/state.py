"""All that a learner must keep to go on exactly where it stopped, as plain numbers and tensors."""

from typing import Any

import torch

from unjam.agents.algorithms import EpisodicTRPO

Tensors = dict[str, torch.Tensor]


def learner_state(learner: EpisodicTRPO) -> tuple[dict[str, Any], Tensors]:
    """Return counters and tensors of a learner at the end of an iteration.

    No random state is among them: each iteration seeds its generators anew.
    """
    tensors = {f"policy.{name}": tensor for name, tensor in learner.policy.state_dict().items()}
    for index, entry in learner.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{index}.{name}": tensor for name, tensor in entry.items()}
    counters = {
        "iteration": learner.iteration,
        "actual_steps": learner.num_timesteps,
        "updates": learner._n_updates,
    }
    return counters, {name: tensor.detach().clone() for name, tensor in tensors.items()}


def restore_learner(learner: EpisodicTRPO, counters: dict[str, Any], tensors: Tensors) -> None:
    """Put a learner made from the same configuration into the state that `learner_state` returned."""
    learner.policy.load_state_dict(
        {
            name.removeprefix("policy."): tensor
            for name, tensor in tensors.items()
            if name.startswith("policy.")
        }
    )
    optimizer = learner.policy.optimizer
    entries: dict[int, dict[str, torch.Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimizer."):
            _, index, key = name.split(".")
            entries.setdefault(int(index), {})[key] = tensor.clone()
    optimizer.load_state_dict({"state": entries, "param_groups": optimizer.state_dict()["param_groups"]})
    learner.iteration = counters["iteration"]
    learner.num_timesteps = counters["actual_steps"]
    learner._n_updates = counters["updates"]
