"""Train Stable-Baselines3's own PPO on the ring, as a residual on PI with saturation, and compare it with PI alone.

Run: python examples/train_ppo.py [steps]. It shows how to connect both, and does not train a good policy: with these
settings a training of 300,000 steps had a return of 850, where PI alone has 1,980. docs/rl.md explains why.
"""

import sys

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

import unjam  # registers the environments

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000

environment = gymnasium.make("unjam/Ring-v0", expert="pi", features=("local", "expert_acceleration", "expert_memory"))
learner = PPO("MlpPolicy", environment, policy_kwargs={"log_std_init": -2.0}, seed=0, verbose=1)
learner.learn(STEPS)
environment.reset(seed=1)
mean, std = evaluate_policy(learner, environment, n_eval_episodes=3)
print(f"unjam {unjam.__version__}: return {mean:.0f} with a standard deviation of {std:.0f} over 3 episodes")
zeros, returns = np.zeros(environment.action_space.shape, np.float32), []
environment.reset(seed=1)
for _ in range(3):  # the same episodes
    _, info = environment.reset()
    while "episode_metrics" not in info:
        *_, info = environment.step(zeros)
    returns.append(info["episode_metrics"]["return"])
print(f"PI alone: return {np.mean(returns):.0f}")
environment.close()
