import os
import re
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st

from unjam.drivers import PISaturation
from unjam.drivers.car_following import Constant
from unjam.errors import InputError
from unjam.learners.settings import AGENT_NAMES, PolicySettings, TRPOSettings
from unjam.parameters import merge_changes, nest_keys, read_toml
from unjam.seeds import TEST_SEED, VALIDATION_SEED
from unjam.training.config import EvaluationSettings, RunConfig, load_config, to_toml
from unjam.training.presets import preset_values


def written(folder: Path, text: str) -> Path:
    path = folder / "config.toml"
    path.write_text(text)
    return path


def test_default_configuration() -> None:
    assert load_config() == RunConfig()
    assert load_config().scenario == "ring"


def test_later_sources_override_earlier_ones(tmp_path: Path) -> None:
    file = written(tmp_path, "steps = 7\nseed = 7\n[trpo]\ngamma = 0.7\ngae_lambda = 0.7\n")
    made = load_config(file, "paper", {"seed": 8, "trpo.gamma": 0.8})
    assert load_config(str(file), "paper", {"seed": 8, "trpo.gamma": 0.8}) == made
    assert made.seed == 8  # changes before file
    assert made.trpo.gamma == 0.8
    assert made.steps == 7  # file before preset
    assert made.trpo.gae_lambda == 0.7
    assert made.trpo.target_kl == preset_values("paper", "ring")["trpo"]["target_kl"]  # preset before defaults
    assert made.trpo.target_kl != TRPOSettings().target_kl
    assert made.trpo.cg_max_steps == TRPOSettings().cg_max_steps
    assert made.preset == "paper"


def test_change_of_one_key_keeps_the_rest_of_its_table() -> None:
    made = load_config(
        changes={"policy": {"action_duration": 3}, "policy.authority": 0.5, "scenario_options": {"vehicles": 20}}
    )
    assert made.policy == PolicySettings(action_duration=3, authority=0.5)
    assert made.make_scenario().vehicles == 20  # pyright: ignore[reportAttributeAccessIssue]


def test_scenario_options_can_be_changed_key_by_key() -> None:
    made = load_config(
        changes={"scenario": "ring-warm", "scenario_options.length": [230, 240], "scenario_options.horizon": 50}
    )
    scenario = made.make_scenario()
    assert scenario.length == (230, 240)  # pyright: ignore[reportAttributeAccessIssue]
    assert (scenario.horizon, scenario.warmup) == (50, 750)


def test_presets_are_not_changed_by_their_use() -> None:
    before = load_config(preset="paper")
    load_config(preset="paper", changes={"trpo.gamma": 0.5, "policy.action_duration": 9})
    assert load_config(preset="paper") == before


