"""Base class of learners that run the `train()` of Stable-Baselines3 (SB3) on whole episodes, and their buffers."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from unjam.drivers.network import Network
from unjam.errors import UnjamError
from unjam.learners.agent import AgentSpec
from unjam.learners.algorithm import Tensors, tensors_with_prefix
from unjam.learners.experience import Experience
from unjam.learners.learner import Learner
from unjam.physics.arrays import Floats

ADAM_STATE = {"step", "exp_avg", "exp_avg_sq"}
"""names of the values that Adam stores for each parameter"""


class SB3Learner(Learner):
    """A learner with an algorithm of SB3 for residuals; subclasses name the algorithm and fill its buffer."""

    gamma: float
    sb3: Any
    """SB3's algorithm: its `train()` needs a filled buffer, a logger, and the spaces of an environment"""

    def __init__(
        self, spec: AgentSpec, algorithm: type[BaseAlgorithm], policy: type[BasePolicy], **arguments: Any
    ) -> None:
        """Make the algorithm with `arguments`."""
        env = gymnasium.Env[np.ndarray, np.ndarray]()  # SB3 only reads the spaces of this environment
        env.observation_space, env.action_space = policy_spaces(spec.inputs, spec.critic_inputs, spec.authority)
        self.spec, self.gamma = spec, arguments["gamma"]
        policy_kwargs = {"settings": spec.policy, "inputs": spec.inputs, "action_limit": spec.action_limit}
        arguments["policy_kwargs"] = policy_kwargs | arguments.get("policy_kwargs", {})
        self.sb3 = algorithm(policy=policy, env=env, seed=spec.seed, device="cpu", **arguments)
        self.sb3.set_logger(Logger(None, []))

    def network(self) -> Network:
        """Return the policy as a NumPy network."""
        return self.sb3.policy.network()

    def log(self) -> dict[str, float]:
        """Return the numbers that SB3 logs about its updates, by name."""
        return {key.partition("/")[2]: float(value) for key, value in self.sb3.logger.name_to_value.items()}

    def check_parameters(self, iteration: int) -> None:
        """Raise `UnjamError` if a parameter is not finite, or the exploration noise has vanished."""
        for name, parameter in self.sb3.policy.named_parameters():
            if not parameter.isfinite().all():
                raise UnjamError(f"learner: {name} is not finite in iteration {iteration}")
            if name == "log_std" and not parameter.exp().all():
                raise UnjamError(
                    f"learner: the exploration noise is zero in iteration {iteration}: a smaller step helps"
                )

    def state(self) -> tuple[dict[str, Any], Tensors]:
        """Return values and tensors to resume exactly, without a random state, because each update is seeded."""
        tensors: Tensors = {}
        for component, state in self.sb3.get_parameters().items():
            if "param_groups" in state:  # an optimizer
                for index, entry in state["state"].items():
                    tensors |= {f"{component}/{index}/{name}": tensor for name, tensor in entry.items()}
            else:
                tensors |= {f"{component}/{name}": tensor for name, tensor in state.items()}
        return {"updates": self.sb3._n_updates}, tensors

    def restore(self, values: dict[str, Any], tensors: Tensors) -> None:
        """Resume from the values and tensors that `state` returned with the same configuration."""
        states = self.sb3.get_parameters()
        self.sb3.set_parameters({name: self._stored_state(name, state, tensors) for name, state in states.items()})
        self.sb3._n_updates = values["updates"]

    def _stored_state(self, component: str, initial_state: dict[str, Any], tensors: Tensors) -> dict[str, Any]:
        """Return the stored state of a network or optimizer for `set_parameters`, given its state in a new learner."""
        stored = tensors_with_prefix(f"{component}/", tensors)
        if "param_groups" not in initial_state:
            return stored
        groups = recursive_getattr(self.sb3, component).param_groups
        shapes = [parameter.shape for group in groups for parameter in group["params"]]
        entries: dict[int, Tensors] = {}
        for name, tensor in stored.items():
            index, _, key = name.partition("/")
            check_shape(f"{component}/{name}", tensor, torch.Size() if key == "step" else shapes[int(index)])
            entries.setdefault(int(index), {})[key] = tensor
        if any(entry.keys() != ADAM_STATE for entry in entries.values()):
            raise ValueError(f"{component} is no state of Adam")
        return {"state": entries, "param_groups": initial_state["param_groups"]}


def check_shape(name: str, tensor: torch.Tensor, expected: torch.Size) -> None:
    """Raise `ValueError` if a stored tensor has another shape than expected, which torch might broadcast silently."""
    if tensor.shape != expected:
        raise ValueError(f"{name} has the shape {tuple(tensor.shape)}, expected {tuple(expected)}")


