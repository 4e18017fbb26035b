"""Gymnasium's own wrappers: the elapsed time as an observation, and a video of each tenth episode.

Run: python examples/gymnasium_wrappers.py [horizon]. RecordVideo needs: pip install moviepy
"""

import sys

import gymnasium
import numpy as np
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo, TimeAwareObservation

import unjam  # registers the environments

HORIZON = int(sys.argv[1]) if len(sys.argv) > 1 else 300

ring = gymnasium.make("unjam/Ring-v0", render_mode="rgb_array", expert="pi", horizon=HORIZON)
ring = RecordVideo(ring, "videos", episode_trigger=lambda episode: episode % 10 == 0, name_prefix="ring")
ring = TimeAwareObservation(RecordEpisodeStatistics(ring), normalize_time=True)
assert ring.spec is not None
steps, shape = ring.spec.max_episode_steps, ring.observation_space.shape
print(f"unjam {unjam.__version__}: at most {steps} steps, observations of shape {shape}")
for episode in range(2):
    observation, info = ring.reset(seed=episode)
    has_ended = False
    while not has_ended:
        observation, _, terminated, truncated, info = ring.step(np.zeros(1, np.float32))  # pi drives alone
        has_ended = terminated or truncated
    print(f"episode {episode}: return {info['episode']['r']:.1f} at the time {observation[-1]:.2f} of the horizon")
ring.close()
