"""PPO with one policy for all CAVs of the merge, which enter and leave, in eight constant slots.

Run: python examples/shared_policy.py [updates] [horizon]. Policy and updates are those of ppo_single_file.py.
"""

import sys
from typing import Any

import numpy as np
import torch
from ppo_single_file import INPUTS, learn, policy

import unjam

UPDATES, HORIZON = (int(text) for text in (*sys.argv[1:], "50", "600")[:2])
SLOTS = 8


def column(values: dict[str, Any]) -> torch.Tensor:
    """Return the values of all slots as one tensor."""
    return torch.as_tensor(np.array([*values.values()]))


merge = unjam.parallel_env("merge", slots=SLOTS, horizon=HORIZON, features=INPUTS)
for update in range(UPDATES):
    observations, infos = merge.reset(seed=update)
    steps, total = [], 0.0
    while merge.agents:
        observation = column(observations)
        is_occupied = column({slot: info["is_occupied"] for slot, info in infos.items()})
        action = (chosen := policy(observation)).sample()
        actions = dict(zip(merge.agents, action.numpy(), strict=True))  # actions of empty slots are ignored
        observations, rewards, terminations, truncations, infos = merge.step(actions)
        # The trip of a CAV that leaves ends; its slot has its last observation, and is empty in the next step.
        has_left = column({slot: info["has_left"] for slot, info in infos.items()})
        ended = column(terminations) | column(truncations) | has_left
        reward = column(rewards).float()
        end = column(observations), column(terminations), ended
        steps.append((observation, action, chosen.log_prob(action).detach(), reward, *end, is_occupied))
        total += reward[is_occupied].mean().item() if is_occupied.any() else 0.0  # common to all CAVs
    learn(*map(torch.stack, zip(*steps, strict=True)))
    rows = int(sum(step[-1].sum() for step in steps))
    print(f"unjam {unjam.__version__}, update {update}: {rows} rows, return {total:.1f}", flush=True)
merge.close()
