"""The reward of this training: `unjam train merge --reward flow.py:distance`."""

import numpy as np


def distance(outcome):
    """Distance that all vehicles cover in a decision, in units of 30 vehicles at 20 m/s; 0 at a crash."""
    xp = np if isinstance(outcome.speeds, np.ndarray) else __import__("torch")
    covered = xp.nan_to_num(outcome.speeds, nan=0.0).sum(-1) / 600.0
    return {"distance": covered * ~outcome.crashed}
