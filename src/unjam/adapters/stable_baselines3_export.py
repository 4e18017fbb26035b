"""Export of a trained residual as a model of Stable-Baselines3, which can be loaded without unjam."""

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
"""package and name of the algorithm for each agent of a training"""
MIN_EXPLORATION_STD = 1e-3
"""smallest standard deviation of exploration noise, relative to the authority, which is 1 in the model"""


def stable_baselines3_bytes(driver: ResidualDriver, agent: str) -> bytes:
    """Return the `.zip` file of a model with the residual of a driver [m/s2] as its deterministic action.

    `agent` is a key of `ALGORITHMS`. The model's observations are those of a `RoadEnv` with the driver's expert and
    features. The actor has the weights of the driver; critics and optimizers are untrained. Raise `InputError` for an
    unknown agent, and `MissingPartError` without Stable-Baselines3.
    """
    if agent not in ALGORITHMS:
        raise unknown_name("agent", agent, ALGORITHMS)
    package, algorithm = ALGORITHMS[agent]
    gymnasium, torch, network = import_optional("gymnasium"), import_optional("torch"), driver.network
    bounds = np.full(network.input_size, MAX_OBSERVATION, np.float32)
    environment = gymnasium.Env()  # an object with spaces; no episode starts
    environment.observation_space = gymnasium.spaces.Box(-bounds, bounds, dtype=np.float32)
    environment.action_space = gymnasium.spaces.Box(-network.authority, network.authority, (1,), np.float32)
    hidden_sizes = [len(bias) for _, bias in network.layers[:-1]]
    policy_options: dict[str, Any] = {"net_arch": hidden_sizes, "activation_fn": torch.nn.ReLU}
    arguments: dict[str, Any] = {"policy_kwargs": policy_options, "device": "cpu"}
    std = max(network.exploration_std / network.authority, MIN_EXPLORATION_STD)
    is_on_policy = agent in ("trpo", "ppo")
    if is_on_policy:  # these policies have the tanh of the residual only if they use state-dependent exploration
        policy_options |= {"squash_output": True, "log_std_init": log(std)}
        arguments["use_sde"] = True
    model = getattr(import_optional(package), algorithm)("MlpPolicy", environment, **arguments)
    actor = model.policy if is_on_policy else model.actor
    if is_on_policy:
        modules = actor.mlp_extractor.policy_net, actor.action_net
    else:
        modules = (actor.latent_pi, actor.mu) if agent == "sac" else (actor.mu,)
    linear_layers = [layer for module in modules for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        # The last layer of the driver may have a second output, the logarithm of the standard deviation.
        for layer, (weight, bias) in zip(linear_layers, network.layers, strict=True):
            layer.weight.copy_(torch.as_tensor(weight[:, : layer.out_features].T))
            layer.bias.copy_(torch.as_tensor(bias[: layer.out_features]))
        if agent == "sac":
            log_std_arrays = np.zeros((hidden_sizes[-1], 1)), np.array([log(std)])
            if network.squashes_noise:
                weight, bias = network.layers[-1]
                log_std_arrays = weight[:, 1:], bias[1:]
            for parameter, array in zip((actor.log_std.weight, actor.log_std.bias), log_std_arrays, strict=True):
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
