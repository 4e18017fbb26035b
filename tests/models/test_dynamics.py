import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

import unjam.models
from unjam.drivers import LocalState
from unjam.drivers.check import random_state
from unjam.drivers.local_state import MAX_OBSERVED_GAP
from unjam.drivers.safety import INSTANT_ACTUATOR, FollowingState
from unjam.models.ensemble import torch_generator
from unjam.models.rollouts import CLIPPED_QUANTITIES, ModelDynamics, tensor_reward
from unjam.models.row_model import STATE_FIELDS, TARGET_NAMES, RowModel, base_reward, base_step
from unjam.models.settings import ModelSettings
from unjam.scenarios import Ring
from unjam.worlds.reward import Outcome, make_reward

RING = Ring(actuator=INSTANT_ACTUATOR)


def model(members: int = 1, residual: dict[str, float] | None = None, drawn: int = 1) -> RowModel:
    """A model that adds the numbers `residual` to its base everywhere; without them, random numbers."""
    made = RowModel(ModelSettings(members=members, hidden=(16,)), drawn, (1,))
    made.output_mask.fill_(1.0)
    made.reward_range.copy_(torch.tensor([-1.0, 1.0]))
    with torch.no_grad():
        if residual is None:
            made.weights[-1] += 0.02 * torch.randn(made.weights[-1].shape, generator=torch_generator((2,), "cpu"))
        else:
            made.biases[-1] += torch.tensor([residual.get(name, 0.0) for name in TARGET_NAMES])
    return made


def random_states(rows: int, seed: int = 1) -> LocalState:
    return random_state(np.random.default_rng(seed), rows).map(lambda v: torch.tensor(v).float())


def make_dynamics(of: RowModel, noise: bool = False, ring: Ring = RING, seed: int = 3) -> ModelDynamics:
    return ModelDynamics(of, ring, "", torch_generator((seed,), "cpu"), noise)


@pytest.mark.parametrize("ring", [RING, replace(RING, simulation_step=0.2, steps_per_control_step=5)])
def test_step_adds_residual_to_the_base(ring: Ring) -> None:
    residual = {"speed": 0.1, "leader_speed": 0.2, "leader_gap": 0.3, "follower_gap": 0.5, "reward": 0.7}
    state, acceleration, drawn = random_states(20), torch.linspace(-1, 1, 20), torch.zeros(20, 1)
    state = state._replace(leader_gap=state.leader_gap + 20, follower_gap=state.follower_gap + 20)
    step = make_dynamics(model(residual=residual), ring=ring).step(state, acceleration, drawn)
    expected = base_step("idm", ring, state, acceleration)
    for name in STATE_FIELDS:
        assert_close(getattr(step.state, name), getattr(expected, name) + residual.get(name, 0.0))
    none = torch.zeros(20, dtype=torch.bool)
    assert_close(step.reward, base_reward("idm", make_reward("released"), step.state, acceleration, none) + 0.7)
    assert not step.crashed.any()
    assert not step.clipped.any()


def test_route_position_wraps_around_the_loop() -> None:
    state = random_states(1)._replace(speed=torch.tensor([10.0]), route_position=torch.tensor([229.5]))
    step = make_dynamics(model(residual={})).step(state, torch.zeros(1), torch.zeros(1, 1))
    assert_close(step.state.route_position, torch.tensor([0.5]))
    assert_close(step.state.loop_length, torch.tensor([230.0]))


def test_step_keeps_penetration_rate_and_distance_to_crossing() -> None:
    provided = {"penetration_rate": torch.tensor([0.1, 0.1]), "distance_to_crossing": torch.tensor([20.0, 0.5])}
    state = random_states(2)._replace(speed=torch.tensor([10.0, 10.0]), **provided)
    step = make_dynamics(model(residual={})).step(state, torch.zeros(2), torch.zeros(2, 1))
    assert_close(step.state.penetration_rate, provided["penetration_rate"])
    assert_close(step.state.distance_to_crossing, torch.tensor([19.0, 229.5]))
    without_fields = make_dynamics(model(residual={})).step(random_states(2), torch.zeros(2), torch.zeros(2, 1))
    assert without_fields.state.penetration_rate is without_fields.state.distance_to_crossing is None


@given(st.integers(0, 10**6))
def test_step_of_many_rows_equals_single_rows(seed: int) -> None:
    dynamics = make_dynamics(model())
    state, drawn = random_states(5, seed), torch.rand((5, 1), generator=torch_generator((seed,), "cpu"))
    acceleration = torch.linspace(-1, 1, 5)
    found = dynamics.step(state, acceleration, drawn)
    for row in range(5):
        row_slice = slice(row, row + 1)
        single = dynamics.step(state.select(row_slice), acceleration[row_slice], drawn[row_slice])
        assert_close(single.reward, found.reward[row_slice])
        assert_close(torch.stack(single.state[:7]), torch.stack(found.state[:7])[:, row_slice])
        assert torch.equal(single.crashed, found.crashed[row_slice])
        assert torch.equal(single.clipped, found.clipped[:, row_slice])


