from typing import Any

import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

import unjam
from unjam.environments.gymnasium_env import RoadEnv
from unjam.environments.slots import SlottedRoadEnv
from unjam.errors import InputError


def drive_to_the_end(environment: Any, action: float = 0.2) -> list[tuple[dict[str, Any], ...]]:
    """Return the results of all steps."""
    steps = []
    while environment.agents:
        steps.append(environment.step({slot: np.full(1, action) for slot in environment.agents}))
    return steps


@pytest.mark.parametrize(("scenario", "options"), [("merge", {"horizon": 60}), ("ring", {"horizon": 20, "cavs": 2})])
def test_passes_the_api_test_of_pettingzoo(scenario: str, options: Any) -> None:
    environment = unjam.parallel_env(scenario, slots=3, **options)
    parallel_api_test(environment, num_cycles=30)
    environment.close()


@pytest.mark.parametrize("name", ["slots", "num_envs"])
def test_a_single_environment_names_the_environments_with_slots_and_copies(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: it is not allowed in a single environment .* gymnasium.make_vec"):
        RoadEnv("on-ramp", **{name: 8})  # pyright: ignore[reportArgumentType]


def test_slots_are_the_same_all_the_time_and_empty_ones_are_zero() -> None:
    environment = unjam.parallel_env("ring", slots=3, cavs=2, horizon=30)
    alone = unjam.parallel_env("ring", cavs=2, horizon=30)
    first, infos = environment.reset(seed=3)
    assert [infos[slot]["is_occupied"] for slot in environment.agents] == [True, True, False]
    steps = drive_to_the_end(environment)
    environment.close()
    expected, _ = alone.reset(seed=3)
    for observations, rewards, *_, step_infos in [(first, dict.fromkeys(first, 0.0), infos), *steps]:
        assert list(observations) == ["slot_0", "slot_1", "slot_2"]
        for slot, name in zip(["slot_0", "slot_1"], expected, strict=True):
            np.testing.assert_array_equal(observations[slot], expected[name])
            assert step_infos[slot]["vehicle"] == name
        assert not observations["slot_2"].any()
        assert rewards["slot_2"] == 0.0
        if alone.agents:
            expected = alone.step({name: np.full(1, 0.2) for name in alone.agents})[0]
    alone.close()
    *_, terminations, truncations, _ = steps[-1]
    assert (set(terminations.values()), set(truncations.values())) == ({False}, {True})
    assert environment.agents == []
    assert {steps[-1][-1][slot]["episode_metrics"]["steps"] for slot in terminations} == {30}


def test_a_slot_is_used_again_and_cavs_without_a_slot_never_get_one() -> None:
    environment = unjam.parallel_env("merge", slots=1, horizon=400)
    assert isinstance(environment, SlottedRoadEnv)
    environment.reset(seed=1)
    steps = drive_to_the_end(environment)
    waiting = environment._without_slot
    environment.close()
    infos = [step[-1]["slot_0"] for step in steps]
    vehicles = list(dict.fromkeys(info["vehicle"] for info in infos if info["vehicle"]))
    assert len(vehicles) > 1
    assert waiting
    assert not waiting.intersection(vehicles)
    leaving = [number for number, info in enumerate(infos) if info["has_left"]]
    assert len(leaving) >= len(vehicles) - 1
    for number in leaving:
        assert not infos[number]["is_occupied"]
        assert steps[number][0]["slot_0"].any()  # the last observation of the CAV that has left


@pytest.mark.parametrize("slots", [0, True, "8", 1.5])
def test_only_a_positive_number_of_slots_is_accepted(slots: Any) -> None:
    with pytest.raises(InputError, match=r"slots: .* is not allowed; allowed: an integer >= 1"):
        unjam.parallel_env("ring", slots=slots)


def test_an_occupied_slot_needs_a_valid_action() -> None:
    environment = unjam.parallel_env("ring", slots=2, cavs=1, horizon=20)
    environment.reset(seed=0)
    with pytest.raises(InputError, match="step: no action for slot_0; allowed: one for each occupied slot"):
        environment.step({"slot_1": [0.0]})
    with pytest.raises(InputError, match="step: slot_0 is not numbers: 'x'; allowed: one finite number"):
        environment.step({"slot_0": "x"})
    with pytest.raises(InputError, match=r"step: slot_0: array\(.*\) is not allowed; allowed: one finite"):
        environment.step({"slot_0": np.zeros((2, 1))})
    with pytest.raises(InputError, match="step: slot: 'slot_7' is not allowed; allowed: slot_0, slot_1"):
        environment.step({"slot_0": [0.0], "slot_7": [0.0]})
    environment.step({"slot_0": [0.0]})
    environment.close()
