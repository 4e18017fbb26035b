import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """More threads would fight over small networks, and take longer than one."""
    torch.set_num_threads(1)
