"""Commands that do not count as overridden: creeping, and speeds that the vehicle cannot reach."""

from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import Constant, PISaturation
from unjam.drivers.local_state import MAX_OBSERVED_GAP
from unjam.drivers.registry import driver_from_name
from unjam.measures.metrics import measure
from unjam.scenarios import Merge, Ring, make_scenario
from unjam.seeds import held_out_seeds
from unjam.worlds.audit import OVERRIDE_TOLERANCE
from unjam.worlds.episode import run_episode


@pytest.mark.long
def test_preventing_creeping_is_not_an_override() -> None:
    road = make_scenario("family/ring-66-grown-4-cavs").stratum(1, 10)
    row = measure(run_episode(replace(road, horizon=620), PISaturation(), held_out_seeds(2)[1]))
    assert 0.0 < row["shield_max_braking"] < OVERRIDE_TOLERANCE, "SUMO holds it, a micrometre from its place"
    assert (row["override_share"], row["shield_override_share"]) == (0.0, 0.0)


def test_a_command_beyond_the_top_speed_is_not_an_override() -> None:
    road = Ring(vehicles=2, length=(1500, 1500), horizon=600)
    episode = run_episode(road, driver_from_name("constant:acceleration=0.9", 0.1), (1,))
    row = measure(episode)
    assert episode.trajectories[0].states.speed.max() == road.top_speed
    assert (row["shield_max_braking"], row["override_share"], row["shield_override_share"]) == (0.0, 0.0, 0.0)


def test_a_command_beyond_the_speed_limit_is_not_an_override() -> None:
    changes = {"actuation": "shielded", "horizon": 60, "inflow": 600, "penetration_rate": 0.2, "peak": (0, 60)}
    episode = run_episode(make_scenario("on-ramp", changes), driver_from_name("constant:acceleration=1", 1.0), (1,))
    free = at_the_limit = 0
    for each in episode.trajectories:
        states, alone = each.states.select(slice(1, None)), each.states.leader_gap[1:] >= MAX_OBSERVED_GAP
        assert states.allowed_speed is not None
        limited = alone & (states.speed > states.allowed_speed - 1e-6)
        free, at_the_limit = free + int(alone.sum()), at_the_limit + int(limited.sum())
        assert each.shield_braking[limited].max(initial=0.0) < 1e-6
    assert free > at_the_limit > 5


def test_reductions_by_the_filter_before_an_own_acc_count_once() -> None:
    road = make_scenario("on-ramp", {"horizon": 100, "penetration_rate": 0.3, "safety.active": True, "peak": (0, 100)})
    episode = run_episode(road, driver_from_name("cruise", 1.0), (1,))
    assert max(each.filter_braking.max() for each in episode.trajectories) > 0.1
    for each in episode.trajectories:
        np.testing.assert_allclose(each.applied_acceleration, np.diff(each.states.speed) / road.control_step, atol=1e-9)


def test_braking_in_the_first_step_after_the_warm_up_counts() -> None:
    road = Merge(warmup=200, horizon=2, penetration_rate=0.3)
    for acceleration in (0.0, -1.0):
        row = measure(run_episode(road, Constant(acceleration=acceleration), (1,)))
        assert (row["cav_max_braking"] > 0.9) == (acceleration < 0.0)
    one_step = replace(road, horizon=1, steps_per_control_step=1)
    assert measure(run_episode(one_step, Constant(acceleration=-1.0), (1,)))["cav_max_braking"] == pytest.approx(1.0)
