from pathlib import Path

import numpy as np
import pytest

from unjam.drivers.car_following import Human
from unjam.drivers.network import Network
from unjam.physics.idm import PAPER_IDM, IDMParameters, idm_acceleration
from unjam.scenarios import make_scenario
from unjam.scenarios.population import Population, apply_population, write_population
from unjam.worlds.episode import run_episode

DRIVERS = (IDMParameters(time_headway=0.9), IDMParameters(time_headway=1.3, max_acceleration=1.4, minimum_gap=3.0))
QUARTER = Network(((np.zeros((3, 1)), np.array([np.arctanh(0.5)])),), 0.5)
"""a residual of a quarter m/s2, whatever it sees"""


def population(folder: Path, residual: Network | None = None) -> str:
    path = folder / "drivers.json"
    write_population(path, Population(PAPER_IDM, DRIVERS, (-4.0, 2.0), residual))
    return str(path)


def test_limits_and_residual_change_an_idm() -> None:
    seen = np.array([5.0, 5.0]), np.array([4.0, 0.0]), np.array([10.0, 0.5])
    acceleration = idm_acceleration(*seen)
    assert apply_population(None, acceleration, *seen) is acceleration
    found = apply_population(Population(PAPER_IDM, DRIVERS, (-4.0, 2.0), QUARTER), acceleration, *seen)
    np.testing.assert_allclose(found, [acceleration[0] + 0.25, -4.0])


@pytest.mark.parametrize("human_control", ["native", "commanded"])
def test_each_human_driver_on_the_ring_has_its_own_parameters(tmp_path: Path, human_control: str) -> None:
    file = population(tmp_path)
    scenario = make_scenario(
        "ring", {"population": file, "human_control": human_control, "noise": 0.0, "horizon": 300, "length": (300, 300)}
    )
    road = scenario.draw(np.random.default_rng(0))
    assert set(road.human_parameters.values()) == set(DRIVERS)
    episode = run_episode(scenario, Human(), (3,))
    assert episode.has_run
    acceleration = np.diff(episode.speeds, axis=0)[200:] / episode.control_step
    speeds, gaps = episode.speeds[200:-1], episode.gaps[200:-1]
    # The assignment of drivers is random: it is identified from their driving.
    wanted = [idm_acceleration(speeds, np.roll(speeds, -1, 1), gaps, one) for one in DRIVERS]
    errors = np.abs(np.array(wanted) - acceleration).max(1)
    assert errors.min(0).max() < 1e-6
    assert set(errors.argmin(0)) == {0, 1}


@pytest.mark.parametrize("name", ["ring", "figure-eight", "merge"])
def test_populations_with_a_residual_work_on_every_built_in_road(tmp_path: Path, name: str) -> None:
    file = population(tmp_path, QUARTER)
    episode = run_episode(make_scenario(name, {"population": file, "horizon": 60}), Human(), (0,))
    assert episode.status == "completed"
    assert np.nanmax(episode.speeds) > 1.0
