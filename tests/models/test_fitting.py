from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.conftest import random_network
from tests.models.toy_dynamics import RING, ToyDynamics, actual_data
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
    return actual_data(ToyDynamics(), DRIVER, 40, 50)


@pytest.fixture(scope="module")
def actual(data: EnvironmentData) -> Transitions:
    return data.transitions(0.2)


def inputs_of(actual: Transitions) -> np.ndarray:
    return model_inputs(actual.states, actual.acceleration, actual.drawn_values)


def fitted(actual: Transitions, settings: ModelSettings = SETTINGS) -> tuple[RowModel, ModelFit]:
    model = RowModel(settings, actual.drawn_values.shape[1], (1,))
    return model, fit_row_model(model, actual, settings, RING, "", (2,))


@pytest.fixture(scope="module")
def known(actual: Transitions) -> tuple[RowModel, ModelFit]:
    return fitted(actual)


def test_targets_are_zero_where_the_base_is_exact(actual: Transitions) -> None:
    targets = residual_targets(actual, "idm", RING, "")
    worst = dict(zip(TARGET_NAMES, np.abs(targets).max(0), strict=True))
    assert worst["speed"] == worst["follower_speed"] == worst["follower_gap"] == pytest.approx(0, abs=1e-12)
    assert worst["leader_speed"] > 0.01
    np.testing.assert_allclose(targets[:, -1], 0.1 * actual.states.leader_gap / 20.0, atol=1e-9)


def test_finds_a_known_residual(known: tuple[RowModel, ModelFit], actual: Transitions) -> None:
    model, found = known
    assert set(found.learned_targets) == {"leader_speed", "leader_gap", "reward"}
    for name in found.learned_targets:
        assert found.one_step[name].model < 0.35 * found.one_step[name].base, name
    assert found.one_step["speed"].model == found.one_step["speed"].base == pytest.approx(0, abs=1e-12)
    rows = np.flatnonzero(actual.is_holdout)
    inputs = torch.tensor(inputs_of(actual)[rows]).float()
    answer = predict(model.layers(), inputs, torch.tensor([1]))[:, -1]
    expected = 0.1 * actual.states.leader_gap[rows] / 20.0
    assert np.abs(answer.numpy() - expected).mean() < 0.01


def test_fit_counts_rows(known: tuple[RowModel, ModelFit], actual: Transitions) -> None:
    _, found = known
    assert found.training_rows == int((~actual.is_holdout).sum())
    assert found.holdout_rows == int(actual.is_holdout.sum())
    limited = fitted(actual, replace(SETTINGS, max_fit_rows=100, epochs=2))[1]
    assert (limited.training_rows, limited.holdout_rows, limited.epochs) == (100, 20, 2)


def test_better_base_has_less_unexplained_variance(known: tuple[RowModel, ModelFit], actual: Transitions) -> None:
    _, nothing_known = fitted(actual, replace(SETTINGS, base="none"))
    assert known[1].errors["unexplained_variance"] < nothing_known.errors["unexplained_variance"]
    assert known[1].one_step["leader_gap"].base < nothing_known.one_step["leader_gap"].base
    assert set(nothing_known.learned_targets) == set(TARGET_NAMES)


def test_base_is_used_for_unpredictable_targets(actual: Transitions) -> None:
    noise = np.random.default_rng(0).normal(size=len(actual.acceleration))
    following = actual.next_states._replace(follower_speed=actual.next_states.follower_speed + noise)
    known = actual.reward - residual_targets(actual, "idm", RING, "")[:, -1]
    model, found = fitted(actual._replace(next_states=following, reward=known))
    assert "follower_speed" not in found.learned_targets
    assert "reward" not in found.learned_targets
    assert "leader_speed" in found.learned_targets
    assert found.one_step["follower_speed"].model == pytest.approx(found.one_step["follower_speed"].base)
    answers = predict(model.layers(), torch.tensor(inputs_of(actual)[:50]).float(), torch.tensor([0]))
    assert (answers[:, TARGET_NAMES.index("follower_speed")] == 0.0).all()


def test_constant_training_input_does_not_mislead_on_the_holdout(actual: Transitions) -> None:
    """As the length of the ring, of which the first episodes may have a single one."""
    other = actual.drawn_values + np.where(actual.is_holdout, 0.5, 0.1 / 3.0)[:, None]
    _, found = fitted(actual._replace(drawn_values=other))
    for name in ("leader_speed", "leader_gap"):
        assert found.one_step[name].model < 0.5 * found.one_step[name].base, name


