"""Adam makes the same steps as that of torch."""

import pytest
import torch

from unjam.adam import Adam


@pytest.mark.parametrize("fused", [True, False])
def test_adam_equals_torchs_to_the_bit_and_resumes_from_its_state(fused: bool) -> None:
    def trained(kind: type[torch.optim.Adam]) -> list[bytes]:
        torch.manual_seed(0)
        network = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
        optimizer = kind(network.parameters(), lr=1e-2, weight_decay=1e-3, eps=1e-5, fused=fused)
        for step in range(30):
            if step == 20:
                state = optimizer.state_dict()
                optimizer = kind(network.parameters(), lr=1.0, fused=fused)
                optimizer.load_state_dict(state)
            optimizer.zero_grad()
            network(torch.arange(12.0).reshape(3, 4)).square().mean().backward()
            optimizer.step()
        assert torch.is_grad_enabled()
        return [parameter.detach().numpy().tobytes() for parameter in network.parameters()]

    assert trained(Adam) == trained(torch.optim.Adam)
