"""Seeds in five disjoint families: test seeds are never used for training, selection or tuning.

A training draws its episodes from (its seed, iteration, episode), where its seed is smaller than all numbers here; the
seeds of the other families begin with their own number.
"""

import warnings
from functools import partial

from unjam.parameters import check_integer

TRAINING_SEED_LIMIT = 1_000_000  # seeds of trainings, and of `unjam drive --seed`, are smaller
TEST_SEED = 1_000_039  # first number (earlier 1,000,003, with which presets and pacers had been selected)
VALIDATION_SEED = 1_000_033  # first number of validation seeds, which select a controller within a training
TUNING_SEED = 1_000_037  # first number for an expert, or for the human drivers on a user's road
SELECTION_SEED = 1_000_081  # first number of selection seeds, which select a controller for a user's road
RESERVED_SEEDS = range(TRAINING_SEED_LIMIT, TRAINING_SEED_LIMIT + 1000)  # first numbers for such purposes


def warn_of_reserved_seed(*seeds: int | None) -> None:
    """Warn of the first seed of an environment that is reserved: test seeds begin with it."""
    if (found := next((seed for seed in seeds if seed in RESERVED_SEEDS), None)) is not None:
        text = f"reset: seed={found} is reserved for tests; allowed in trainings: other seeds"
        warnings.warn(f"{text}, such as those below {TRAINING_SEED_LIMIT:,}", stacklevel=3)


def _numbered_seeds(family: int, count: int, first: int = 0) -> list[tuple[int, ...]]:
    count, first = check_integer("count", count, 0), check_integer("first", first, 0)
    return [(family, index) for index in range(first, first + count)]


def held_out_seeds(count: int, first: int = 0) -> list[tuple[int, ...]]:
    """Return test seeds, from number `first` on, for `run_episode`; nothing may be trained, selected or tuned on them.

    The roads of `unjam benchmark` have the first ten.
    """
    return _numbered_seeds(TEST_SEED, count, first)


selection_seeds, tuning_seeds = (partial(_numbered_seeds, family) for family in (SELECTION_SEED, TUNING_SEED))
