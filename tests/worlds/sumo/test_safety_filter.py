"""The safety filter alone keeps CAVs safe in SUMO without SUMO's safety check."""

from dataclasses import replace

import numpy as np
import pytest

from unjam.drivers import IDM, Driver, PISaturation
from unjam.drivers.car_following import Constant
from unjam.drivers.safety import INSTANT_ACTUATOR, Actuator, SafetyFilter
from unjam.drivers.sensors import Sensors
from unjam.measures.feasibility import FEASIBLE
from unjam.measures.metrics import measure
from unjam.scenarios import FigureEight, Merge, Ring, Scenario
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.backend import SumoBackend

RAW = Ring(actuation="raw", horizon=1500, warmup=600, actuator=INSTANT_ACTUATOR)


@pytest.mark.parametrize("actuator", [Actuator(), Actuator(lag=0.3, delay=0.2)], ids=["at once", "late"])
@pytest.mark.parametrize(
    ("vehicles", "length", "cavs"), [(5, 50, 1), (22, 220, 1), (22, 270, 3), (44, 440, 2), (44, 500, 3)]
)
def test_a_reckless_driver_has_no_contact_on_any_ring(
    vehicles: int, length: int, cavs: int, actuator: Actuator, sumo: SumoBackend
) -> None:
    ring = replace(RAW, vehicles=vehicles, length=(length, length), cavs=cavs, actuator=actuator)
    episode = run_episode(ring, Constant(1.0), (3,), backend=sumo)
    row = measure(episode)
    assert (row["status"], row["collisions"]) == ("completed", 0.0)
    assert row["feasibility"] == FEASIBLE
    assert row["filter_override_share"] > 0.1
    assert row["min_time_gap"] > 1.0


@pytest.mark.long
@pytest.mark.parametrize("actuator", [Actuator(), Actuator(lag=0.3, delay=0.2)], ids=["at once", "late"])
def test_there_is_no_contact_with_noisy_sensors_and_missing_readings(actuator: Actuator, sumo: SumoBackend) -> None:
    sensors, safety = Sensors(0.5, 0.5, dropout=0.3), SafetyFilter(gap_error=0.5, speed_error=0.5)
    ring = replace(RAW, cavs=2, sensors=sensors, safety=safety, actuator=actuator)
    episode = run_episode(ring, Constant(1.0), (3,), backend=sumo)
    row = measure(episode)
    assert (row["status"], row["collisions"], row["feasibility"]) == ("completed", 0.0, FEASIBLE)
    assert row["min_time_gap"] > 1.0
    again = run_episode(ring, Constant(1.0), (3,), backend=sumo)
    np.testing.assert_array_equal(episode.speeds, again.speeds)


def test_the_command_is_the_output_of_the_filter(sumo: SumoBackend) -> None:
    episode = run_episode(RAW, Constant(1.0), (0,), backend=sumo)
    (cav,) = episode.trajectories
    np.testing.assert_allclose(cav.applied_acceleration, 1.0 - cav.filter_braking, atol=1e-12)
    expected = np.maximum(cav.states.speed[:-1] + 0.1 * cav.applied_acceleration, 0.0)
    np.testing.assert_allclose(cav.states.speed[1:], expected, atol=1e-9)


def test_every_simulation_step_of_a_control_step_is_filtered(sumo: SumoBackend) -> None:
    ring = replace(RAW, steps_per_control_step=10, horizon=150)
    episode = run_episode(ring, Constant(1.0), (0,), backend=sumo)
    assert episode.audit.following.min_time_gap > 1.0
    assert measure(episode)["feasibility"] == FEASIBLE


@pytest.mark.parametrize("road", [Ring(horizon=1500, warmup=3000), FigureEight(horizon=800)])
@pytest.mark.parametrize("driver", [IDM(), PISaturation(), Constant(1.0)])
def test_sumo_overrides_no_command_in_following(road: Scenario, driver: Driver, sumo: SumoBackend) -> None:
    assert run_episode(road, driver, (1,), backend=sumo).audit.following.override_share == 0.0


def test_yielding_on_the_figure_eight_is_counted_separately(sumo: SumoBackend) -> None:
    episode = run_episode(FigureEight(), PISaturation(catch_up_speed=8.0), (1,), backend=sumo)
    statistics = episode.audit.following
    assert statistics.override_share == 0.0
    assert statistics.yield_share == pytest.approx((episode.trajectories[0].shield_braking > 1e-5).mean())


@pytest.mark.long
def test_human_braking_on_the_published_merge_is_infeasible_and_elsewhere_feasible(sumo: SumoBackend) -> None:
    published = run_episode(Merge(), IDM(), (0,), backend=sumo)
    assert measure(published)["feasibility"] not in ("", FEASIBLE)
    assert published.audit.human_braking.max_braking > 9.0
    bounded = Merge(safety=SafetyFilter(), enforce_human_limits=True, right_of_way=True)
    bounded_episode = run_episode(bounded, IDM(), (0,), backend=sumo)
    assert bounded_episode.audit.human_braking.max_braking < published.audit.human_braking.max_braking


def test_the_required_time_gap_is_kept_and_may_be_zero(sumo: SumoBackend) -> None:
    for time_gap in (0.0, 1.5):
        ring = replace(RAW, warmup=0, safety=SafetyFilter(time_gap=time_gap))
        min_time_gap = run_episode(ring, Constant(1.0), (0,), backend=sumo).audit.following.min_time_gap
        assert min_time_gap > 1.5 if time_gap else min_time_gap < 1.0
