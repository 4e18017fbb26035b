from dataclasses import fields, is_dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
import pytest

from tests.conftest import random_network
from unjam.drivers import IDM, Constant, Driver, Human, PISaturation, ResidualDriver
from unjam.drivers.safety import SafetyFilter
from unjam.scenarios import Ring
from unjam.tree import pack, unpack
from unjam.worlds.episode import run_episode
from unjam.worlds.messages import read_message, write_message
from unjam.worlds.record import Episode, Trajectory, failed_episode
from unjam.worlds.sumo.backend import SumoBackend

RING = Ring(length=(230, 240), horizon=60)


def fingerprint(value: Any) -> Any:
    """All of an episode, to the last bit, in a form that can be compared."""
    if is_dataclass(value):
        return {field.name: fingerprint(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: fingerprint(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return type(value).__name__, [fingerprint(entry) for entry in value]
    return repr(value)


def serialize_and_restore(episode: Episode) -> Episode:
    pipe = BytesIO()
    write_message(pipe, *pack(episode))
    pipe.seek(0)
    return unpack(Episode, *read_message(pipe))


def test_fingerprints_differ_in_the_last_bit_of_any_array() -> None:
    episode = Episode(seed=(1,), status="completed", speeds=np.ones((3, 2)))
    changed = np.ones((3, 2))
    changed[2, 1] = np.nextafter(1.0, 2.0)
    assert fingerprint(replace(episode, speeds=changed)) != fingerprint(episode)
    assert fingerprint(replace(episode, speeds=np.ones((2, 3)))) != fingerprint(episode)


@pytest.mark.parametrize(
    ("scenario", "driver"),
    [
        (RING, IDM()),
        (replace(RING, warmup=30), Human()),
        (replace(RING, actuation="raw", safety=SafetyFilter(active=False)), Constant(1.0)),
        (replace(RING, cavs=3), PISaturation()),
        (
            replace(RING, cavs=2, steps_per_control_step=2),
            ResidualDriver(IDM(), random_network(), 1.0, action_repeat=4),
        ),
    ],
)
def test_an_episode_arrives_as_it_was_sent(scenario: Ring, driver: Driver, sumo: SumoBackend) -> None:
    episode = run_episode(scenario, driver, (1, 2), explore=True, record_details=scenario.cavs == 3, backend=sumo)
    assert len(episode.trajectories) == scenario.cavs
    assert fingerprint(serialize_and_restore(episode)) == fingerprint(episode)


def test_nan_and_infinity_arrive() -> None:
    episode = Episode(
        seed=(0,),
        status="completed",
        speeds=np.array([[np.nan, np.inf, -0.0]]),
        limit_speed=float("inf"),
        drawn_values={"length": float("nan")},
    )
    assert fingerprint(serialize_and_restore(episode)) == fingerprint(episode)


def test_a_failed_episode_arrives_with_its_reason() -> None:
    episode = failed_episode((3, 4), "lost the map: 'Straße'\nline 2", "InputError")
    arrived = serialize_and_restore(episode)
    assert fingerprint(arrived) == fingerprint(episode)
    assert (arrived.status, arrived.has_run, arrived.control_steps) == ("failed", False, 0)
    assert (arrived.seed, arrived.error) == ((3, 4), "InputError")


def test_only_a_failed_episode_has_not_run() -> None:
    found = {status: Episode(seed=(0,), status=status).has_run for status in ("completed", "collision", "failed")}
    assert found == {"completed": True, "collision": True, "failed": False}


def test_the_reward_of_a_held_residual_is_the_sum_over_its_control_steps(sumo: SumoBackend) -> None:
    driver = ResidualDriver(IDM(), random_network(), 1.0, action_repeat=7)
    trajectory: Trajectory = run_episode(RING, driver, (0,), backend=sumo).trajectories[0]
    reward = trajectory.reward_terms["speed"] + trajectory.reward_terms["acceleration"]
    np.testing.assert_array_equal(trajectory.reward, reward)
    residuals, rewards = trajectory.actions_and_rewards
    assert len(residuals) == len(rewards) == 9  # 8 complete action repeats and one of 4 control steps
    for look in range(9):
        held = slice(7 * look, 7 * (look + 1))
        np.testing.assert_array_equal(trajectory.residual[held], residuals[look])
        assert rewards[look] == pytest.approx(reward[held].sum(), abs=1e-12)
    assert len(trajectory.observations) == 10