def policy_spaces(inputs: int, critic_inputs: int, authority: float) -> tuple[spaces.Box, spaces.Box]:
    """Return observation and action space; `authority` [m/s2] bounds the mean, but not the noise."""
    actions = spaces.Box(-authority, authority, (1,), np.float32)
    return spaces.Box(-np.inf, np.inf, (inputs + critic_inputs,), np.float32), actions


def network_layers(module: nn.Module) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return weight and bias of each linear layer as float64 copies, in the order and shape of `Network.layers`."""
    tensors = [(layer.weight, layer.bias) for layer in module.modules() if isinstance(layer, nn.Linear)]
    arrays = [[tensor.detach().cpu().numpy().astype(np.float64) for tensor in pair] for pair in tensors]
    return tuple((weight.T.copy(), bias) for weight, bias in arrays)


def zero_layer(layer: nn.Linear) -> None:
    """Set weights and bias of a layer to zero."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)


@torch.no_grad()
def fill_rollout_buffer(buffer: RolloutBuffer, policy: ActorCriticPolicy, rows: Experience) -> None:
    """Replace the content of `buffer` by rows and their advantages.

    At the end of a truncated trajectory, the discounted value of the last observation is added to the last reward.
    """
    actions, observations = rows.actions[:, None], torch.as_tensor(rows.observations)
    values, log_probs, _ = policy.evaluate_actions(observations, torch.as_tensor(actions))
    last_values = policy.predict_values(torch.as_tensor(rows.last_observations)).numpy().ravel()
    rewards = rows.rewards.astype(np.float32)
    rewards[rows.last_rows] += buffer.gamma * np.where(rows.terminated, 0.0, last_values).astype(np.float32)

    buffer.buffer_size = len(rewards)
    buffer.reset()
    buffer.observations[:, 0] = rows.observations
    buffer.actions[:, 0] = actions
    buffer.rewards[:, 0] = rewards
    buffer.episode_starts[rows.starts, 0] = 1.0
    buffer.values[:, 0] = values.numpy().ravel()
    buffer.log_probs[:, 0] = log_probs.numpy()
    buffer.pos, buffer.full = len(rewards), True
    buffer.compute_returns_and_advantage(torch.zeros(1), np.ones(1, bool))


def add_to_replay_buffer(buffer: ReplayBuffer, rows: Experience, authority: float, rewards: Floats) -> None:
    """Add rows with these rewards to the buffer, with actions as shares of the `authority` [m/s2]."""
    dones = np.zeros(len(rewards), np.float32)
    dones[rows.last_rows] = rows.terminated
    indices = (buffer.pos + np.arange(len(rewards))) % buffer.buffer_size
    buffer.observations[indices, 0] = rows.observations
    buffer.next_observations[indices, 0] = rows.next_observations
    buffer.actions[indices, 0, 0] = rows.actions / np.float32(authority)
    buffer.rewards[indices, 0] = rewards
    buffer.dones[indices, 0] = dones
    end = buffer.pos + len(rewards)
    buffer.full = buffer.full or end >= buffer.buffer_size
    buffer.pos = end % buffer.buffer_size


class MixedReplayBuffer(ReplayBuffer):
    """SB3's replay buffer for environment rows; while it has a buffer of model rows, batches are mixed."""

    model_buffer: ReplayBuffer | None = None
    real_ratio = 1.0
    """share of environment rows in a batch"""

    def new_model_buffer(self, rows: int) -> ReplayBuffer:
        """Replace the buffer of model rows by an empty one for a number of rows, and return it."""
        arguments = self.observation_space, self.action_space, self.device
        self.model_buffer = ReplayBuffer(rows, *arguments, handle_timeout_termination=False)
        return self.model_buffer

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Return a random batch, with the share `real_ratio` of environment rows if there are model rows."""
        if self.model_buffer is None:
            return super().sample(batch_size, env)
        environment_count = round(self.real_ratio * batch_size)
        batches = [super().sample(environment_count)] if environment_count else []
        if environment_count < batch_size:
            batches.append(self.model_buffer.sample(batch_size - environment_count))
        columns = zip(*(batch[:5] for batch in batches), strict=True)  # without `discounts`, which are None
        return ReplayBufferSamples(*map(torch.cat, columns))


def shift_rewards(rows: Experience, offset: float, gamma: float) -> Floats:
    """Return the rewards minus `offset`, shape (rows,), so that all values decrease by offset / (1 - gamma).

    No reward follows a terminated trajectory: its last reward is also reduced by the offsets of the missing rewards.
    """
    rewards = rows.rewards - offset
    rewards[rows.last_rows] -= np.where(rows.terminated, offset * gamma / (1.0 - gamma), 0.0)
    return rewards
