"""PPO in one file, in the manner of CleanRL: 64 rings as torch tensors, and a policy that is exported as ONNX.

Run: python examples/ppo_single_file.py [updates], then: unjam drive ring-jammed -d policy.onnx -d human
"""

import sys

import gymnasium
import torch
from torch import Tensor, nn

from unjam.adapters import PolicyInput, PolicyOutput, write_onnx_policy

RINGS, STEPS, EPOCHS, BATCH, GAMMA, LAMBDA, CLIP = 64, 75, 5, 1200, 0.99, 0.9, 0.2
SCALES = {"speed": 10.0, "leader_relative_speed": 5.0, "leader_gap": 20.0}
INPUTS = [PolicyInput(name, scale=scale) for name, scale in SCALES.items()]
"""what the policy observes, in SI units: in the environment, and in the description of the ONNX file"""


def network() -> nn.Sequential:
    """Return a network of one output."""
    return nn.Sequential(nn.Linear(len(INPUTS), 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))


torch.manual_seed(0)
torch.set_num_threads(1)
actor, critic, log_std = network(), network(), nn.Parameter(torch.zeros(1))
optimizer = torch.optim.Adam([log_std, *actor.parameters(), *critic.parameters()], lr=1e-3)


def policy(observations: Tensor) -> torch.distributions.Normal:
    """Return the distribution of the action: a Gaussian around the output of the actor."""
    return torch.distributions.Normal(actor(observations)[..., 0], log_std.exp())


def learn(*columns: Tensor) -> None:
    """Update actor and critic with the columns of a rollout, shape (steps, rings), and advantages by GAE."""
    observations, actions, old, rewards, following, terminated, ended, is_valid = columns
    values, next_values = (critic(each)[..., 0].detach() for each in (observations, following))
    advantages, later = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
    for step in reversed(range(len(rewards))):
        target = (1 - GAMMA) * rewards[step] + GAMMA * next_values[step] * ~terminated[step]
        advantages[step] = later = target - values[step] + GAMMA * LAMBDA * later * ~ended[step]
    kept = (each[is_valid] for each in (observations, actions, old, advantages, advantages + values))
    observations, actions, old, advantages, targets = kept
    for rows in [rows for _ in range(EPOCHS) for rows in torch.randperm(len(actions)).split(BATCH)]:
        ratio = (policy(observations[rows]).log_prob(actions[rows]) - old[rows]).exp()
        scaled = (advantages[rows] - advantages.mean()) / advantages.std()
        gain = torch.min(ratio * scaled, ratio.clamp(1 - CLIP, 1 + CLIP) * scaled).mean()
        error = (critic(observations[rows])[:, 0] - targets[rows]).square().mean()
        optimizer.zero_grad()
        (error - gain).backward()
        nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 0.5)
        optimizer.step()


def main(updates: int) -> None:
    """Train, and write policy.onnx."""
    # An action in each second
    settings = {"features": INPUTS, "steps_per_control_step": 10, "horizon": 300}
    rings = gymnasium.make_vec("unjam/ring-22-grown-v1", num_envs=RINGS, device="cpu", exact=False, **settings)
    (observation, _), ended = rings.reset(seed=1), torch.zeros(RINGS, dtype=torch.bool)
    for update in range(updates):
        steps = []
        for _ in range(STEPS):
            action = (chosen := policy(observation)).sample()
            following, reward, terminated, truncated, info = rings.step(action)
            # The step after an end ignores its action
            old, is_valid, ended = chosen.log_prob(action).detach(), ~ended, terminated | truncated
            steps.append((observation, action, old, reward, following, terminated, ended, is_valid))
            observation = following
            if "episode_metrics" in info:
                speeds = info["episode_metrics"]["mean_speed"][info["_episode_metrics"]]
                print(f"update {update}: mean speed {speeds.mean():.2f} m/s in {len(speeds)} episodes", flush=True)
        learn(*map(torch.stack, zip(*steps, strict=True)))
    write_onnx_policy(actor, "policy.onnx", INPUTS, PolicyOutput(limits=(-1.0, 1.0)), time_step=1.0)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
