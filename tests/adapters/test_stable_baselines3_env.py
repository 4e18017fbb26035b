import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from tests.environments.test_vector_env import CRASHING
from unjam.adapters import to_sb3_vec_env
from unjam.errors import InputError, MissingPartError

COUNT, STEPS, SEED = 3, 120, 5
ENDED = "TimeLimit.truncated", "terminal_observation"
CASES: dict[str, Any] = {
    "truncated": {"horizon": 17, "expert": "pi", "features": ("local", "expert_memory")},
    "terminated": CRASHING,
}


def made(**arguments: Any) -> Any:
    return to_sb3_vec_env(gymnasium.make_vec("unjam/Ring-v0", num_envs=COUNT, **arguments))


def record(environment: VecEnv) -> list[Any]:
    """Return what a reset and steps return, with two sets of seeds."""
    found: list[Any] = []
    for step in range(STEPS):
        if step in (0, 50):
            environment.seed(SEED + step)
            found.append((environment.reset(), np.zeros(COUNT), np.zeros(COUNT, bool), [*environment.reset_infos]))
        actions = np.array([[float(row < 2) if step < 50 else np.sin(0.1 * step + row)] for row in range(COUNT)])
        found.append(environment.step(actions))
    found.append((*found[-1][:3], environment.reset_infos))  # of episodes that have started in steps
    environment.close()
    environment.close()
    return found


@pytest.mark.parametrize(
    ("name", "mode", "backend"),
    [
        ("truncated", None, "batch"),
        ("terminated", None, "batch"),
        pytest.param("truncated", "async", "sumo", marks=pytest.mark.long),
    ],
)
@pytest.mark.filterwarnings("ignore:another simulation is open")
def test_steps_are_those_of_the_vec_env_of_stable_baselines3(name: str, mode: Any, backend: str) -> None:
    """In particular no step lies between two episodes, and the last observation is that of the ended one."""
    ends = 0
    singles = DummyVecEnv([lambda: gymnasium.make("unjam/Ring-v0", backend=backend, **CASES[name])] * COUNT)
    for found, expected in zip(record(made(vectorization_mode=mode, **CASES[name])), record(singles), strict=True):
        np.testing.assert_allclose(found[0], expected[0], atol=2e-6)
        np.testing.assert_allclose(found[1], expected[1], atol=1e-5)
        np.testing.assert_array_equal(found[2], expected[2])
        assert [each.dtype for each in found[:3]] == [np.float32, found[1].dtype, bool]
        for info, single in zip(found[3], expected[3], strict=True):
            for key in (*ENDED, "reward_terms", "drawn_values"):
                assert (key in info) == (key in single)
                if key != "terminal_observation":
                    assert info.get(key) == pytest.approx(single.get(key), abs=1e-9)
                elif key in info:
                    np.testing.assert_allclose(info[key], single[key], atol=2e-6)
                    assert "episode_metrics" in info or mode
        ends += expected[2].sum()
    assert ends > COUNT


def test_a_replay_buffer_has_no_step_between_episodes() -> None:
    model = SAC("MlpPolicy", made(horizon=7), learning_starts=10**6, buffer_size=100 * COUNT, seed=0, device="cpu")
    model.learn(30 * COUNT)
    buffer: Any = model.replay_buffer
    after, before = buffer.next_observations[:29], buffer.observations[1:30]
    is_end = buffer.dones[:29].astype(bool)
    assert is_end[6::7].all()
    assert is_end.sum() == 4 * COUNT
    assert (buffer.timeouts == buffer.dones).all()  # which are bootstrapped
    np.testing.assert_array_equal(after[~is_end], before[~is_end])
    assert (before[is_end][:, 0] == 0.0).all()  # each episode starts from a standstill
    assert (buffer.rewards[:30] != 0.0).all()


def test_what_one_object_cannot_do_is_refused_in_one_line() -> None:
    same_step = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")], autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(InputError, match=r"autoreset_mode: .*SAME_STEP.* allowed: NEXT_STEP or DISABLED"):
        to_sb3_vec_env(same_step)
    with pytest.raises(InputError, match="device: 'cpu' is not allowed; allowed: none, so that"):
        made(device="cpu")
    with pytest.raises(InputError, match="environment: 'unjam/Ring-v0' is not allowed; allowed: an env"):
        to_sb3_vec_env("unjam/Ring-v0")  # pyright: ignore[reportArgumentType]
    environment = made()
    with pytest.raises(InputError, match="set_attr: 'horizon' is not allowed"):
        environment.set_attr("horizon", 3)
    with pytest.raises(InputError, match="env_method: 'render' is not allowed"):
        environment.env_method("render")
    environment.set_options([{}, {"length": 230}, {}])
    with pytest.raises(InputError, match="options: different options are not allowed"):
        environment.reset()
    assert environment.env_is_wrapped(gymnasium.Wrapper) == [False] * COUNT
    assert environment.get_attr("num_envs", [0, 1]) == [COUNT, COUNT]
    assert not environment.has_attr("unknown")


def test_without_stable_baselines3_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "unjam.adapters.stable_baselines3_env", raising=False)
    with pytest.raises(MissingPartError, match=r"stable_baselines3 is not installed.*unjam\[train\]"):
        made()


def test_slots_are_refused() -> None:
    ramps = gymnasium.make_vec("unjam/OnRamp-v0", num_envs=2, slots=3)
    with pytest.raises(InputError, match=r"actions of shape \(3, 1\) are not allowed; allowed: \(1,\)"):
        to_sb3_vec_env(ramps)
