"""Train Stable-Baselines3's own PPO on the ring, as a residual on PI with saturation.

Run: python examples/train_ppo.py [steps]. With a few hundred thousand steps it begins to pay.
"""

import sys

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

import unjam  # tells Gymnasium of the roads

STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000

environment = gymnasium.make("unjam/Ring-v0", expert="pi", features=("local", "expert_acceleration", "expert_memory"))
learner = PPO("MlpPolicy", environment, policy_kwargs={"log_std_init": -2.0}, seed=0, verbose=1)
learner.learn(STEPS)
mean, std = evaluate_policy(learner, environment, n_eval_episodes=3)
print(f"unjam {unjam.__version__}: return {mean:.0f} with a standard deviation of {std:.0f} over 3 episodes")
environment.close()