def test_merging_does_not_change_its_arguments() -> None:
    values, changes = {"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 5}, "d": {"e": 6}}
    assert merge_changes(values, changes) == {"a": {"b": 5, "c": 2}, "d": {"e": 6}}
    assert (values, changes) == ({"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 5}, "d": {"e": 6}})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sed": 1}, "sed: unknown name; did you mean 'seed'?"),
        ({"horizon": 100}, "horizon: unknown name; did you mean 'scenario_options.horizon'?"),
        ({"length": 230}, "length: unknown name; did you mean 'scenario_options.length'?"),
        (
            {"evaluation.nope": 1},
            "evaluation.nope: unknown name; allowed: baselines, convergence_window, episodes, patience",
        ),
        ({"trpo.gama": 0.9}, "trpo.gama: unknown name"),
        ({"evaluation.evry": 1}, "evaluation.evry: unknown name"),
        ({"trpo.gamma": 1.5}, "trpo.gamma: 1.5 is not allowed; allowed: less than 1"),
        ({"trpo.gamma": float("nan")}, "trpo.gamma: nan is not allowed"),
        ({"trpo": 3}, "trpo: 3 is not allowed"),
        ({"trpo.gamma.x": 3}, "trpo.gamma: {'x': 3} is not allowed"),
        ({"agent": "magic"}, "agent: 'magic' is not allowed; allowed: 'trpo', 'ppo', 'sac', 'td3' or 'path.py:Class'"),
        ({"ppo.clip_range": 2.0}, "ppo.clip_range: 2.0 is not allowed; allowed: less than 1"),
        ({"sac.start_policy": "slowly"}, "sac.start_policy: 'slowly' is not allowed; allowed: 'expert' or 'uniform'"),
        ({"sac.gama": 0.9}, "sac.gama: unknown name"),
        ({"steps": 0}, "steps: 0 is not allowed"),
        ({"steps": 1.5}, "steps: 1.5 is not allowed"),
        ({"steps": "many"}, "steps: 'many' is not allowed"),
        ({"seed": -1}, "seed: -1 is not allowed"),
        ({"workers": 0}, "workers: 0 is not allowed"),
        ({"scenario": ["ring"]}, "scenario: ['ring'] is not allowed"),
        ({"evaluation.episodes": 0}, "evaluation.episodes: 0 is not allowed"),
        ({"evaluation.validation_interval": -1}, "evaluation.validation_interval: -1 is not allowed"),
        ({"evaluation.baselines": "pi"}, "evaluation.baselines: 'pi' is not allowed"),
        ({"policy.hidden": 16}, "policy.hidden: 16 is not allowed; allowed: a list: [1, 2]"),
        ({"policy.inputs": ["stars"]}, "policy.inputs.0: 'stars' is not allowed"),
        ({"scenario": "rong"}, "scenario: 'rong' is not allowed; allowed: ring, ring-warm, ring-jammed"),
        ({"scenario_options": {"lenght": [220, 230]}}, "scenario ring.lenght: unknown name"),
        ({"tasks": [{"weight": 0}]}, "tasks.0.weight: 0 is not allowed"),
        ({"tasks": [{"name": "../up"}]}, "tasks.0.name: '../up' is not allowed"),
        ({"tasks": [{"scenario": "rong"}]}, "scenario: 'rong' is not allowed"),
        ({"tasks": [{"scenario_options": {"lenght": 3}}]}, "scenario ring.lenght: unknown name"),
        ({"scenario_options.vehicles": 1}, "scenario ring.vehicles: 1 is not allowed"),
        ({"scenario_options.length": [250, 230]}, "scenario ring.length: 230 m is not allowed as the largest"),
        (
            {"policy.exploration": "antithetic", "agent": "sac"},
            "policy.exploration: antithetic is not allowed; allowed: per_step, for sac",
        ),
        (
            {"policy.exploration": "antithetic", "model.kind": "road"},
            "policy.exploration: antithetic is not allowed; allowed: per_step, per_episode, because these model",
        ),
        (
            {"policy.reward_after_exit": True},
            "policy.reward_after_exit: true is not allowed; allowed: false with model.kind: row",
        ),
        (
            {"policy.history_features": True, "policy.inputs": ["local"]},
            "policy.history_features: true is not allowed; allowed: false, or true with expert_memory",
        ),
        (
            {"scenario_options.simulation_step": 0.0333},
            "scenario ring.simulation_step: 0.0333 is not allowed; allowed: a whole number of milliseconds",
        ),
        (
            {"scenario": "merge", "backend": "batch"},
            "backend: batch is not allowed; allowed: sumo (merge is not a ring)",
        ),
        (
            {"backend": "batch", "tasks": [{"scenario": "figure-eight"}, {"scenario": "merge"}]},
            "backend: batch is not allowed; allowed: sumo (figure-eight is neither a ring nor a recorded road)",
        ),
        (
            {"evaluation.patience": 5, "evaluation.validation_interval": 0},
            "evaluation.patience: 5 is not allowed; allowed: 0 without validations",
        ),
        (
            {"model.kind": "road", "model.device": "cuda"},
            "model.device: cuda is not allowed; allowed: cpu, for road models",
        ),
    ],
)
def test_wrong_value_gives_one_line_with_its_name(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config(changes=changes)
    assert str(caught.value).startswith(words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [TEST_SEED, VALIDATION_SEED])
def test_reserved_seed_is_refused(seed: int) -> None:
    with pytest.raises(InputError, match="seed"):
        load_config(changes={"seed": seed})


def test_unknown_preset_lists_known_presets() -> None:
    with pytest.raises(InputError, match="preset: 'papre' is not allowed; allowed: demo, rings, shared-rings"):
        load_config(preset="papre")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"steps = ", "not TOML"),
        (b"steps = 1\nsteps = 2\n", "not TOML"),
        (b"\xff\xfe\x00", "not TOML"),
        (b"[trpo]\ngama = 1\n", "trpo.gama: unknown name"),
        (b"steps = 'many'\n", "steps: 'many' is not allowed"),
        (b"steps = 2020-01-01\n", "is not allowed"),
    ],
)
def test_wrong_file_gives_one_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: No such file"):
        read_toml(tmp_path / "none.toml")
    with pytest.raises(InputError, match=r"config file .*directory"):
        read_toml(tmp_path)


def test_pipe_is_refused_without_waiting(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match=r"pipe\.toml: not a file"):
        load_config(pipe)


