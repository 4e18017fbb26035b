import dataclasses
from typing import Any

import pytest

from unjam.drivers import PISaturation
from unjam.training.config import RunConfig, load_config
from unjam.training.presets import all_presets, preset_values

PRESETS = [name for name, values in all_presets().items() if "on" not in values or name == "demo"]


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


@pytest.mark.parametrize("name", PRESETS)
def test_presets_give_a_configuration_and_an_expert(name: str) -> None:
    made = load_config(preset=name)
    assert made.preset == name
    made.make_expert()


@pytest.mark.parametrize("name", PRESETS)
def test_preset_changes_only_its_keys(name: str) -> None:
    defaults = flat(dataclasses.asdict(RunConfig()))
    made = flat(dataclasses.asdict(load_config(preset=name)))
    named = flat(preset_values(name, "ring"))
    for given, task in zip(named.pop("tasks", ()), made.pop("tasks"), strict=False):
        assert given.items() <= task.items()
    for key, value in named.items():
        assert made[key] == (tuple(value) if isinstance(value, list) else value), key
    assert {key for key in made if made[key] != defaults.get(key)} <= {*named, "preset"}


def test_demo_on_the_jammed_ring_is_short() -> None:
    made = load_config(preset="demo", changes={"scenario": "ring-jammed"})
    assert (made.scenario, made.backend, made.steps) == ("ring-jammed", "batch", 576_000)
    assert made.evaluation.baselines[0] == "human"
    assert load_config(preset="demo").backend == "sumo"


def test_paper_exact_preset_has_no_additions() -> None:
    assert not load_config(preset="paper-exact").make_scenario().safety.active
    paper, exact = load_config(preset="paper"), load_config(preset="paper-exact")
    assert (exact.steps, exact.trpo, exact.model.kappa) == (4_000_000, paper.trpo, paper.model.kappa)
    model = exact.model
    assert (model.members, model.fallback_to_base, model.add_noise, model.error_estimator) == (
        1,
        False,
        False,
        "transitions",
    )
    assert (exact.policy.zero_init, exact.evaluation.validation_interval, exact.evaluation.convergence_window) == (
        False,
        0,
        50,
    )


def test_paper_preset_has_the_numbers_of_the_paper() -> None:
    made = load_config(preset="paper")
    assert (made.trpo.gamma, made.trpo.gae_lambda, made.trpo.target_kl) == (0.995, 0.97, 0.01)
    ppo, sac = made.ppo, made.sac
    assert (ppo.gamma, ppo.epochs, ppo.clip_range, ppo.actor_learning_rate, ppo.critic_learning_rate) == (
        0.99,
        80,
        0.2,
        3e-4,
        1e-3,
    )
    assert (ppo.steps_per_iteration, ppo.minibatches) == (6000, 1)
    assert (sac.gamma, sac.tau, sac.learning_rate, sac.temperature) == (0.99, 5e-3, 3e-4, 0.2)
    assert (sac.learning_starts, sac.start_policy, sac.batch_size) == (10_000, "uniform", 256)
    assert (sac.learn_temperature, sac.reward_scale) == (False, 1.0)
    assert (made.trpo.steps_per_iteration, made.policy.hidden, made.policy.exploration_std) == (6000, (64, 64), 1.0)
    assert made.policy.inputs == ("local",)
    assert made.policy.action_repeat(0.1) == 1
    assert not made.stratified
    assert made.make_expert() == PISaturation(time_constant=0)
