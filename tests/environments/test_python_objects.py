"""Functions, classes and torch modules of this process wherever `path.py:name` is allowed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import unjam
from unjam.adapters import policy_driver
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState
from unjam.drivers.pi_saturation import PISaturation
from unjam.errors import InputError
from unjam.training.config import RunConfig
from unjam.worlds.reward import Outcome

SHORT: Any = {"horizon": 30, "cavs": 1}
CODE = """
import numpy as np

def calm(outcome):
    return -np.nanmean(outcome.accelerations ** 2, axis=-1)

def follow(state):
    return 0.1 * (state.leader_speed - state.speed)

def speed(state):
    return state.speed / 10.0

class Keeper:
    def __init__(self, time_step):
        self.time_step = time_step

    def initial_memory(self, n):
        return {"last": np.zeros(n)}

    def act(self, state, memory):
        return self.time_step * state.speed, {"last": state.speed}
"""


class Speed(torch.nn.Module):
    """A feature: the speed times a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = torch.nn.Parameter(torch.tensor(0.1))

    def forward(self, state: LocalState) -> Any:
        return self.factor * state.speed


class Follow(torch.nn.Module):
    def forward(self, state: LocalState) -> Any:
        return 0.1 * (state.leader_speed - state.speed)


class Calm(torch.nn.Module):
    def forward(self, outcome: Outcome) -> Any:
        return {"calm": -(outcome.accelerations**2).mean(-1) * ~outcome.has_crashed}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    return path