@given(st.integers(0, 10**6), st.sampled_from([0.0, 1.0, 100.0]))
def test_next_states_are_physically_possible(seed: int, scale: float) -> None:
    generator = torch_generator((seed,), "cpu")
    random_model = model(residual={name: scale * float(torch.randn(1, generator=generator)) for name in TARGET_NAMES})
    state = random_states(30, seed)
    step = make_dynamics(random_model).step(state, torch.ones(30), torch.zeros(30, 1))
    acceleration = RING.safety.limit(torch.ones(30), FollowingState(*state[:3]), RING.control_step)
    expected = base_reward("idm", make_reward("released"), step.state, acceleration, step.crashed)
    for name in ("speed", "leader_speed", "follower_speed"):
        assert (getattr(step.state, name) >= 0.0).all()
        assert (getattr(step.state, name) <= RING.humans.desired_speed).all()
    for name in ("leader_gap", "follower_gap"):
        assert (getattr(step.state, name) >= 0.0).all()
        assert (getattr(step.state, name) <= 230.0).all()
    assert ((step.reward - expected).abs() <= 1.0 + 1e-5).all()


@pytest.mark.parametrize(
    ("residual", "is_clipped"),
    [
        ({"speed": -50.0}, [True, False, False]),
        ({"follower_speed": 50.0}, [True, False, False]),
        ({"leader_gap": 500.0}, [False, True, False]),
        ({"reward": -1.5}, [False, False, True]),
        ({"leader_speed": 50.0, "follower_gap": 500.0, "reward": 9.0}, [True, True, True]),
        ({}, [False, False, False]),
    ],
)
def test_clipped_reports_each_quantity(residual: dict[str, float], is_clipped: list[bool]) -> None:
    state = random_states(4)._replace(leader_gap=torch.full((4,), 30.0), follower_gap=torch.full((4,), 30.0))
    step = make_dynamics(model(residual=residual)).step(state, torch.zeros(4), torch.zeros(4, 1))
    assert CLIPPED_QUANTITIES == ("speed", "gap", "reward")
    assert step.clipped.tolist() == [[kind] * 4 for kind in is_clipped]
    assert not step.crashed.any()


@pytest.mark.parametrize("gap", ["leader_gap", "follower_gap"])
def test_zero_gap_is_a_crash_without_residual_reward(gap: str) -> None:
    state = random_states(3)._replace(leader_gap=torch.full((3,), 30.0), follower_gap=torch.full((3,), 30.0))
    state = state._replace(**{gap: torch.tensor([30.0, 1.0, 30.0])})
    step = make_dynamics(model(residual={gap: -4.0, "reward": 0.5})).step(state, torch.ones(3), torch.zeros(3, 1))
    assert step.crashed.tolist() == [False, True, False]
    assert getattr(step.state, gap)[1] == 0.0
    assert step.reward[1] == 0.0
    assert (step.reward[[0, 2]] != 0.0).all()


def test_leader_beyond_the_largest_gap_is_missing_on_an_open_road() -> None:
    state = random_states(2)._replace(loop_length=torch.full((2,), torch.nan), leader_gap=torch.full((2,), 99.0))
    step = make_dynamics(model(residual={"leader_gap": 5.0})).step(state, torch.zeros(2), torch.zeros(2, 1))
    assert (step.state.leader_gap == MAX_OBSERVED_GAP).all()
    assert_close(step.state.leader_speed, step.state.speed)
    assert_close(step.state.route_position, state.route_position + 0.1 * step.state.speed)
    assert step.reward.isfinite().all()
    closed = state._replace(loop_length=torch.full((2,), 230.0))
    beyond = make_dynamics(model(residual={"leader_gap": 5.0})).step(closed, torch.zeros(2), torch.zeros(2, 1))
    assert (beyond.state.leader_gap > 102.0).all()