def test_noise_has_the_distribution_of_holdout_errors(actual: Transitions) -> None:
    generator = np.random.default_rng(1)
    error = generator.normal(size=len(actual.acceleration))
    following = actual.next_states._replace(
        follower_speed=actual.next_states.follower_speed + 0.5 * error,
        follower_gap=actual.next_states.follower_gap - 0.1 * error,
    )
    model, _ = fitted(actual._replace(next_states=following))
    assert model.noise.shape == (NOISE_SAMPLES, len(TARGET_NAMES))
    noise = dict(zip(TARGET_NAMES, model.noise.double().numpy().T, strict=True))
    assert noise["follower_speed"].std() == pytest.approx(0.5, rel=0.15)
    assert noise["follower_speed"].mean() == pytest.approx(0.0, abs=0.03)
    assert np.corrcoef(noise["follower_speed"], noise["follower_gap"])[0, 1] == pytest.approx(-1, abs=1e-3)
    assert np.abs(noise["speed"]).max() < 1e-9


def test_reward_range_is_that_of_the_data(known: tuple[RowModel, ModelFit], actual: Transitions) -> None:
    residual = 0.1 * actual.states.leader_gap / 20.0
    np.testing.assert_allclose(known[0].reward_range.numpy(), [residual.min(), residual.max()], rtol=1e-5)


def test_the_same_seed_gives_the_same_bits(known: tuple[RowModel, ModelFit], actual: Transitions) -> None:
    torch.rand(7)
    np.random.rand(3)
    model, found = fitted(actual)
    assert found == known[1]
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, known[0].state_dict()[name]), name
    other = RowModel(SETTINGS, 1, (1,))
    assert fit_row_model(other, actual, SETTINGS, RING, "", (3,)).errors != found.errors


def test_second_fit_continues_the_first(actual: Transitions) -> None:
    short = replace(SETTINGS, epochs=1)
    model, first = fitted(actual, short)
    last = [fit_row_model(model, actual, short, RING, "", (5, again)) for again in range(3)][-1]
    assert last.one_step["leader_speed"].model < 0.9 * first.one_step["leader_speed"].model


def test_worse_weights_are_discarded(actual: Transitions, known: tuple[RowModel, ModelFit]) -> None:
    model = RowModel(SETTINGS, 1, (1,))
    model.load_state_dict(known[0].state_dict())
    wild = replace(SETTINGS, learning_rate=1.0, epochs=2)
    found = fit_row_model(model, actual, wild, RING, "", (6,))
    assert found.one_step["reward"].model == pytest.approx(known[1].one_step["reward"].model, rel=1e-3)
    assert found.errors["training_loss"] > known[1].errors["training_loss"]


def test_non_finite_loss_raises_error(actual: Transitions) -> None:
    broken = actual.next_states.leader_gap.copy()
    broken[:] = np.inf
    with pytest.raises(UnjamError, match="loss of its fit is not finite in epoch 1"):
        fitted(actual._replace(next_states=actual.next_states._replace(leader_gap=broken)))


def test_fit_returns_all_error_estimators(known: tuple[RowModel, ModelFit]) -> None:
    errors = known[1].errors
    assert set(errors) == {"unexplained_variance", "transitions", "total_variation", "training_loss"}
    assert 0 < errors["transitions"] < 1
    assert 0 < errors["unexplained_variance"] < 0.1
    assert 0 < errors["total_variation"] < 1
    assert 0 < errors["training_loss"] < 0.1


def test_networks_without_fallback_are_always_added(actual: Transitions) -> None:
    wild = replace(SETTINGS, members=1, fallback_to_base=False, epochs=1, max_fit_rows=20)
    _, found = fitted(actual, wild)
    assert set(found.learned_targets) == set(TARGET_NAMES)
    assert found.one_step["speed"].model > found.one_step["speed"].base  # the base knew it
    fresh = RowModel(wild, actual.drawn_values.shape[1], (1,))
    assert all(weight.abs().max() > 0 for weight in fresh.weights)


@pytest.mark.parametrize("base", ["none", "idm"])
def test_targets_of_a_row_depend_on_that_row_alone(actual: Transitions, base: str) -> None:
    rows = np.random.default_rng(0).permutation(np.flatnonzero(actual.is_holdout))[:37]
    found = residual_targets(actual.select(rows), base, RING, "")
    np.testing.assert_array_equal(found, residual_targets(actual, base, RING, "")[rows])
