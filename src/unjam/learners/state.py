"""All that a learner must keep to go on exactly where it stopped, as plain numbers and tensors."""

from typing import Any, cast

import torch
from stable_baselines3.common.buffers import ReplayBuffer

from unjam.learners.algorithms import SAC
from unjam.learners.episodic import Episodic
from unjam.learners.imagination import Imagination

Tensors = dict[str, torch.Tensor]

VIRTUAL = "virtual/"
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones")
REPLAY_PLACE = ("pos", "full")
"""where the next row goes, and whether the buffer is full"""


def learner_state(learner: Episodic) -> tuple[dict[str, Any], Tensors]:
    """Return counters and tensors of a learner at the end of an iteration.

    No random state is among them: each iteration seeds its generators anew.
    """
    counters = {
        "iteration": learner.iteration,
        "actual_steps": learner.num_timesteps,
        "updates": learner._n_updates,
    }
    tensors: Tensors = {}
    for part, state in learner.get_parameters().items():
        if "param_groups" in state:  # an optimiser
            for index, entry in state["state"].items():
                tensors |= {f"{part}/{index}/{name}": tensor for name, tensor in entry.items()}
        else:
            tensors |= {f"{part}/{name}": tensor for name, tensor in state.items()}
    if isinstance(learner, SAC):
        counters |= {name: getattr(learner.replay_buffer, name) for name in REPLAY_PLACE}
        tensors |= _tensors_in_place(learner)
    if learner.training.imagination is not None:
        counters["virtual"], kept = learner.training.imagination.state()
        tensors |= {f"{VIRTUAL}{name}": tensor for name, tensor in kept.items()}
    return counters, {name: tensor.detach().clone() for name, tensor in tensors.items()}


def restore_learner(learner: Episodic, counters: dict[str, Any], tensors: Tensors) -> None:
    """Put a learner made from the same configuration into the state that `learner_state` returned."""
    parts: Any = {part: _state_of(part, state, tensors) for part, state in learner.get_parameters().items()}
    learner.set_parameters(parts)
    learner.iteration = counters["iteration"]
    learner.num_timesteps = counters["actual_steps"]
    learner._n_updates = counters["updates"]
    if learner.training.imagination is not None:
        restore_imagination(learner.training.imagination, counters, tensors)
    if isinstance(learner, SAC):
        for name in REPLAY_PLACE:
            setattr(learner.replay_buffer, name, counters[name])
        for name, tensor in _tensors_in_place(learner).items():
            tensor.detach().copy_(tensors[name])


def restore_imagination(imagination: Imagination, counters: dict[str, Any], tensors: Tensors) -> None:
    """Put a virtual environment made from the same configuration into the state of its learner."""
    kept = {name.removeprefix(VIRTUAL): t for name, t in tensors.items() if name.startswith(VIRTUAL)}
    imagination.restore(counters["virtual"], kept)


def _tensors_in_place(learner: SAC) -> Tensors:
    """Return what SB3 does not name among its parameters, as tensors that share the learner's memory.

    That is the filled part of the replay buffer and, where it is learned, the temperature.
    """
    buffer = cast(ReplayBuffer, learner.replay_buffer)
    tensors = {f"replay/{name}": torch.from_numpy(getattr(buffer, name)[: buffer.size()]) for name in REPLAY}
    if learner.log_ent_coef is not None:
        tensors["log_ent_coef"] = learner.log_ent_coef
    return tensors


def _state_of(part: str, fresh: dict[str, Any], tensors: Tensors) -> dict[str, Any]:
    """Return the kept state of a part of a learner in the form of torch; `fresh` is that of a new one."""
    kept = {
        name.removeprefix(f"{part}/"): tensor.clone()
        for name, tensor in tensors.items()
        if name.startswith(f"{part}/")
    }
    if "param_groups" not in fresh:
        return kept
    entries: dict[int, Tensors] = {}
    for name, tensor in kept.items():
        index, _, key = name.partition("/")
        entries.setdefault(int(index), {})[key] = tensor
    return {"state": entries, "param_groups": fresh["param_groups"]}
