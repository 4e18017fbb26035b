from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from tests.models.toy_dynamics import RING, ToyDynamics, environment_data
from unjam.drivers import IDM, ResidualDriver
from unjam.errors import UnjamError
from unjam.models.ensemble import ModelFit, predict
from unjam.models.environment_data import EnvironmentData, Transitions
from unjam.models.row_model import NOISE_SAMPLES, TARGET_NAMES, RowModel, fit_row_model, model_inputs, residual_targets
from unjam.models.settings import ModelSettings

SETTINGS = ModelSettings(members=3, hidden=(32,), epochs=25, patience=6, batch_size=128, learning_rate=1e-2)
DRIVER = ResidualDriver(IDM(), random_network(), 1.0)


@pytest.fixture(scope="module")
def data() -> EnvironmentData:
    return environment_data(ToyDynamics(), DRIVER, 40, 50)


@pytest.fixture(scope="module")
def transitions(data: EnvironmentData) -> Transitions:
    return data.transitions(0.2)


def inputs_of(transitions: Transitions) -> np.ndarray:
    return model_inputs(transitions.states, transitions.acceleration, transitions.drawn_values)


def fit_example(transitions: Transitions, settings: ModelSettings = SETTINGS) -> tuple[RowModel, ModelFit]:
    model = RowModel(settings, transitions.drawn_values.shape[1], (1,))
    return model, fit_row_model(model, transitions, settings, RING, "", (2,))


@pytest.fixture(scope="module")
def fit(transitions: Transitions) -> tuple[RowModel, ModelFit]:
    return fit_example(transitions)


def test_targets_are_zero_where_the_base_is_exact(transitions: Transitions) -> None:
    targets = residual_targets(transitions, "idm", RING, "")
    largest = dict(zip(TARGET_NAMES, np.abs(targets).max(0), strict=True))
    assert largest["speed"] == largest["follower_speed"] == largest["follower_gap"] == pytest.approx(0, abs=1e-12)
    assert largest["leader_speed"] > 0.01
    np.testing.assert_allclose(targets[:, -1], 0.1 * transitions.states.leader_gap / 20.0, atol=1e-9)


def test_finds_a_known_residual(fit: tuple[RowModel, ModelFit], transitions: Transitions) -> None:
    model, fit_result = fit
    assert set(fit_result.learned_targets) == {"leader_speed", "leader_gap", "reward"}
    for name in fit_result.learned_targets:
        assert fit_result.one_step[name].model < 0.35 * fit_result.one_step[name].base, name
    assert fit_result.one_step["speed"].model == fit_result.one_step["speed"].base == pytest.approx(0, abs=1e-12)
    rows = np.flatnonzero(transitions.is_holdout)
    inputs = torch.tensor(inputs_of(transitions)[rows]).float()
    prediction = predict(model.layers(), inputs, torch.tensor([1]))[:, -1]
    expected = 0.1 * transitions.states.leader_gap[rows] / 20.0
    assert np.abs(prediction.numpy() - expected).mean() < 0.01


def test_fit_counts_rows(fit: tuple[RowModel, ModelFit], transitions: Transitions) -> None:
    _, fit_result = fit
    assert fit_result.training_rows == int((~transitions.is_holdout).sum())
    assert fit_result.holdout_rows == int(transitions.is_holdout.sum())
    limited = fit_example(transitions, replace(SETTINGS, max_fit_rows=100, epochs=2))[1]
    assert (limited.training_rows, limited.holdout_rows, limited.epochs) == (100, 20, 2)


def test_better_base_has_less_unexplained_variance(fit: tuple[RowModel, ModelFit], transitions: Transitions) -> None:
    _, without_base = fit_example(transitions, replace(SETTINGS, base="none"))
    assert fit[1].errors["unexplained_variance"] < without_base.errors["unexplained_variance"]
    assert fit[1].one_step["leader_gap"].base < without_base.one_step["leader_gap"].base
    assert set(without_base.learned_targets) == set(TARGET_NAMES)


def test_base_is_used_for_unpredictable_targets(transitions: Transitions) -> None:
    noise = np.random.default_rng(0).normal(size=len(transitions.acceleration))
    next_states = transitions.next_states._replace(follower_speed=transitions.next_states.follower_speed + noise)
    fit = transitions.reward - residual_targets(transitions, "idm", RING, "")[:, -1]
    model, fit_result = fit_example(transitions._replace(next_states=next_states, reward=fit))
    assert "follower_speed" not in fit_result.learned_targets
    assert "reward" not in fit_result.learned_targets
    assert "leader_speed" in fit_result.learned_targets
    assert fit_result.one_step["follower_speed"].model == pytest.approx(fit_result.one_step["follower_speed"].base)
    predictions = predict(model.layers(), torch.tensor(inputs_of(transitions)[:50]).float(), torch.tensor([0]))
    assert (predictions[:, TARGET_NAMES.index("follower_speed")] == 0.0).all()


