import numpy as np
import pytest

from tests.conftest import random_network
from tests.models.toy_dynamics import RING, ToyDynamics, environment_data
from unjam.drivers import IDM, ResidualDriver
from unjam.models.comparison import one_step_errors, open_loop_errors, recorded_states, replay_accelerations
from unjam.models.ensemble import torch_generator
from unjam.models.environment_data import EnvironmentData
from unjam.models.registry import RowWorldModel
from unjam.models.rollouts import prepare_starts, roll_out
from unjam.models.row_model import STATE_FIELDS, RowModel, fit_row_model
from unjam.models.settings import ModelSettings
from unjam.models.world_model import RolloutPlan
from unjam.worlds.episode import Task

DRIVER = ResidualDriver(IDM(), random_network(), 1.0, action_repeat=3)
SETTINGS = ModelSettings(members=3, hidden=(32,), epochs=20, batch_size=128, learning_rate=1e-2)


def new_model() -> RowModel:
    return RowModel(SETTINGS, 1, (1,))


def recorded_data(world: ToyDynamics) -> EnvironmentData:
    return environment_data(world, DRIVER, 30, 60)


def test_exact_model_has_no_open_loop_error() -> None:
    data = recorded_data(ToyDynamics(leader=0.0))
    found = open_loop_errors(new_model(), data, data.start_indices(40), 40, RING)
    for name in STATE_FIELDS:
        assert found.error[name].shape == found.spread[name].shape == (40,)
        assert found.error[name].max() < 1e-3, name
        assert found.spread[name].max() < 1e-5
    assert found.change["leader_gap"][-1] > 1.0


def test_open_loop_errors_of_the_base_equal_explicit_sums() -> None:
    """The base assumes that the leader keeps its speed."""
    data = recorded_data(ToyDynamics())
    start_indices = data.start_indices(30)
    found = open_loop_errors(new_model(), data, start_indices, 30, RING)
    for step in (1, 10, 30):
        errors, changes = [], []
        for index, at in start_indices:
            speeds = data.recordings[index].states.leader_speed
            errors.append(speeds[at + step] - speeds[at])
            gaps = data.recordings[index].states.leader_gap
            changes.append(gaps[at + step] - gaps[at])
        assert found.error["leader_speed"][step - 1] == pytest.approx(np.sqrt(np.mean(np.square(errors))), abs=1e-5)
        assert found.change["leader_gap"][step - 1] == pytest.approx(np.sqrt(np.mean(np.square(changes))))


def test_fit_reduces_open_loop_errors() -> None:
    data = recorded_data(ToyDynamics())
    start_indices, model = data.start_indices(30), new_model()
    before = open_loop_errors(model, data, start_indices, 30, RING)
    fit_row_model(model, data.transitions(0.2), SETTINGS, RING, "", (2,))
    after = open_loop_errors(model, data, start_indices, 30, RING)
    for name in ("leader_speed", "leader_gap"):
        assert after.error[name][-1] < 0.6 * before.error[name][-1]
        assert 0.0 < after.spread[name][-1] < 2 * after.error[name][-1]
    assert after.error["speed"].max() < 1e-3


def test_each_member_replays_separately_from_recorded_states() -> None:
    data = recorded_data(ToyDynamics())
    model = new_model()
    fit_row_model(model, data.transitions(0.2), SETTINGS, RING, "", (2,))
    start_indices = data.start_indices(30)[:5]
    recorded, predicted = (
        recorded_states(data, start_indices, 30),
        replay_accelerations(model, data, start_indices, 30, RING),
    )
    for name in STATE_FIELDS:
        assert predicted[name].shape == (3, 5, 30)
        assert recorded[name].shape == (5, 31)
        np.testing.assert_array_equal(recorded[name][:, 0], getattr(data.states_at(start_indices), name))
    assert np.ptp(predicted["leader_speed"], axis=0)[:, -1].min() > 0.0
    np.testing.assert_allclose(
        predicted["leader_speed"][1, :1],
        replay_accelerations(model, data, start_indices[:1], 30, RING)["leader_speed"][1],
        rtol=1e-4,
    )


def test_one_step_errors_equal_those_of_the_fit() -> None:
    data, model = recorded_data(ToyDynamics()), new_model()
    recorded = data.transitions(0.2)
    found = fit_row_model(model, recorded, SETTINGS, RING, "", (2,))
    errors = one_step_errors(model, recorded.select(np.flatnonzero(recorded.is_holdout)), RING, "")
    assert errors.model.shape == (3, found.holdout_rows, 6)
    for name, error in errors.rmse_by_target().items():
        assert error == pytest.approx(found.one_step[name], rel=1e-6, abs=1e-9), name


def test_new_model_has_the_errors_of_its_base() -> None:
    errors = one_step_errors(new_model(), recorded_data(ToyDynamics()).transitions(0.2), RING, "")
    for member in errors.model:
        np.testing.assert_array_equal(member, errors.base)


def returns_of(driver: ResidualDriver, world: ToyDynamics, data: EnvironmentData) -> tuple[float, float]:
    """Return the mean returns of model and environment."""
    indices = data.start_indices(20)
    starts = prepare_starts(data, indices, driver.expert, "cpu")
    rollouts = roll_out(driver, world, starts, 20, torch_generator((1,), "cpu"))
    world_model = RowWorldModel(ModelSettings(), Task(RING, driver.expert), [1.0], (0,))
    world_model.data = data
    recorded = world_model.recorded_returns(RolloutPlan(driver, indices, 18, (0,), (0,)))
    return float(rollouts.rewards.sum(1).double().mean()), float(recorded.mean())


def test_exact_dynamics_have_the_returns_of_the_environment() -> None:
    world = ToyDynamics()
    data = environment_data(world, DRIVER, 6, 60, explore=False)
    quiet = ResidualDriver(IDM(), random_network(), 1.0, action_repeat=3)
    object.__setattr__(quiet.network, "exploration_std", 0.0)
    model, environment = returns_of(quiet, world, data)
    recorded = [data.recordings[index].reward[at : at + 18].sum() for index, at in data.start_indices(20)]
    assert environment == pytest.approx(np.mean(recorded))
    assert model == pytest.approx(environment, abs=2e-3)


def test_higher_model_reward_gives_a_higher_return() -> None:
    data = environment_data(ToyDynamics(), DRIVER, 6, 60)
    exact, environment = returns_of(DRIVER, ToyDynamics(), data)
    higher, same_environment = returns_of(DRIVER, ToyDynamics(bonus=5.0), data)
    assert same_environment == environment
    assert higher - environment > 5 * abs(exact - environment)
