"""Policy gradient in one file, in the manner of CleanRL: REINFORCE with a baseline on the ring.

Run: python examples/plain_loop.py [episodes]
"""

import sys

import gymnasium
import torch
from torch import nn

import unjam  # registers the environments

EPISODES = int(sys.argv[1]) if len(sys.argv) > 1 else 50
GAMMA = 0.99

torch.manual_seed(0)
torch.set_num_threads(1)
environment = gymnasium.make("unjam/Ring-v0", expert="pi", steps_per_control_step=10, horizon=300)
size = environment.observation_space.shape[0]  # pyright: ignore[reportOptionalSubscript]
policy = nn.Sequential(nn.Linear(size, 32), nn.Tanh(), nn.Linear(32, 1))
value = nn.Sequential(nn.Linear(size, 32), nn.Tanh(), nn.Linear(32, 1))
optimizer = torch.optim.Adam([*policy.parameters(), *value.parameters()], lr=1e-3)

for episode in range(EPISODES):
    observation, _ = environment.reset(seed=episode)
    observations, actions, rewards, done = [], [], [], False
    while not done:
        inputs = torch.as_tensor(observation)
        with torch.no_grad():
            action = policy(inputs) + 0.2 * torch.randn(1)
        observation, reward, terminated, truncated, _ = environment.step(action.numpy())
        observations.append(inputs)
        actions.append(action)
        rewards.append(float(reward))
        done = terminated or truncated
    value_after, returns = 0.0, []
    for reward in reversed(rewards):
        value_after = reward + GAMMA * value_after
        returns.append(value_after)
    target = torch.tensor(returns[::-1])
    rows = torch.stack(observations)
    advantage = target - value(rows).squeeze(1)
    log_probability = -((torch.stack(actions) - policy(rows)).squeeze(1) ** 2) / (2 * 0.2**2)
    loss = -(log_probability * advantage.detach()).mean() + advantage.square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    print(f"unjam {unjam.__version__}, episode {episode}: return {sum(rewards):.1f}")
environment.close()