def test_constant_training_input_does_not_mislead_on_the_holdout(transitions: Transitions) -> None:
    """As the length of the ring, of which the first episodes may have a single one."""
    other = transitions.drawn_values + np.where(transitions.is_holdout, 0.5, 0.1 / 3.0)[:, None]
    _, fit_result = fit_example(transitions._replace(drawn_values=other))
    for name in ("leader_speed", "leader_gap"):
        assert fit_result.one_step[name].model < 0.5 * fit_result.one_step[name].base, name


def test_noise_has_the_distribution_of_holdout_errors(transitions: Transitions) -> None:
    generator = np.random.default_rng(1)
    error = generator.normal(size=len(transitions.acceleration))
    next_states = transitions.next_states._replace(
        follower_speed=transitions.next_states.follower_speed + 0.5 * error,
        follower_gap=transitions.next_states.follower_gap - 0.1 * error,
    )
    model, _ = fit_example(transitions._replace(next_states=next_states))
    assert model.noise.shape == (NOISE_SAMPLES, len(TARGET_NAMES))
    noise = dict(zip(TARGET_NAMES, model.noise.double().numpy().T, strict=True))
    assert noise["follower_speed"].std() == pytest.approx(0.5, rel=0.15)
    assert noise["follower_speed"].mean() == pytest.approx(0.0, abs=0.03)
    assert np.corrcoef(noise["follower_speed"], noise["follower_gap"])[0, 1] == pytest.approx(-1, abs=1e-3)
    assert np.abs(noise["speed"]).max() < 1e-9


def test_reward_range_is_that_of_the_data(fit: tuple[RowModel, ModelFit], transitions: Transitions) -> None:
    residual = 0.1 * transitions.states.leader_gap / 20.0
    np.testing.assert_allclose(fit[0].reward_range.numpy(), [residual.min(), residual.max()], rtol=1e-5)


def test_the_same_seed_gives_the_same_bits(fit: tuple[RowModel, ModelFit], transitions: Transitions) -> None:
    torch.rand(7)
    np.random.rand(3)
    model, fit_result = fit_example(transitions)
    assert fit_result == fit[1]
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, fit[0].state_dict()[name]), name
    other = RowModel(SETTINGS, 1, (1,))
    assert fit_row_model(other, transitions, SETTINGS, RING, "", (3,)).errors != fit_result.errors


def test_second_fit_continues_the_first(transitions: Transitions) -> None:
    short = replace(SETTINGS, epochs=1)
    model, first = fit_example(transitions, short)
    last = [fit_row_model(model, transitions, short, RING, "", (5, number)) for number in range(3)][-1]
    assert last.one_step["leader_speed"].model < 0.9 * first.one_step["leader_speed"].model


def test_worse_weights_are_discarded(transitions: Transitions, fit: tuple[RowModel, ModelFit]) -> None:
    model = RowModel(SETTINGS, 1, (1,))
    model.load_state_dict(fit[0].state_dict())
    large_rate = replace(SETTINGS, learning_rate=1.0, epochs=2)
    fit_result = fit_row_model(model, transitions, large_rate, RING, "", (6,))
    assert fit_result.one_step["reward"].model == pytest.approx(fit[1].one_step["reward"].model, rel=1e-3)
    assert fit_result.errors["training_loss"] > fit[1].errors["training_loss"]


def test_non_finite_loss_raises_error(transitions: Transitions) -> None:
    infinite = transitions.next_states.leader_gap.copy()
    infinite[:] = np.inf
    with pytest.raises(UnjamError, match="loss of its fit is not finite in epoch 1"):
        fit_example(transitions._replace(next_states=transitions.next_states._replace(leader_gap=infinite)))


def test_fit_returns_all_error_estimators(fit: tuple[RowModel, ModelFit]) -> None:
    errors = fit[1].errors
    assert set(errors) == {"unexplained_variance", "transitions", "total_variation", "training_loss"}
    assert 0 < errors["transitions"] < 1
    assert 0 < errors["unexplained_variance"] < 0.1
    assert 0 < errors["total_variation"] < 1
    assert 0 < errors["training_loss"] < 0.1


def test_networks_without_fallback_are_always_added(transitions: Transitions) -> None:
    large_rate = replace(SETTINGS, members=1, fallback_to_base=False, epochs=1, max_fit_rows=20)
    _, fit_result = fit_example(transitions, large_rate)
    assert set(fit_result.learned_targets) == set(TARGET_NAMES)
    assert fit_result.one_step["speed"].model > fit_result.one_step["speed"].base  # the base knew it
    fresh = RowModel(large_rate, transitions.drawn_values.shape[1], (1,))
    assert all(weight.abs().max() > 0 for weight in fresh.weights)


@pytest.mark.parametrize("base", ["none", "idm"])
def test_targets_of_a_row_depend_on_that_row_alone(transitions: Transitions, base: str) -> None:
    rows = np.random.default_rng(0).permutation(np.flatnonzero(transitions.is_holdout))[:37]
    fit_result = residual_targets(transitions.select(rows), base, RING, "")
    np.testing.assert_array_equal(fit_result, residual_targets(transitions, base, RING, "")[rows])
