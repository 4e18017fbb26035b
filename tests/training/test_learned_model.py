"""The learned model of a run as users step it: as in training, from any state, and what is refused."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import unjam
from tests.torch_defaults import other_default
from tests.training.test_model_facts import CONFIG, run
from unjam.controller import make_driver
from unjam.drivers.network import Network
from unjam.drivers.residual import ResidualDriver
from unjam.errors import InputError
from unjam.models.registry import RowWorldModel
from unjam.models.world_model import RolloutPlan
from unjam.training.config import to_toml
from unjam.training.learned_model import LearnedModel
from unjam.training.model_facts import measure_model

__all__ = ["run"]
FOLLOWER = make_driver("idm", 0.1)
STILL = Network(((np.zeros((5, 1)), np.zeros(1)),), 1.0)
"""adds nothing to an expert"""


@pytest.fixture
def model(run: Path) -> LearnedModel:
    return unjam.load_world_model(run)


def test_the_same_start_and_seed_give_the_rollout_of_a_training(model: LearnedModel) -> None:
    world = model.world_model
    assert isinstance(world, RowWorldModel)
    assert world.ensemble.output_mask.any()  # something was learned
    starts = np.array([[0, 0], [3, 17], [5, 60]])
    in_training = world.simulate(RolloutPlan(ResidualDriver(FOLLOWER, STILL, 1.0), starts, 30, (7,), (8,)))
    model.reset_at(starts, 7)
    found = model.roll_out(FOLLOWER, 30)
    assert torch.equal(found.rewards, in_training.rewards)
    assert torch.equal(found.crashed, in_training.terminated)
    assert found.states.speed.shape == (3, 31)
    model.reset_at(starts, 8)
    assert not torch.equal(model.roll_out(FOLLOWER, 30).rewards, in_training.rewards)


def test_a_model_continues_from_a_state_in_the_same_way(model: LearnedModel) -> None:
    model.reset(20, seed=1)
    model.roll_out(FOLLOWER, 5)
    state = model.state()
    first = model.roll_out(FOLLOWER, 10)
    model.set_state(state)
    second = model.roll_out(FOLLOWER, 10)
    assert torch.equal(first.rewards, second.rewards)
    assert (first.states.leader_gap == second.states.leader_gap).all()
    model.reset(3)
    model.set_state(state)
    assert len(model.state().observed.speed) == 20


def test_episode_starts_are_first_states(model: LearnedModel) -> None:
    firsts = {float(np.float32(each.states.leader_gap[0])) for each in model.world_model.data.recordings}
    assert set(model.reset(30, episode_starts_only=True).leader_gap.tolist()) <= firsts
    assert not set(model.reset(30).leader_gap.tolist()) <= firsts


def test_a_step_is_differentiable_within_the_limits(model: LearnedModel) -> None:
    model.reset(4, seed=2)
    command = torch.tensor([0.1, -0.1, 0.2, 7.0], requires_grad=True)
    reward = model.step(command).reward + model.step(torch.zeros(4)).reward
    (gradient,) = torch.autograd.grad(reward.sum(), command)
    assert gradient.isfinite().all()
    assert (gradient[:3] != 0.0).all()
    assert gradient[3] == 0.0  # beyond the limit


def test_after_a_collision_a_row_has_no_reward(model: LearnedModel) -> None:
    model.reset(2)
    state = model.state()
    model.set_state(state._replace(is_running=torch.tensor([0.0, 1.0])))
    transition = model.step(torch.zeros(2))
    assert transition.reward[0] == 0.0 != transition.reward[1]
    assert transition.crashed.tolist() == [True, False]


def test_the_error_report_is_that_of_the_command_line(model: LearnedModel, run: Path) -> None:
    assert model.error_report() == measure_model(run, CONFIG)


def test_a_driver_of_numpy_drives_as_one_of_tensors(model: LearnedModel) -> None:
    def follow(state: unjam.LocalState) -> Any:
        return 0.1 * (state.leader_speed - state.speed)

    state = (model.reset(5, seed=3), model.state())[1]
    found = model.roll_out(follow, 5).rewards
    model.set_state(state)
    expected = [model.step(follow(model.state().observed)).reward for _ in range(5)]
    assert torch.allclose(found, torch.stack(expected, 1), atol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (lambda model: model.reset(0), "rows: 0 is not allowed; allowed: an integer >= 1"),
        (lambda model: model.step(torch.zeros(2)), r"acceleration: shape: \(2,\) is not allowed; allowed: \(1,\)"),
        (lambda model: model.step(torch.tensor([torch.nan])), "acceleration: nan is not allowed; allowed: finite"),
        (lambda model: model.roll_out(FOLLOWER, 0), "control_steps: 0 is not allowed; allowed: an integer >= 1"),
        (
            lambda model: model.set_state(model.state()._replace(is_running=torch.tensor([torch.nan]))),
            "state: is_running: 'nan' is not allowed; allowed: numbers",
        ),
        (lambda model: unjam.load_world_model(3), "run: 3 is not allowed; allowed: a run folder"),  # pyright: ignore
        (
            lambda model: model.set_state(model.state()._replace(is_running=torch.ones(2))),
            r"state: shape of is_running: \(2,\) is not allowed; allowed: \(1,\)",
        ),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(wrong: Any, reason: str, model: LearnedModel) -> None:
    with pytest.raises(InputError, match=reason):
        wrong(model)


def test_folders_without_a_model_are_refused_in_one_line(run: Path, tmp_path: Path) -> None:
    def refuse(folder: Path, reason: str) -> None:
        with pytest.raises(InputError, match=reason) as error:
            unjam.load_world_model(folder)
        assert "\n" not in str(error.value)

    refuse(tmp_path, "is not a run folder")
    refuse(tmp_path / "missing", "is not a run folder")
    other = shutil.copytree(run, tmp_path / "other")
    for changes, reason in (({"model_ratio": 0.0}, "has no model"), ({"kind": "road"}, "model.kind 'road'; allowed")):
        (other / "config.toml").write_text(to_toml(replace(CONFIG, model=replace(CONFIG.model, **changes))))
        refuse(other, reason)
    (other / "config.toml").write_text(to_toml(CONFIG))
    for path in (other / "checkpoint").iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    refuse(other, "checkpoint: all 2 under .* are damaged")
    shutil.rmtree(other / "checkpoint")
    refuse(other, "has no checkpoint yet")


@pytest.mark.usefixtures("without_pictures")
def test_the_example_of_the_documentation_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs/virtual.md").read_text()
    code = page.partition("## Drive in the learned model")[2].partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "virtual.md", "exec"), {"__name__": "example"})


@pytest.mark.parametrize("default", [torch.float64, torch.device("meta")], ids=str)
def test_a_model_does_not_depend_on_defaults_of_torch(default: Any, run: Path) -> None:
    def roll_out() -> torch.Tensor:
        model = unjam.load_world_model(run)
        model.reset(5, seed=1)
        model.step([0.1] * 5)
        return model.roll_out(FOLLOWER, 20).rewards

    expected = roll_out()
    with other_default(default):
        found = roll_out()
    assert (found.dtype, found.device) == (expected.dtype, expected.device)
    assert torch.equal(found, expected)
