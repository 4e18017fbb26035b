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
from unjam.drivers.safety import FollowingState
from unjam.models.ensemble import torch_generator
from unjam.models.rollouts import CLIPPED_QUANTITIES, ModelDynamics, tensor_reward
from unjam.models.row_model import STATE_FIELDS, TARGET_NAMES, RowModel, base_reward, base_step
from unjam.models.settings import ModelSettings
from unjam.scenarios import Ring
from unjam.worlds.reward import Outcome, make_reward

RING = Ring()


def model(members: int = 1, residual: dict[str, float] | None = None, drawn: int = 1) -> RowModel:
    """A model that adds the numbers `residual` to its base everywhere; without them, something of its own."""
    made = RowModel(ModelSettings(members=members, hidden=(16,)), drawn, (1,))
    made.output_mask.fill_(1.0)
    made.reward_range.copy_(torch.tensor([-1.0, 1.0]))
    with torch.no_grad():
        if residual is None:
            made.weights[-1] += 0.02 * torch.randn(made.weights[-1].shape, generator=torch_generator((2,), "cpu"))
        else:
            made.biases[-1] += torch.tensor([residual.get(name, 0.0) for name in TARGET_NAMES])
    return made


def some_state(rows: int, seed: int = 1) -> LocalState:
    return random_state(np.random.default_rng(seed), rows).map(lambda v: torch.tensor(v).float())


def world(of: RowModel, noise: bool = False, ring: Ring = RING, seed: int = 3) -> ModelDynamics:
    return ModelDynamics(of, ring, "", torch_generator((seed,), "cpu"), noise)


@pytest.mark.parametrize("ring", [RING, replace(RING, simulation_step=0.2, steps_per_control_step=5)])
def test_step_adds_residual_to_the_base(ring: Ring) -> None:
    residual = {"speed": 0.1, "leader_speed": 0.2, "leader_gap": 0.3, "follower_gap": 0.5, "reward": 0.7}
    state, applied, drawn = some_state(20), torch.linspace(-1, 1, 20), torch.zeros(20, 1)
    state = state._replace(leader_gap=state.leader_gap + 20, follower_gap=state.follower_gap + 20)
    step = world(model(residual=residual), ring=ring).step(state, applied, drawn)
    known = base_step("idm", ring, state, applied)
    for name in STATE_FIELDS:
        assert_close(getattr(step.state, name), getattr(known, name) + residual.get(name, 0.0))
    none = torch.zeros(20, dtype=torch.bool)
    assert_close(step.reward, base_reward("idm", make_reward("released"), step.state, applied, none) + 0.7)
    assert not step.crashed.any()
    assert not step.clipped.any()


def test_route_position_wraps_around_the_loop() -> None:
    state = some_state(1)._replace(speed=torch.tensor([10.0]), route_position=torch.tensor([229.5]))
    step = world(model(residual={})).step(state, torch.zeros(1), torch.zeros(1, 1))
    assert_close(step.state.route_position, torch.tensor([0.5]))
    assert_close(step.state.loop_length, torch.tensor([230.0]))


def test_step_keeps_penetration_rate_and_distance_to_crossing() -> None:
    provided = {"penetration_rate": torch.tensor([0.1, 0.1]), "distance_to_crossing": torch.tensor([20.0, 0.5])}
    state = some_state(2)._replace(speed=torch.tensor([10.0, 10.0]), **provided)
    step = world(model(residual={})).step(state, torch.zeros(2), torch.zeros(2, 1))
    assert_close(step.state.penetration_rate, provided["penetration_rate"])
    assert_close(step.state.distance_to_crossing, torch.tensor([19.0, 229.5]))
    silent = world(model(residual={})).step(some_state(2), torch.zeros(2), torch.zeros(2, 1))
    assert silent.state.penetration_rate is silent.state.distance_to_crossing is None


