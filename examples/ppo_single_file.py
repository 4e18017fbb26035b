"""PPO in one file, in the manner of CleanRL: 64 rings as torch tensors, and a policy that is exported as ONNX.

Run: python examples/ppo_single_file.py [updates], then: unjam drive ring-jammed -d policy.onnx -d human
"""

import sys
from pathlib import Path

import gymnasium
import tomli_w
import torch
from torch import Tensor, nn

from unjam.adapters import PolicyInput

RINGS, STEPS, EPOCHS, BATCH, GAMMA, LAMBDA, CLIP = 64, 75, 5, 1200, 0.99, 0.9, 0.2
SCALES = {"speed": 10.0, "leader_relative_speed": 5.0, "leader_gap": 20.0}
INPUTS = [{"quantity": name, "scale": scale} for name, scale in SCALES.items()]
"""what the policy observes, in SI units: in the environment, and in the description of the ONNX file"""


class Agent(nn.Module):
    """A Gaussian policy of one action, and its critic."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.actor, self.critic = (
            nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))
            for _ in range(2)
        )
        self.log_std = nn.Parameter(torch.zeros(1))
        self.optimizer = torch.optim.Adam(self.parameters(), lr=1e-3)

    def policy(self, observations: Tensor) -> torch.distributions.Normal:
        """Return the distribution of the action."""
        return torch.distributions.Normal(self.actor(observations)[..., 0], self.log_std.exp())

    def rollout_rows(self, steps: list[tuple[Tensor, ...]]) -> list[Tensor]:
        """Return the arguments of `learn` for the steps of a rollout, with advantages by GAE."""
        columns = map(torch.stack, zip(*steps, strict=True))
        observations, actions, old, rewards, following, terminated, ended, is_valid = columns
        values, next_values = (self.critic(each)[..., 0].detach() for each in (observations, following))
        advantages, later = torch.zeros_like(rewards), torch.zeros_like(rewards[0])
        for step in reversed(range(len(rewards))):
            target = (1 - GAMMA) * rewards[step] + GAMMA * next_values[step] * ~terminated[step]
            advantages[step] = later = target - values[step] + GAMMA * LAMBDA * later * ~ended[step]
        return [each[is_valid] for each in (observations, actions, old, advantages, advantages + values)]

    def learn(self, observations: Tensor, actions: Tensor, old: Tensor, advantages: Tensor, targets: Tensor) -> None:
        """Update policy and critic with rows of a rollout; `old` are the logarithms of the probabilities then."""
        for rows in [rows for _ in range(EPOCHS) for rows in torch.randperm(len(actions)).split(BATCH)]:
            ratio = (self.policy(observations[rows]).log_prob(actions[rows]) - old[rows]).exp()
            scaled = (advantages[rows] - advantages.mean()) / advantages.std()
            gain = torch.min(ratio * scaled, ratio.clamp(1 - CLIP, 1 + CLIP) * scaled).mean()
            error = (self.critic(observations[rows])[:, 0] - targets[rows]).square().mean()
            self.optimizer.zero_grad()
            (error - gain).backward()
            nn.utils.clip_grad_norm_(self.parameters(), 0.5)
            self.optimizer.step()


def main(updates: int) -> None:
    """Train, and write policy.onnx and policy.toml."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    # An action in each second
    settings = {"features": [PolicyInput(**each) for each in INPUTS], "steps_per_control_step": 10, "horizon": 300}
    rings = gymnasium.make_vec("unjam/ring-22-grown-v1", num_envs=RINGS, device="cpu", exact=False, **settings)
    agent, (observation, _), ended = Agent(len(INPUTS)), rings.reset(seed=1), torch.zeros(RINGS, dtype=torch.bool)
    for update in range(updates):
        steps = []
        for _ in range(STEPS):
            with torch.no_grad():
                policy = agent.policy(observation)
                action = policy.sample()
                following, reward, terminated, truncated, info = rings.step(action)
            is_valid, ended = ~ended, terminated | truncated  # the step after an end ignores its action
            steps.append((observation, action, policy.log_prob(action), reward, following, terminated, ended, is_valid))
            observation = following
            if "episode_metrics" in info:
                speeds = info["episode_metrics"]["mean_speed"][info["_episode_metrics"]]
                print(f"update {update}: mean speed {speeds.mean():.2f} m/s in {len(speeds)} episodes", flush=True)
        agent.learn(*agent.rollout_rows(steps))
    shapes = {"dynamic_shapes": ({0: torch.export.Dim("n")},), "external_data": False, "verbose": False}
    torch.onnx.export(agent.actor.eval(), (observation,), "policy.onnx", **shapes)
    description = {"inputs": INPUTS, "output": {"limits": [-1.0, 1.0]}, "time_step": 1.0}
    Path("policy.toml").write_text(tomli_w.dumps(description))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
