"""How far what is measured of episodes of a batch is from the same of SUMO's, for the scripts beside it."""

from collections.abc import Sequence

import numpy as np


def compared(
    batch: Sequence[dict[str, float]], sumo: Sequence[dict[str, float]]
) -> dict[str, dict[str, float]]:
    """Return the mean, and the difference with its 95 % interval: as of other seeds, and seed by seed.

    One row for each seed, the same seeds in the same order; all rows have the same names.
    """
    found = {}
    for name in sumo[0]:
        one, other = (np.array([row[name] for row in rows]) for rows in (batch, sumo))
        count, paired = len(one), one - other
        spread = np.sqrt(one.var(ddof=1) / count + other.var(ddof=1) / count)
        found[name] = {
            "sumo": float(other.mean()),
            "difference": float(paired.mean()),
            "95 % as of other seeds": float(1.96 * spread),
            "95 % seed by seed": float(1.96 * paired.std(ddof=1) / np.sqrt(count)),
            "largest of a seed": float(np.abs(paired).max()),
        }
    return found