@given(st.integers(0, 10**6))
def test_step_of_many_rows_equals_single_rows(seed: int) -> None:
    together = world(model())
    state, drawn = some_state(5, seed), torch.rand((5, 1), generator=torch_generator((seed,), "cpu"))
    applied = torch.linspace(-1, 1, 5)
    found = together.step(state, applied, drawn)
    for row in range(5):
        here = slice(row, row + 1)
        alone = together.step(state.select(here), applied[here], drawn[here])
        assert_close(alone.reward, found.reward[here])
        assert_close(torch.stack(alone.state[:7]), torch.stack(found.state[:7])[:, here])
        assert torch.equal(alone.crashed, found.crashed[here])
        assert torch.equal(alone.clipped, found.clipped[:, here])


@given(st.integers(0, 10**6), st.sampled_from([0.0, 1.0, 100.0]))
def test_next_states_are_physically_possible(seed: int, scale: float) -> None:
    generator = torch_generator((seed,), "cpu")
    wild = model(residual={name: scale * float(torch.randn(1, generator=generator)) for name in TARGET_NAMES})
    state = some_state(30, seed)
    step = world(wild).step(state, torch.ones(30), torch.zeros(30, 1))
    applied = RING.safety.limit(torch.ones(30), FollowingState(*state[:3]), RING.control_step)
    known = base_reward("idm", make_reward("released"), step.state, applied, step.crashed)
    for name in ("speed", "leader_speed", "follower_speed"):
        assert (getattr(step.state, name) >= 0.0).all()
        assert (getattr(step.state, name) <= RING.humans.desired_speed).all()
    for name in ("leader_gap", "follower_gap"):
        assert (getattr(step.state, name) >= 0.0).all()
        assert (getattr(step.state, name) <= 230.0).all()
    assert ((step.reward - known).abs() <= 1.0 + 1e-5).all()


@pytest.mark.parametrize(
    ("residual", "bounded"),
    [
        ({"speed": -50.0}, [True, False, False]),
        ({"follower_speed": 50.0}, [True, False, False]),
        ({"leader_gap": 500.0}, [False, True, False]),
        ({"reward": -1.5}, [False, False, True]),
        ({"leader_speed": 50.0, "follower_gap": 500.0, "reward": 9.0}, [True, True, True]),
        ({}, [False, False, False]),
    ],
)
def test_clipped_reports_each_quantity(residual: dict[str, float], bounded: list[bool]) -> None:
    state = some_state(4)._replace(leader_gap=torch.full((4,), 30.0), follower_gap=torch.full((4,), 30.0))
    step = world(model(residual=residual)).step(state, torch.zeros(4), torch.zeros(4, 1))
    assert CLIPPED_QUANTITIES == ("speed", "gap", "reward")
    assert step.clipped.tolist() == [[kind] * 4 for kind in bounded]
    assert not step.crashed.any()


@pytest.mark.parametrize("gap", ["leader_gap", "follower_gap"])
def test_zero_gap_is_a_crash_without_residual_reward(gap: str) -> None:
    state = some_state(3)._replace(leader_gap=torch.full((3,), 30.0), follower_gap=torch.full((3,), 30.0))
    state = state._replace(**{gap: torch.tensor([30.0, 1.0, 30.0])})
    step = world(model(residual={gap: -4.0, "reward": 0.5})).step(state, torch.ones(3), torch.zeros(3, 1))
    assert step.crashed.tolist() == [False, True, False]
    assert getattr(step.state, gap)[1] == 0.0
    assert step.reward[1] == 0.0
    assert (step.reward[[0, 2]] != 0.0).all()


def test_leader_beyond_the_largest_gap_is_missing_on_an_open_road() -> None:
    state = some_state(2)._replace(loop_length=torch.full((2,), torch.nan), leader_gap=torch.full((2,), 99.0))
    step = world(model(residual={"leader_gap": 5.0})).step(state, torch.zeros(2), torch.zeros(2, 1))
    assert (step.state.leader_gap == MAX_OBSERVED_GAP).all()
    assert_close(step.state.leader_speed, step.state.speed)
    assert_close(step.state.route_position, state.route_position + 0.1 * step.state.speed)
    assert step.reward.isfinite().all()
    closed = state._replace(loop_length=torch.full((2,), 230.0))
    beyond = world(model(residual={"leader_gap": 5.0})).step(closed, torch.zeros(2), torch.zeros(2, 1))
    assert (beyond.state.leader_gap > 102.0).all()


