"""A trained residual as a model of Stable-Baselines3, which needs nothing of unjam to be loaded."""

import io
from math import log
from typing import Any

import numpy as np

from unjam.drivers.observation import MAX_OBSERVATION
from unjam.drivers.residual import ResidualDriver
from unjam.errors import import_optional, unknown_name

ALGORITHMS = {
    "trpo": ("sb3_contrib", "TRPO"),
    "ppo": ("stable_baselines3", "PPO"),
    "sac": ("stable_baselines3", "SAC"),
    "td3": ("stable_baselines3", "TD3"),
}
"""packages and names of the algorithms, by the agent of a training"""
MIN_EXPLORATION = 1e-3  # smallest standard deviation of exploration, as a share of the authority


def stable_baselines3_bytes(driver: ResidualDriver, agent: str) -> bytes:
    """Return the content of the `.zip` file of a model whose deterministic action is the residual of a driver [m/s2].

    The algorithm is that of `ALGORITHMS` for `agent`. Observations are those of the Gymnasium environments with the
    driver's expert and features. The actor has the weights of the driver; critics and optimizers are new. Raise
    `InputError` for an unknown algorithm, `MissingPartError` without Stable-Baselines3.
    """
    if agent not in ALGORITHMS:
        raise unknown_name("agent", agent, ALGORITHMS)
    package, name = ALGORITHMS[agent]
    gymnasium, torch, network = import_optional("gymnasium"), import_optional("torch"), driver.network
    bound = np.full(network.input_size, MAX_OBSERVATION, np.float32)
    environment = gymnasium.Env()  # its spaces are read; it is never stepped
    environment.observation_space = gymnasium.spaces.Box(-bound, bound, dtype=np.float32)
    environment.action_space = gymnasium.spaces.Box(-network.authority, network.authority, (1,), np.float32)
    hidden = [len(bias) for _, bias in network.layers[:-1]]
    options: dict[str, Any] = {"net_arch": hidden, "activation_fn": torch.nn.ReLU}
    arguments: dict[str, Any] = {"policy_kwargs": options, "device": "cpu"}
    std = max(network.exploration_std / network.authority, MIN_EXPLORATION)
    is_on_policy = agent in ("trpo", "ppo")
    if is_on_policy:  # only with state-dependent exploration they have the tanh of the residual
        options |= {"squash_output": True, "log_std_init": log(std)}
        arguments["use_sde"] = True
    model = getattr(import_optional(package), name)("MlpPolicy", environment, **arguments)
    actor = model.policy if is_on_policy else model.actor
    if is_on_policy:
        parts = actor.mlp_extractor.policy_net, actor.action_net
    else:
        parts = (actor.latent_pi, actor.mu) if agent == "sac" else (actor.mu,)
    linear = [layer for part in parts for layer in part.modules() if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        for layer, (weight, bias) in zip(linear, network.layers, strict=True):
            layer.weight.copy_(torch.as_tensor(weight[:, : layer.out_features].T))
            layer.bias.copy_(torch.as_tensor(bias[: layer.out_features]))
        if agent == "sac":
            values: Any = np.zeros((hidden[-1], 1)), np.array([log(std)])
            if network.squashes_noise:
                values = (columns[..., 1:] for columns in network.layers[-1])
            for parameter, array in zip((actor.log_std.weight, actor.log_std.bias), values, strict=True):
                parameter.copy_(torch.as_tensor(array.T))
        if agent == "td3":
            model.actor_target.load_state_dict(actor.state_dict())
    model.unjam = {
        "expert": driver.expert.describe(),
        "features": list(driver.inputs),
        "action": "residual acceleration [m/s2], added to that of the expert",
        "action_repeat": driver.action_repeat,
    }
    content = io.BytesIO()
    model.save(content)
    return content.getvalue()
