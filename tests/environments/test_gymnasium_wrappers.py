"""Gymnasium's own wrappers around the environments."""

import sys
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo, TimeAwareObservation

ACTION = np.zeros(1, np.float32)


def episode_length(environment: gymnasium.Env) -> int:
    environment.reset(seed=0)
    steps = 1
    while not environment.step(ACTION)[3]:
        steps += 1
    return steps


@pytest.mark.parametrize("horizon", [40, 3100])
def test_make_keeps_the_horizon_of_the_scenario(horizon: int) -> None:
    with closing(gymnasium.make("unjam/Ring-v0", horizon=horizon)) as environment:
        assert environment.spec
        assert environment.spec.max_episode_steps == horizon
        assert episode_length(environment) == horizon
    with closing(gymnasium.make(environment.spec)) as again:  # which adds a TimeLimit
        assert "TimeLimit" in str(again)
        assert episode_length(again) == horizon


def test_a_time_limit_of_make_counts_if_it_is_shorter() -> None:
    with closing(gymnasium.make("unjam/Ring-v0", max_episode_steps=7)) as environment:
        assert environment.spec
        assert (environment.spec.max_episode_steps, episode_length(environment)) == (7, 7)


def test_time_aware_observations_count_up_to_the_horizon() -> None:
    with closing(TimeAwareObservation(gymnasium.make("unjam/Ring-v0", horizon=20))) as environment:
        observation, _ = environment.reset(seed=0)
        times, truncated = [observation[-1]], False
        while not truncated:
            observation, _, _, truncated, _ = environment.step(ACTION)
            times.append(observation[-1])
    np.testing.assert_array_equal(times, np.arange(21))


def test_record_video_has_a_frame_for_each_step(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    written: list[tuple[int, int, tuple[int, ...]]] = []

    class Clip:
        """Stands for moviepy, which only encodes the frames."""

        def __init__(self, frames: list[np.ndarray], fps: int) -> None:
            written.append((len(frames), fps, frames[0].shape))
            assert not np.array_equal(frames[0], frames[-1])

        def write_videofile(self, path: str, **options: Any) -> None:
            pass

    for name, members in (("moviepy", {}), ("moviepy.video.io.ImageSequenceClip", {"ImageSequenceClip": Clip})):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**members))  # pyright: ignore[reportArgumentType]
    made = gymnasium.make("unjam/Ring-v0", render_mode="rgb_array", horizon=12, warmup=50)
    with closing(RecordVideo(made, str(tmp_path))) as environment:
        assert episode_length(environment) == 12
    assert written == [(13, 10, (640, 640, 3))]