def test_noise_has_the_distribution_of_the_errors() -> None:
    noisy = model(residual={})
    error = torch.randn(len(noisy.noise), generator=torch_generator((5,), "cpu"))
    noisy.noise[:, TARGET_NAMES.index("leader_speed")] = 0.5 * error
    noisy.noise[:, TARGET_NAMES.index("leader_gap")] = 0.2 * error
    state = (
        some_state(1)
        .map(lambda values: values.repeat(20_000))
        ._replace(leader_gap=torch.full((20_000,), 30.0), leader_speed=torch.full((20_000,), 9.0))
    )
    push, drawn = torch.zeros(20_000), torch.zeros(20_000, 1)
    found = world(noisy, noise=True).step(state, push, drawn).state
    still = world(noisy).step(state, push, drawn).state
    changes = torch.stack([found.leader_speed - still.leader_speed, found.leader_gap - still.leader_gap]).numpy()
    assert changes[0].mean() == pytest.approx(0.0, abs=0.02)
    np.testing.assert_allclose(changes.std(1), [0.5, 0.2], rtol=0.03)
    assert np.corrcoef(changes)[0, 1] > 0.999
    assert torch.equal(found.speed, still.speed)


@pytest.mark.parametrize("gap", ["leader_gap", "follower_gap"])
def test_noise_alone_never_causes_a_crash(gap: str) -> None:
    """A jump that does not fit into the gap does not happen; one that fits does."""
    jumpy = model(residual={})
    jumpy.noise[:, TARGET_NAMES.index(gap)] = -20.0
    jumpy.noise[:, TARGET_NAMES.index("reward")] = 0.5
    state = some_state(3)._replace(
        leader_gap=torch.tensor([40.0, 15.0, 0.01]), follower_gap=torch.tensor([40.0, 15.0, 40.0])
    )
    state = state._replace(speed=torch.full((3,), 9.0), leader_speed=torch.full((3,), 1.0))
    push, drawn = torch.zeros(3), torch.zeros(3, 1)
    found, still = (world(jumpy, noise).step(state, push, drawn) for noise in (True, False))
    assert found.crashed.tolist() == still.crashed.tolist() == [False, False, True]
    jumps = getattr(found.state, gap) - getattr(still.state, gap)
    assert jumps[0].item() == pytest.approx(-20.0, abs=1e-5)
    assert jumps[1] == 0.0
    assert found.reward[1] == still.reward[1]


def test_each_member_predicts_some_rows_and_each_row_gets_all_members() -> None:
    several = model(members=3, residual={})
    with torch.no_grad():
        several.biases[-1][:, 0, STATE_FIELDS.index("leader_gap")] = torch.tensor([1.0, 2.0, 3.0])
    drives = world(several)
    state, push, drawn = some_state(1000), torch.zeros(1000), torch.zeros(1000, 1)
    known = base_step("idm", RING, state, push).leader_gap
    seen = torch.stack([drives.step(state, push, drawn).state.leader_gap - known for _ in range(60)]).round()
    assert set(seen[0].tolist()) == {1.0, 2.0, 3.0}
    for row in (0, 500, 999):
        assert set(seen[:, row].tolist()) == {1.0, 2.0, 3.0}


def test_the_same_seed_gives_the_same_bits() -> None:
    state, push, drawn = some_state(300), torch.zeros(300), torch.zeros(300, 1)
    several = model(members=4)
    several.noise.normal_(generator=torch_generator((8,), "cpu"))
    one, again, other = (world(several, noise=True, seed=seed).step(state, push, drawn) for seed in (1, 1, 2))
    assert torch.equal(torch.stack(one.state[:7]), torch.stack(again.state[:7]))
    assert torch.equal(one.reward, again.reward)
    assert not torch.equal(one.reward, other.reward)


def test_user_reward_is_called_with_numpy_arrays(my_drivers: Path) -> None:
    outcome = Outcome(
        torch.tensor([[1.0, 3.0, torch.nan], [2.0, 2.0, 5.0]]),
        torch.tensor([[1.0], [-0.5]]),
        torch.ones(2, 1),
        torch.zeros(2, dtype=torch.bool),
        torch.zeros(2),
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
