import numpy as np
import pytest

from unjam.errors import InputError
from unjam.following.four_regimes import REGIMES, FourRegimesSettings, make_four_regimes
from unjam.parameters import build_dataclass
from unjam.recordings.trajectories import following_samples


def test_default_row_count_is_that_of_the_paper() -> None:
    assert len(following_samples(make_four_regimes(FourRegimesSettings()))) == 262_630


def test_same_seed_gives_the_same_data() -> None:
    settings = FourRegimesSettings(samples=3000)
    for one, other in zip(make_four_regimes(settings), make_four_regimes(settings), strict=True):
        np.testing.assert_array_equal(one.speed, other.speed)
        np.testing.assert_array_equal(one.gap, other.gap)
    changed = make_four_regimes(FourRegimesSettings(samples=3000, seed=1))
    assert (changed[0].speed != make_four_regimes(settings)[0].speed).any()


def test_each_regime_starts_with_its_acceleration() -> None:
    trajectories = make_four_regimes(FourRegimesSettings(samples=60_000, acceleration_noise=0.0))
    starts = {
        kind: np.array([trajectory.acceleration[0] for trajectory in trajectories if trajectory.kind == kind])
        for kind in REGIMES
    }
    assert (starts["acceleration"] > 0).all()
    assert ((starts["deceleration"] <= 0) & (starts["deceleration"] >= -2)).all()
    np.testing.assert_allclose(starts["cruising"], 0.0, atol=1e-9)
    np.testing.assert_allclose(starts["emergency braking"], -2.0, atol=1e-9)


def test_leaders_keep_their_speed_and_followers_move_by_euler_steps() -> None:
    for trajectory in make_four_regimes(FourRegimesSettings(samples=3000)):
        assert len(set(trajectory.leader_speed)) == 1
        np.testing.assert_allclose(
            np.diff(trajectory.gap), (trajectory.leader_speed[1:] - trajectory.speed[1:]) * trajectory.time_step
        )


def test_initial_speed_above_the_desired_speed_is_refused() -> None:
    with pytest.raises(InputError, match=r"initial_speed: 40.0 m/s is not allowed"):
        build_dataclass(FourRegimesSettings, {"initial_speed": (5.0, 40.0)}, "regimes")
