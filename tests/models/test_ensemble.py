import numpy as np
import torch
from torch.testing import assert_close

from unjam.drivers import LocalState
from unjam.drivers.check import random_state
from unjam.models.ensemble import ROWS_PER_MEMBER, predict, random_members, torch_generator
from unjam.models.row_model import STATE_FIELDS, TARGET_NAMES, RowModel, model_inputs
from unjam.models.settings import ModelSettings

SETTINGS = ModelSettings(members=3, hidden=(16, 8))


def random_model(seed: int = 0) -> RowModel:
    """Return a model with random weights."""
    model = RowModel(SETTINGS, 1, (seed,))
    generator = torch_generator((seed, 1), "cpu")
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=generator)
    model.output_mask.fill_(1.0)
    return model


def random_inputs(rows: int) -> torch.Tensor:
    state = random_state(np.random.default_rng(1), rows).map(lambda v: torch.tensor(v).float())
    return model_inputs(state, torch.linspace(-1, 1, rows), torch.full((rows, 1), 0.4))


def test_model_inputs_are_state_acceleration_and_drawn_values() -> None:
    state = LocalState(*(torch.tensor([float(value)]) for value in range(7)))
    found = model_inputs(state, torch.tensor([0.5]), torch.tensor([[0.25]]))
    assert STATE_FIELDS == ("speed", "leader_speed", "follower_speed", "leader_gap", "follower_gap")
    assert found.tolist() == [[0.0, 1.0, 3.0, 2.0, 4.0, 0.5, 0.25]]


def test_a_new_model_adds_nothing_to_its_base() -> None:
    model = RowModel(SETTINGS, 1, (1,))
    model.output_mask.fill_(1.0)
    found = predict(model.layers(), random_inputs(9), torch.tensor([0, 1, 2]))
    assert_close(found, torch.zeros(9, len(TARGET_NAMES)))


def test_initial_networks_differ_and_depend_on_the_seed_alone() -> None:
    one, same, other = (RowModel(SETTINGS, 1, (seed,)) for seed in (1, 1, 2))
    assert torch.equal(one.weights[0], same.weights[0])
    assert not torch.equal(one.weights[0], other.weights[0])
    assert not torch.equal(one.weights[0][0], one.weights[0][1])


def test_normalization_keeps_predictions() -> None:
    model, inputs = random_model(), random_inputs(50)
    members = torch.tensor([2, 0])
    before = predict(model.layers(), inputs, members)
    generator = torch_generator((3,), "cpu")
    targets = torch.rand((50, len(TARGET_NAMES)), generator=generator, dtype=torch.float64) * 7 + 3
    for scale in (1.0, 0.1):
        model.set_normalization(inputs.double() * scale, targets * scale)
        assert_close(predict(model.layers(), inputs, members), before, atol=2e-4, rtol=2e-4)
    assert_close(model.target_mean, targets.mean(0).float() * 0.1)


def test_each_block_of_rows_uses_its_member() -> None:
    model, inputs = random_model(), random_inputs(10)
    found = predict(model.layers(), inputs, torch.tensor([2, 0, 1]))  # blocks of four rows, but for the last
    member_outputs = model(inputs.expand(3, -1, -1)).detach()
    for rows, member in ((slice(0, 4), 2), (slice(4, 8), 0), (slice(8, 10), 1)):
        assert_close(found[rows], member_outputs[member, rows])


def test_prediction_of_many_rows_equals_single_rows() -> None:
    layers, inputs = random_model().layers(), random_inputs(7)
    joint = predict(layers, inputs, torch.tensor([1]))
    for row in range(7):
        assert_close(predict(layers, inputs[row : row + 1], torch.tensor([1]))[0], joint[row])


def test_masked_outputs_are_zero() -> None:
    model, inputs = random_model(), random_inputs(5)
    before = predict(model.layers(), inputs, torch.tensor([0]))
    model.output_mask[1] = 0.0
    found = predict(model.layers(), inputs, torch.tensor([0]))
    assert (found[:, 1] == 0.0).all()
    assert_close(found[:, 2:], before[:, 2:])


def test_members_are_drawn_uniformly() -> None:
    found = random_members(5, 10_000 * ROWS_PER_MEMBER, torch_generator((1,), "cpu"))
    assert len(found) == 10_000
    shares = torch.bincount(found, minlength=5) / len(found)
    assert_close(shares, torch.full((5,), 0.2), atol=0.02, rtol=0)
    assert len(random_members(5, 1, torch_generator((1,), "cpu"))) == 1


def test_state_dict_restores_the_model() -> None:
    model = random_model(1)
    model.set_normalization(random_inputs(20).double(), torch.rand((20, 6), dtype=torch.float64))
    other = RowModel(SETTINGS, 1, (9,))
    other.load_state_dict(model.state_dict())
    members = torch.tensor([0, 1, 2])
    assert torch.equal(
        predict(other.layers(), random_inputs(9), members), predict(model.layers(), random_inputs(9), members)
    )