def test_noise_has_the_distribution_of_the_errors() -> None:
    noisy = model(residual={})
    error = torch.randn(len(noisy.noise), generator=torch_generator((5,), "cpu"))
    noisy.noise[:, TARGET_NAMES.index("leader_speed")] = 0.5 * error
    noisy.noise[:, TARGET_NAMES.index("leader_gap")] = 0.2 * error
    state = (
        random_states(1)
        .map(lambda values: values.repeat(20_000))
        ._replace(leader_gap=torch.full((20_000,), 30.0), leader_speed=torch.full((20_000,), 9.0))
    )
    acceleration, drawn = torch.zeros(20_000), torch.zeros(20_000, 1)
    found = make_dynamics(noisy, noise=True).step(state, acceleration, drawn).state
    without_noise = make_dynamics(noisy).step(state, acceleration, drawn).state
    changes = torch.stack(
        [found.leader_speed - without_noise.leader_speed, found.leader_gap - without_noise.leader_gap]
    ).numpy()
    assert changes[0].mean() == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(changes.std(1), [0.5, 0.2], rtol=0.03)
    assert np.corrcoef(changes)[0, 1] > 0.999
    assert torch.equal(found.speed, without_noise.speed)


@pytest.mark.parametrize("gap", ["leader_gap", "follower_gap"])
def test_noise_alone_never_causes_a_crash(gap: str) -> None:
    """A jump that does not fit into the gap does not happen; one that fits does."""
    noisy = model(residual={})
    noisy.noise[:, TARGET_NAMES.index(gap)] = -20.0
    noisy.noise[:, TARGET_NAMES.index("reward")] = 0.5
    state = random_states(3)._replace(
        leader_gap=torch.tensor([40.0, 15.0, 0.01]), follower_gap=torch.tensor([40.0, 15.0, 40.0])
    )
    state = state._replace(speed=torch.full((3,), 9.0), leader_speed=torch.full((3,), 1.0))
    acceleration, drawn = torch.zeros(3), torch.zeros(3, 1)
    found, without_noise = (make_dynamics(noisy, noise).step(state, acceleration, drawn) for noise in (True, False))
    assert found.crashed.tolist() == without_noise.crashed.tolist() == [False, False, True]
    jumps = getattr(found.state, gap) - getattr(without_noise.state, gap)
    assert jumps[0].item() == pytest.approx(-20.0, abs=1e-5)
    assert jumps[1] == 0.0
    assert found.reward[1] == without_noise.reward[1]


def test_each_member_predicts_some_rows_and_each_row_gets_all_members() -> None:
    members_model = model(members=3, residual={})
    with torch.no_grad():
        members_model.biases[-1][:, 0, STATE_FIELDS.index("leader_gap")] = torch.tensor([1.0, 2.0, 3.0])
    dynamics = make_dynamics(members_model)
    state, acceleration, drawn = random_states(1000), torch.zeros(1000), torch.zeros(1000, 1)
    expected = base_step("idm", RING, state, acceleration).leader_gap
    seen = torch.stack(
        [dynamics.step(state, acceleration, drawn).state.leader_gap - expected for _ in range(60)]
    ).round()
    assert set(seen[0].tolist()) == {1.0, 2.0, 3.0}
    for row in (0, 500, 999):
        assert set(seen[:, row].tolist()) == {1.0, 2.0, 3.0}


def test_the_same_seed_gives_the_same_bits() -> None:
    state, acceleration, drawn = random_states(300), torch.zeros(300), torch.zeros(300, 1)
    members_model = model(members=4)
    members_model.noise.normal_(generator=torch_generator((8,), "cpu"))
    one, same, other = (
        make_dynamics(members_model, noise=True, seed=seed).step(state, acceleration, drawn) for seed in (1, 1, 2)
    )
    assert torch.equal(torch.stack(one.state[:7]), torch.stack(same.state[:7]))
    assert torch.equal(one.reward, same.reward)
    assert not torch.equal(one.reward, other.reward)


def test_user_reward_is_called_with_numpy_arrays(my_drivers: Path) -> None:
    outcome = Outcome(
        torch.tensor([[1.0, 3.0, torch.nan], [2.0, 2.0, 5.0]]),
        torch.tensor([[1.0], [-0.5]]),
        torch.ones(2, 1),
        torch.zeros(2, dtype=torch.bool),
        torch.zeros(2),
        torch.ones(2, 1),
    )
    found = tensor_reward(f"{my_drivers}:calm")(outcome)
    assert_close(found["speed"], torch.tensor([2.0, 3.0]))
    assert_close(found["push"], torch.tensor([-1.0, -0.5]))


@pytest.mark.long
def test_models_do_not_import_a_simulator() -> None:
    folder = Path(unjam.models.__path__[0])
    names = [f"unjam.models.{path.stem}" for path in folder.glob("*.py") if path.stem != "__init__"]
    assert "unjam.models.rollouts" in names
    program = f"import sys, {', '.join(names)}; print(*sys.modules)"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(ran.stdout.split())
    assert "torch" in loaded
    assert not loaded & {"libsumo", "traci", "sumolib", "unjam.worlds.sumo.simulation"}
