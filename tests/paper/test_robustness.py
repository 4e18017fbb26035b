import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unjam.controller import controller_bytes, make_driver
from unjam.physics.idm import PAPER_IDM, IDMParameters
from unjam.scenarios.population import Population, write_population
from unjam_paper import robustness


@pytest.mark.long
def test_human_drivers_are_simulated_on_the_ring_with_and_without_a_cav(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    road = {"length": (80, 80), "vehicles": 8, "warmup": 300, "horizon": 200}
    monkeypatch.setattr(robustness, "EXPERIMENT_RING", road)
    monkeypatch.setattr(robustness, "CONDITION_EPISODES", 1)
    drivers = (PAPER_IDM, IDMParameters(time_headway=1.4))
    write_population(tmp_path / "drivers.json", Population(PAPER_IDM, drivers, (-4.0, 2.0)))
    (tmp_path / "pi.unjam").write_bytes(controller_bytes(make_driver("pi", 0.1), {}))
    populations = {"calibrated": tmp_path / "drivers.json"}
    robustness.humans_on_ring(tmp_path / "out", populations, tmp_path / "pi.unjam", 1)
    rows = json.loads((tmp_path / "out" / "ring.json").read_text())["rows"]
    found = [(row["humans"], row["driver"]) for row in rows]
    assert found == [
        (humans, driver) for humans in ("paper's IDM", "calibrated") for driver in ("human", "pi", "trained")
    ]
    assert rows[1]["mean_speed"] == rows[2]["mean_speed"] != rows[4]["mean_speed"]
    assert all("wave_speed" in row for row in rows)
    assert (tmp_path / "out" / "ring.png").stat().st_size > 10_000


LOOP, STEP = 230.0, 0.1


def moving_pattern(speed: float, size: float = 2.0) -> Any:
    """Vehicles with a speed profile that moves at `speed` along the road."""
    times = np.arange(1200) * STEP
    positions = np.arange(22) * LOOP / 22 + 3.0 * times[:, None]
    pattern = np.cos(2 * np.pi * (positions - speed * times[:, None]) / LOOP) ** 3
    return SimpleNamespace(speeds=4.0 + size * pattern, positions=positions, loop_length=LOOP, control_step=STEP)


@pytest.mark.parametrize("speed", [-5.6, -3.0, 0.0, 4.0])
def test_wave_speed_is_that_of_a_moving_pattern(speed: float) -> None:
    assert robustness.wave_speed(moving_pattern(speed)) == pytest.approx(speed, abs=0.1)


def test_without_a_wave_there_is_no_wave_speed() -> None:
    assert np.isnan(robustness.wave_speed(moving_pattern(-5.0, size=0.1)))


def test_speeds_are_interpolated_across_the_end_of_the_loop() -> None:
    field = robustness.speed_along_road(np.array([[1.0, 3.0]]), np.array([[10.0, LOOP - 10.0]]), LOOP)
    assert field[0, 0] == pytest.approx(2.0)