@pytest.fixture
def mine(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = {"__name__": "mine"}
    exec(compile(CODE, str(file), "exec"), found)
    return found


def gymnasium_steps(**arguments: Any) -> list[float]:
    environment = gymnasium.make("unjam/Ring-v0", **SHORT, **arguments)
    observation, _ = environment.reset(seed=3)
    found = [*observation]
    for _ in range(10):
        observation, reward, *_ = environment.step(np.full(1, 0.2, np.float32))
        found += [*observation, float(reward)]
    environment.close()
    return found


def pettingzoo_steps(**arguments: Any) -> list[float]:
    environment = unjam.parallel_env("ring", **SHORT, **arguments)
    observations, _ = environment.reset(seed=3)
    found = [number for observation in observations.values() for number in observation]
    for _ in range(10):
        observations, rewards, *_ = environment.step(dict.fromkeys(environment.agents, 0.2))
        found += [*(number for observation in observations.values() for number in observation), *rewards.values()]
    environment.close()
    return found


def vector_steps(**arguments: Any) -> list[float]:
    environment = gymnasium.make_vec("unjam/Ring-v0", num_envs=1, vectorization_mode="async", **SHORT, **arguments)
    observations, _ = environment.reset(seed=3)
    found = [*observations[0]]
    for _ in range(10):
        observations, rewards, *_ = environment.step(np.full((1, 1), 0.2, np.float32))
        found += [*observations[0], float(rewards[0])]
    environment.close()
    return found


@pytest.mark.parametrize("steps", [gymnasium_steps, pettingzoo_steps, vector_steps])
def test_environments_take_functions_as_names_of_files(
    steps: Callable[..., list[float]], file: Path, mine: dict[str, Any]
) -> None:
    named = steps(reward=f"{file}:calm", expert=f"{file}:follow", features=("local", f"{file}:speed"))
    assert steps(reward=mine["calm"], expert=mine["follow"], features=("local", mine["speed"])) == named


def test_torch_modules_receive_tensors_of_their_type(mine: dict[str, Any]) -> None:
    of_modules = gymnasium_steps(reward=Calm().double(), expert=Follow(), features=("local", Speed()))
    of_functions = gymnasium_steps(reward=mine["calm"], expert=mine["follow"], features=("local", mine["speed"]))
    np.testing.assert_allclose(of_modules, of_functions, atol=1e-5)


def test_an_expert_is_a_class_or_a_driver(file: Path, mine: dict[str, Any]) -> None:
    assert gymnasium_steps(expert=mine["Keeper"]) == gymnasium_steps(expert=f"{file}:Keeper")
    assert gymnasium_steps(expert=PISaturation()) == gymnasium_steps(expert="pi")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"reward": 5}, "int: is not a function of an Outcome"),
        ({"reward": Driver}, "Driver: is not a function of an Outcome"),
        ({"expert": 5}, "driver int: is neither a function nor a class"),
        ({"features": abs}, "features: .* is not allowed; allowed: a list"),
        ({"features": (5,)}, "int: is not a function of a LocalState"),
        ({"features": (lambda state: state.speed.mean(),)}, r"<lambda>: feature has shape \(\) for 2 CAVs"),
        ({"features": (lambda state: np.zeros(1),)}, r"shape \(1,\) for 2 CAVs; allowed: \(2,\) or \(2, m\)"),
        ({"features": (lambda state: "fast",)}, "<lambda>: feature is not numbers: 'fast'"),
        ({"features": (lambda state: state.speeds,)}, r"<lambda>: AttributeError: .* \(line \d+\)"),
    ],
)
@pytest.mark.parametrize("make", [lambda **each: gymnasium.make("unjam/Ring-v0", **each), unjam.parallel_env])
def test_other_objects_are_refused_in_one_line(make: Callable[..., Any], arguments: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        make(**arguments)
    assert "\n" not in str(error.value)


def missing_later(state: LocalState) -> Any:
    return np.where(state.speed > 0.05, np.nan, state.speed)


def growing(state: LocalState) -> Any:
    return np.zeros((len(state.speed), 1 + int(state.loop_length[0] not in (1.0, 230.0))))


@pytest.mark.parametrize(
    ("feature", "words"),
    [
        (missing_later, r"^missing_later: column 0 is nan; allowed: finite \(cav_0, step \d+\)$"),
        (growing, r"^growing: feature has shape \(1, 2\) for 1 CAV; allowed: \(1, 1\) or \(1,\)$"),
    ],
)
def test_an_invalid_feature_is_named_with_cav_and_step(feature: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        gymnasium_steps(features=("local", feature))
    driver = policy_driver(lambda rows: 1.0 + 0.0 * rows[:, 0], ("local", feature))
    with pytest.raises(InputError, match=words):
        unjam.run_episode(unjam.make_scenario("ring", SHORT), driver, 0)


def one_number(outcome: Outcome) -> Any:
    return np.ones(1)


def only_total(outcome: Outcome) -> Any:
    return float(outcome.speeds.sum())


@pytest.mark.parametrize("reward", [one_number, only_total])
def test_a_reward_has_one_value_for_each_step_in_environments_too(reward: Any) -> None:
    words = rf"^reward {reward.__name__}: term 'reward' has shape .*; allowed: .*, one for each control step$"
    with pytest.raises(InputError, match=words):
        gymnasium_steps(reward=reward)
    with pytest.raises(InputError, match=words):
        unjam.run_episode(unjam.make_scenario("ring", SHORT), PISaturation(), 0, reward=reward)


def test_a_failing_reward_names_its_line() -> None:
    def fail(outcome: Outcome) -> Any:
        raise ValueError("no battery")

    line = fail.__code__.co_firstlineno + 1
    with pytest.raises(InputError, match=rf"^fail: ValueError: no battery \(line {line}\)$"):
        unjam.run_episode(unjam.make_scenario("ring", SHORT), PISaturation(), 0, reward=fail)


@pytest.mark.long
def test_drive_and_run_episode_take_functions_and_classes(file: Path, mine: dict[str, Any], tmp_path: Path) -> None:
    options: Any = {"episodes": 1, "scenario_options": SHORT}
    found = unjam.drive("ring", [mine["follow"], mine["Keeper"]], reward=mine["calm"], out=tmp_path / "out", **options)
    named = unjam.drive("ring", [f"{file}:follow", f"{file}:Keeper"], reward=f"{file}:calm", workers=1, **options)
    for rows, of_file in zip(found.rows.values(), named.rows.values(), strict=True):
        assert rows[0]["return"] == of_file[0]["return"]
    scenario = unjam.make_scenario("ring", SHORT)
    episode = unjam.run_episode(scenario, mine["Keeper"], 0, reward=mine["calm"])
    assert float(episode.reward.sum()) == found.rows["Keeper"][0]["return"]


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"reward": gymnasium_steps}, "reward"),
        ({"expert": gymnasium_steps}, "expert"),
        ({"policy.inputs": ("local", gymnasium_steps)}, "policy.inputs"),
        ({"evaluation": {"baselines": (gymnasium_steps,)}}, "evaluation.baselines"),
        ({"tasks": [{"scenario": "ring", "reward": gymnasium_steps}]}, "tasks.reward"),
    ],
)
def test_a_training_names_the_file_that_other_processes_must_import(changes: dict[str, Any], name: str) -> None:
    allowed = f"allowed: path.py:name; did you mean '{__file__}:gymnasium_steps'?"
    with pytest.raises(InputError) as error:
        unjam.load_config(changes=changes)
    reason = "the Python object gymnasium_steps is not allowed, because other processes must import it"
    assert str(error.value) == f"{name}: {reason}; {allowed}"


def test_objects_without_a_file_are_refused_without_a_guess() -> None:
    for value in (PISaturation(), lambda state: state.speed, Speed()):
        with pytest.raises(InputError, match=r"^expert: .*allowed: path\.py:name$"):
            unjam.load_config(changes={"expert": value})
        with pytest.raises(InputError, match=r"^expert: .*allowed: path\.py:name$"):
            replace(RunConfig(), expert=value)


def test_an_episode_of_a_seed_draws_the_same_numbers_from_torch_and_restores_its_generator() -> None:
    def noisy(state: LocalState) -> Any:
        return 0.0 * state.speed + torch.rand(1).item()

    before, ring = torch.get_rng_state(), unjam.make_scenario("ring", {"horizon": 5})
    first, other, again = (unjam.run_episode(ring, noisy, seed).speeds for seed in (1, 2, 1))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)
