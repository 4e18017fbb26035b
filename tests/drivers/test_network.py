from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from unjam.drivers.network import Network
from unjam.errors import InputError
from unjam.tree import pack, unpack


def test_agrees_with_the_layers_written_out() -> None:
    network = random_network(5)
    observation = np.random.default_rng(1).normal(size=(7, 5))
    hidden = observation
    for weight, bias in network.layers[:-1]:
        hidden = np.maximum(0.0, hidden @ weight + bias)
    weight, bias = network.layers[-1]
    np.testing.assert_allclose(network(observation), np.tanh(hidden @ weight + bias)[:, 0], atol=1e-12)


def test_rows_at_once_equal_single_rows_and_plain_numbers() -> None:
    network = random_network(5)
    observation = np.random.default_rng(2).normal(size=(9, 5))
    together = network(observation)
    for row, expected in zip(observation, together, strict=True):
        assert network(row[None])[0] == pytest.approx(expected, abs=1e-12)
        assert network(tuple(map(float, row))) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(("precision", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_tensors_give_what_arrays_give(precision: torch.dtype, tolerance: float) -> None:
    network = random_network(5)
    generator = np.random.default_rng(4)
    observation, noise = generator.normal(size=(9, 5)), generator.normal(size=9)
    tensor = torch.tensor(observation, dtype=precision)
    found = network.explore(tensor, torch.tensor(noise, dtype=precision))
    assert found.dtype == precision
    np.testing.assert_allclose(found.numpy(), network.explore(observation, noise), atol=tolerance)
    np.testing.assert_array_equal(tensor.numpy(), observation.astype(tensor.numpy().dtype))


def test_output_stays_within_its_authority() -> None:
    network = random_network(5, scale=30.0)
    assert np.abs(network(np.random.default_rng(3).normal(size=(50, 5)))).max() <= 1.0


def test_exploration_adds_scaled_noise() -> None:
    network = random_network(5)
    observation, noise = np.zeros((3, 5)), np.array([-1.0, 0.0, 2.0])
    np.testing.assert_allclose(network.explore(observation, noise) - network(observation), 0.2 * noise)


def test_noise_that_lasts_changes_what_the_last_hidden_layer_is_weighed_with() -> None:
    network = replace(random_network(5), episode_noise=True)
    generator = np.random.default_rng(1)
    observation, noise = generator.normal(size=(7, 5)), generator.normal(size=(7, 17))
    hidden = observation
    for weight, bias in network.layers[:-1]:
        hidden = np.maximum(0.0, hidden @ weight + bias)
    hidden = np.hstack([hidden, np.ones((7, 1))])  # the bias
    assert network.episode_noise_size == 17
    found = network.explore(observation, noise)
    np.testing.assert_allclose(found, network(observation) + 0.2 * (hidden * noise).sum(1), atol=1e-12)
    plain = network.explore(tuple(observation[3].tolist()), noise[3])
    assert isinstance(plain, float)
    assert plain == pytest.approx(found[3], abs=1e-12)
    tensors = network.explore(torch.tensor(observation), torch.tensor(noise))
    np.testing.assert_allclose(tensors.numpy(), found, atol=1e-12)


def test_noise_that_the_network_sizes_itself_comes_before_the_tanh() -> None:
    network = random_network(5, outputs=2)
    observation, noise = np.random.default_rng(1).normal(size=(2, 30, 5))
    noise = noise[:, 0]
    hidden = observation
    for weight, bias in network.layers[:-1]:
        hidden = np.maximum(0.0, hidden @ weight + bias)
    weight, bias = network.layers[-1]
    mean, log_std = (hidden @ weight + bias).T
    np.testing.assert_allclose(network(observation), np.tanh(mean), atol=1e-12)
    expected = np.tanh(mean + np.exp(log_std) * noise)
    np.testing.assert_allclose(network.explore(observation, noise), expected, atol=1e-12)
    assert np.ptp(log_std) > 0.1


def test_exploring_rows_at_once_equal_single_rows_and_plain_numbers() -> None:
    for network in (random_network(5), random_network(5, outputs=2)):
        observation, noise = np.random.default_rng(2).normal(size=(2, 9, 5))
        together = network.explore(observation, noise[:, 0])
        for row, drawn, expected in zip(observation, noise[:, 0], together, strict=True):
            assert network.explore(row[None], drawn[None])[0] == pytest.approx(expected, abs=1e-12)
            single = network.explore(tuple(map(float, row)), float(drawn))
            assert single == pytest.approx(expected, abs=1e-12)
            assert type(single) is float


@pytest.mark.parametrize("network", [random_network(5), random_network(5, outputs=2)])
def test_arrays_make_the_same_network_again(network: Network) -> None:
    again = unpack(Network, *pack(network))
    observation, noise = np.ones((2, 5)), np.ones(2)
    np.testing.assert_array_equal(again(observation), network(observation))
    np.testing.assert_array_equal(again.explore(observation, noise), network.explore(observation, noise))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({(0, 1): np.zeros(3)}, "weight and bias do not fit"),
        ({(1, 0): np.zeros((3, 16))}, "3 inputs are not allowed; allowed: 16"),
        ({(1, 1): np.full(16, np.nan)}, "not finite"),
        ({(2, 0): np.zeros((16, 3)), (2, 1): np.zeros(3)}, "one output, or two"),
        ({(0, 0): np.zeros(5)}, "do not fit"),
        ({(0, 0): np.zeros((5, 16), int)}, "weights are int64, float64; allowed: floats"),
    ],
)
def test_refuses_weights_that_do_not_fit(change: dict[tuple[int, int], np.ndarray], words: str) -> None:
    layers = [list(layer) for layer in random_network(5).layers]
    for (layer, part), array in change.items():
        layers[layer][part] = array
    with pytest.raises(InputError, match=words):
        Network(tuple((weight, bias) for weight, bias in layers), 1.0, 0.1)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"layers": ()}, "one output"),
        ({"authority": 0.0}, "authority: 0.0 is not allowed; allowed: > 0"),
        ({"exploration_std": -1.0}, "exploration_std: -1.0 is not allowed; allowed: >= 0"),
        ({"exploration_std": np.nan}, "exploration_std: nan"),
    ],
)
def test_refuses_settings_out_of_range(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(random_network(5), **settings)
