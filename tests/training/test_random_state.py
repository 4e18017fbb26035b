import numpy as np
import pytest
import torch

from unjam.errors import UnjamError
from unjam.training.random_state import exclusive_random_state


def test_training_restores_generators_and_threads() -> None:
    torch.manual_seed(3)
    np.random.seed(3)
    threads, expected = torch.get_num_threads(), (torch.rand(2).tolist(), np.random.rand(2).tolist())
    torch.manual_seed(3)
    np.random.seed(3)
    with exclusive_random_state():
        torch.manual_seed(8)
        np.random.seed(8)
        torch.set_num_threads(threads + 1)
    assert (torch.rand(2).tolist(), np.random.rand(2).tolist()) == expected
    assert torch.get_num_threads() == threads


def test_second_training_in_a_process_is_refused() -> None:
    refused = pytest.raises(UnjamError, match="another training runs in this process")
    for _ in range(2):
        with exclusive_random_state(), refused, exclusive_random_state():
            raise AssertionError
