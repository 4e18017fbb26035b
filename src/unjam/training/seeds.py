"""Seeds in five families that never meet: what chose settings never judges them.

A training draws its episodes from (its seed, iteration, episode), its seed being smaller than any number
here; the others begin with a number of their own.
"""

TRAINING_SEED_LIMIT = 1_000_000
"""seeds of trainings, and of `unjam drive --seed`, are smaller"""
TEST_SEED = 1_000_039
"""first number of the seeds of final evaluations: they choose nothing. (1,000,003 was it before; presets and
pacers had been chosen with those in sight.)"""
VALIDATION_SEED = 1_000_033
"""first number of the seeds that choose a controller among those of a training"""
TUNING_SEED = 1_000_037
"""first number of the seeds that choose an expert's parameters, or those of the people on a user's road"""

SELECTION_SEED = 1_000_081
"""first number of the seeds that choose who drives on a road of the user's own"""


def make_test_seeds(count: int, first: int = 0) -> list[tuple[int, ...]]:
    """Return the seeds of final evaluations, from number `first` on."""
    return [(TEST_SEED, index) for index in range(first, first + count)]


def selection_seeds(count: int, first: int = 0) -> list[tuple[int, ...]]:
    """Return seeds that choose among drivers on a road of the user's own, from number `first` on."""
    return [(SELECTION_SEED, index) for index in range(first, first + count)]


def tuning_seeds(count: int, first: int = 0) -> list[tuple[int, ...]]:
    """Return seeds that choose parameters of an expert or of people, from number `first` on."""
    return [(TUNING_SEED, index) for index in range(first, first + count)]
