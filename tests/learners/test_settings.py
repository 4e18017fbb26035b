from dataclasses import FrozenInstanceError
from typing import Any

import pytest

from unjam.errors import InputError
from unjam.learners.settings import PolicySettings, PPOSettings, SACSettings, TRPOSettings
from unjam.parameters import build_dataclass


@pytest.mark.parametrize(
    ("kind", "key", "value"),
    [
        (PolicySettings, "hidden", (64, 0)),
        (PolicySettings, "hidden", ()),
        (PolicySettings, "hidden", 64),
        (PolicySettings, "inputs", ()),
        (PolicySettings, "inputs", ("local", "stars")),
        (PolicySettings, "authority", 0.0),
        (PolicySettings, "authority", float("inf")),
        (PolicySettings, "exploration_std", 0.0),
        (PolicySettings, "exploration_std", float("nan")),
        (PolicySettings, "action_duration", -1.0),
        (PolicySettings, "learn_exploration_std", "perhaps"),
        (TRPOSettings, "steps_per_iteration", 0),
        (TRPOSettings, "steps_per_iteration", 10.5),
        (TRPOSettings, "gamma", 1.0),
        (TRPOSettings, "gamma", 0.0),
        (TRPOSettings, "gae_lambda", 1.1),
        (TRPOSettings, "gae_lambda", -0.1),
        (TRPOSettings, "target_kl", 0.0),
        (TRPOSettings, "cg_damping", -0.1),
        (TRPOSettings, "critic_learning_rate", 0.0),
        (TRPOSettings, "critic_epochs", 0),
        (TRPOSettings, "critic_weight_decay", -1e-3),
        (TRPOSettings, "critic_batch_size", "many"),
        (TRPOSettings, "critic_batch_size", 1),
        (PPOSettings, "steps_per_iteration", 0),
        (PPOSettings, "clip_range", 0.0),
        (PPOSettings, "clip_range", 1.0),
        (PPOSettings, "epochs", 0),
        (PPOSettings, "minibatches", 0),
        (PPOSettings, "actor_learning_rate", 0.0),
        (SACSettings, "gamma", 1.0),
        (SACSettings, "tau", 0.0),
        (SACSettings, "tau", 1.5),
        (SACSettings, "temperature", 0.0),
        (SACSettings, "target_entropy", 1.0),
        (SACSettings, "start_policy", "slowly"),
        (SACSettings, "learning_starts", -1),
        (SACSettings, "gradient_steps_per_step", 0.0),
        (SACSettings, "buffer_size", 0),
    ],
)
def test_invalid_values_are_refused_by_name(kind: type, key: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        build_dataclass(kind, {key: value}, "settings")
    line = str(caught.value)
    assert line.startswith(f"settings.{key}")
    assert "is not allowed; allowed: " in line
    assert "\n" not in line


@pytest.mark.parametrize("kind", [PolicySettings, TRPOSettings, PPOSettings, SACSettings])
def test_an_unknown_name_is_refused(kind: type) -> None:
    with pytest.raises(InputError, match=r"settings\.learning_speed: unknown name"):
        build_dataclass(kind, {"learning_speed": 1.0}, "settings")


@pytest.mark.parametrize(
    ("key", "value"), [("gae_lambda", 0.0), ("gae_lambda", 1.0), ("critic_weight_decay", 0.0), ("gamma", 0.999)]
)
def test_boundary_values_are_allowed(key: str, value: float) -> None:
    assert getattr(build_dataclass(TRPOSettings, {key: value}, ""), key) == value


@pytest.mark.parametrize("made", [PolicySettings(), TRPOSettings(), PPOSettings(), SACSettings()])
def test_settings_are_immutable(made: Any) -> None:
    name = next(iter(vars(made)))
    with pytest.raises(FrozenInstanceError):
        setattr(made, name, getattr(made, name))


def test_lists_become_tuples() -> None:
    made = build_dataclass(PolicySettings, {"hidden": [32, 16], "inputs": ["local", "loop_length"]}, "")
    assert made == PolicySettings(hidden=(32, 16), inputs=("local", "loop_length"))


@pytest.mark.parametrize(
    ("action_repeat", "control_step", "control_steps"),
    [(1.0, 0.1, 10), (1.0, 1.0, 1), (1.0, 0.2, 5), (0.0, 0.1, 1), (0.5, 1.0, 1), (0.3, 0.1, 3)],
)
def test_action_repeat_depends_on_the_control_step(
    action_repeat: float, control_step: float, control_steps: int
) -> None:
    assert PolicySettings(action_duration=action_repeat).action_repeat(control_step) == control_steps