@pytest.mark.parametrize("preset", ["", "demo", "rings", "shared-rings", "all-roads", "paper", "paper-exact"])
def test_configuration_survives_toml(tmp_path: Path, preset: str) -> None:
    made = load_config(
        preset=preset, changes={"scenario_options.humans": {"time_headway": 1.3}, "expert": 'a "b" c.py:d'}
    )
    assert load_config(written(tmp_path, to_toml(made))) == made


def test_tuple_options_survive_toml(tmp_path: Path) -> None:
    made = load_config(changes={"scenario_options.length": (230, 240)})
    assert load_config(written(tmp_path, to_toml(made))) == made


TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))


@given(
    made=st.builds(
        RunConfig,
        expert=TEXT,
        reward=TEXT,
        steps=st.integers(1, 2**62),
        seed=st.integers(0, 10**6 - 1),
        policy=st.builds(
            PolicySettings,
            hidden=st.lists(st.integers(1, 999), min_size=1).map(tuple),
            authority=st.floats(1e-300, 2.0),
            learn_exploration_std=st.booleans(),
        ),
        trpo=st.builds(TRPOSettings, gamma=st.floats(0, 1, exclude_min=True, exclude_max=True)),
        evaluation=st.builds(EvaluationSettings, baselines=st.lists(TEXT).map(tuple)),
    )
)
def test_any_configuration_survives_toml(made: RunConfig, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(to_toml(made).encode())
    assert load_config(path) == made


@pytest.mark.parametrize("agent", AGENT_NAMES)
def test_each_learner_has_its_own_settings(agent: str) -> None:
    made = load_config(changes={"agent": agent, f"{agent}.gamma": 0.7, f"{agent}.steps_per_iteration": 77})
    assert (made.learner.gamma, made.learner.steps_per_iteration) == (0.7, 77)
    assert made.learner == getattr(made, agent)


def test_every_key_is_written_out() -> None:
    text = to_toml(RunConfig())
    for key in (
        "steps",
        "seed",
        "expert",
        "gamma",
        "critic_learning_rate",
        "action_duration",
        "inputs",
        "baselines",
        "preset",
    ):
        assert f"\n{key} = " in f"\n{text}"


def test_expert_is_made_by_name() -> None:
    assert load_config(changes={"expert": "none"}).make_expert() == Constant()
    assert load_config(changes={"expert": "pi:window=30"}).make_expert() == PISaturation(window=30)
    slow = load_config(changes={"scenario_options.steps_per_control_step": 5}).make_expert()
    assert slow == PISaturation(time_step=0.5)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"scenario": "figure-eight"}, "scenario: 'figure-eight'"),
        ({"reward": "eq16"}, "reward: 'eq16'"),
        ({"scenario_options.length": [230, 230]}, "scenario_options.length: [230, 230]"),
    ],
)
def test_conflict_with_all_tasks_of_a_preset_is_refused(changes: dict[str, Any], name: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"{name} is not allowed; allowed: no value with the preset rings")):
        load_config(None, "rings", changes)
    assert load_config(None, "rings", {"scenario_options.horizon": 200}).make_tasks()[0].scenario.horizon == 200


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"user.options": {"x": 1}}, "user.options: {'x': 1} is not allowed; allowed: none for the agent trpo"),
        ({"agent": "td3", "user.gamma": 0.5}, "user.gamma: 0.5 is not allowed; allowed: none for the agent td3"),
        *(
            ({"agent": "my.py:A", **values}, f"{name} is not allowed; allowed: none for the agent my.py:A")
            for values, name in (
                ({"trpo.gamma": 0.5}, "trpo.gamma: 0.5"),
                ({"sac": {"tau": 0.1}, "user.gamma": 0.5}, "sac.tau: 0.1"),
            )
        ),
    ],
)
def test_settings_of_an_agent_of_another_kind_are_refused(changes: dict[str, Any], line: str, tmp_path: Path) -> None:
    (tmp_path / "my.toml").write_text(tomli_w.dumps(nest_keys(changes)))
    for make in (lambda: load_config(changes=changes), lambda: load_config(tmp_path / "my.toml")):
        with pytest.raises(InputError) as refused:
            make()
        assert str(refused.value) == line


def test_settings_of_a_preset_for_other_agents_are_left_out(tmp_path: Path) -> None:
    made = load_config(preset="rings", changes={"agent": "my.py:A"})
    (tmp_path / "config.toml").write_text(to_toml(made))
    assert load_config(tmp_path / "config.toml") == made
