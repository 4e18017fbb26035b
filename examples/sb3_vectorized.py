"""Train PPO or SAC of Stable-Baselines3 on 64 rings at once, without SUMO.

Run: python examples/sb3_vectorized.py [steps] [--algorithm sac] [--road unjam/Ring-v0] [--out ppo.zip]
The file drives anywhere: unjam drive ring-jammed -d ppo.zip -d human
"""

import argparse
import time

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor

import unjam  # registers the environments
from unjam.adapters import to_sb3_vec_env

RINGS = 64
ALGORITHMS = {
    "ppo": (PPO, {"n_steps": 75, "batch_size": 1200, "n_epochs": 5, "learning_rate": 1e-3, "gae_lambda": 0.9}),
    "sac": (SAC, {"gradient_steps": 8, "learning_starts": 20 * RINGS, "batch_size": 512}),
}


class SpeedPrinter(BaseCallback):
    """Prints the mean speed of all vehicles in the episodes that have just ended."""

    def _on_step(self) -> bool:
        ended = [info["episode_metrics"] for info in self.locals["infos"] if "episode_metrics" in info]
        if ended:
            speed, total = (np.mean([each[name] for each in ended]) for name in ("mean_speed", "return"))
            print(f"{self.num_timesteps:,} steps: mean speed {speed:.2f} m/s, return {total:.1f}", flush=True)
        return True


parser = argparse.ArgumentParser()
parser.add_argument("steps", type=int, nargs="?", default=400_000)
parser.add_argument("--algorithm", choices=ALGORITHMS, default="ppo")
parser.add_argument("--road", default="unjam/ring-22-grown-v1")
parser.add_argument("--out", default="")
options = parser.parse_args()
torch.set_num_threads(1)
started = time.process_time()
# One action in each second of 300 s; the features are `local`, which a model file must observe.
rings = gymnasium.make_vec(options.road, num_envs=RINGS, exact=False, steps_per_control_step=10, horizon=300)
algorithm, settings = ALGORITHMS[options.algorithm]
model = algorithm("MlpPolicy", VecMonitor(to_sb3_vec_env(rings)), gamma=0.99, seed=0, device="cpu", **settings)
model.learn(options.steps, callback=SpeedPrinter())
model.save(options.out or f"{options.algorithm}.zip")
print(f"unjam {unjam.__version__}: {model.num_timesteps:,} steps in {time.process_time() - started:.0f} s of CPU time")
