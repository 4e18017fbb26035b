"""Seeds in five disjoint families: test seeds are never used for training, selection or tuning.

Episodes of a training have the seeds (seed of the training, iteration, episode). Seeds of the other families begin with
a number below, and the seed of a training is smaller than these numbers.
"""

import warnings
from functools import partial

from unjam.parameters import check_integer

TRAINING_SEED_LIMIT = 1_000_000  # seeds of trainings and of `unjam drive --seed` are smaller
TEST_SEED = 1_000_039  # first number of test seeds
VALIDATION_SEED = 1_000_033  # first number of seeds that select a controller within a training
TUNING_SEED = 1_000_037  # first number of seeds to tune an expert, or human drivers on a road of a user
SELECTION_SEED = 1_000_081  # first number of seeds that select a controller for a road of a user
RESERVED_SEEDS = range(TRAINING_SEED_LIMIT, TRAINING_SEED_LIMIT + 1000)  # first numbers of these other families


def warn_of_reserved_seed(*seeds: int | None) -> None:
    """Warn if the seed of an environment is reserved: test seeds begin with such a number."""
    if (reserved := next((seed for seed in seeds if seed in RESERVED_SEEDS), None)) is not None:
        text = f"reset: seed={reserved} is reserved for tests; allowed in trainings: other seeds"
        warnings.warn(f"{text}, such as those below {TRAINING_SEED_LIMIT:,}", stacklevel=3)


def _numbered_seeds(family: int, count: int, first: int = 0) -> list[tuple[int, ...]]:
    count, first = check_integer("count", count, 0), check_integer("first", first, 0)
    return [(family, index) for index in range(first, first + count)]


def held_out_seeds(count: int, first: int = 0) -> list[tuple[int, ...]]:
    """Return `count` test seeds for `run_episode`, from index `first` on.

    Train, select or tune nothing on them. The roads of `unjam benchmark` use the first ten.
    """
    return _numbered_seeds(TEST_SEED, count, first)


selection_seeds, tuning_seeds = (partial(_numbered_seeds, family) for family in (SELECTION_SEED, TUNING_SEED))
