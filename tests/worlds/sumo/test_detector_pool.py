"""Induction loops in SUMO: passages are the same for any number of processes, also after failed simulations."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.worlds.sumo.user_networks import game, straight
from unjam.errors import EpisodeError, LostWorkerError
from unjam.scenarios.user_network import UserNetwork, load_user_network
from unjam.worlds.sumo.detectors import MAX_DETECTOR_ATTEMPTS, DetectorPool, load_with_loops
from unjam.worlds.sumo.simulation import DetectorPassage, InductionLoop, Simulation, loop_name

STEADY = (
    '<vType id="steady" speedFactor="0.5" speedDev="0" sigma="0"/>'
    '<flow id="f" type="steady" route="along" begin="0" end="60" period="6" departSpeed="max"/>'
)


def road(folder: Path, vehicles: str = STEADY) -> UserNetwork:
    """Human-only traffic on a road with one lane."""
    folder.mkdir(exist_ok=True)
    return load_user_network(str(straight(folder, vehicles)), {"penetration_rate": 1e-12})


def test_passages_have_time_and_speed_of_each_vehicle(tmp_path: Path) -> None:
    with DetectorPool(1) as counting:
        (passed,) = counting.run(road(tmp_path), [(1,)], [InductionLoop("road_0", 105.0)])
    assert [one.vehicle for one in passed] == [f"f.{number}" for number in range(9)]
    # They begin at 5.1 m (a car's length, SUMO's base position) with 10 m/s, six seconds apart.
    assert [one.time for one in passed] == pytest.approx([10.0 + 6 * number for number in range(9)], abs=0.25)
    assert [one.speed for one in passed] == pytest.approx([10.0] * 9)


@pytest.mark.long
def test_passages_do_not_depend_on_the_number_of_processes(tmp_path: Path) -> None:
    random = STEADY.replace('period="6"', 'probability="0.3"')
    seeds = [(1,), (2,), (1,)]
    found = []
    for count in (1, 2):
        with DetectorPool(count) as counting:
            found.append(counting.run(road(tmp_path, random), seeds, [InductionLoop("road_0", 50.0)]))
    assert found[0] == found[1]
    assert found[0][0] == found[0][2] != found[0][1]


@pytest.mark.long
def test_other_simulations_continue_after_a_failed_one(tmp_path: Path) -> None:
    with DetectorPool(1) as counting:
        with pytest.raises(EpisodeError, match="SUMO cannot start"):
            counting.run(road(tmp_path), [(1,), (2,)], [InductionLoop("nowhere_0", 5.0)])
        assert counting.run(road(tmp_path), [(1,)], [InductionLoop("road_0", 5.0)]) != [[]]


def test_a_lane_change_on_a_loop_has_no_speed_as_with_sumos_own_detectors(tmp_path: Path) -> None:
    loops = [InductionLoop(f"{edge}_{lane}", at) for edge, at in (("gneE2", 50.0), ("gneE7", 60.0)) for lane in (0, 1)]
    ramp = load_user_network(str(game(tmp_path, "ramp")), {"penetration_rate": 1e-12})
    with Simulation() as simulation:
        load_with_loops(simulation, ramp, (1,), loops)
        passed = simulation.passages(loops, 250)
        loops_of_sumo = simulation._sumo.inductionloop
        own = [loops_of_sumo.getIntervalMeanSpeed(loop_name(number)) for number in range(len(loops))]
    speeds = [np.array([one.speed for one in passed if one.loop == number]) for number in range(len(loops))]
    assert [np.nanmean(each) for each in speeds] == pytest.approx(own, rel=1e-9)
    assert sum(int(np.isnan(each).sum()) for each in speeds) == 3


def test_a_lost_simulation_is_repeated_and_repeated_losses_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, left = DetectorPool._run_seed, [0]

    def lost(self: DetectorPool, *arguments: Any) -> list[DetectorPassage]:
        if left[0] > 0:
            left[0] -= 1
            raise LostWorkerError("SUMO was lost: its process ended with code -9")
        return run(self, *arguments)

    monkeypatch.setattr(DetectorPool, "_run_seed", lost)
    with DetectorPool(1) as counting:
        left[0] = MAX_DETECTOR_ATTEMPTS - 1
        assert len(counting.run(road(tmp_path), [(1,)], [InductionLoop("road_0", 105.0)])[0]) == 9
        left[0] = MAX_DETECTOR_ATTEMPTS
        with pytest.raises(LostWorkerError, match="-9"):
            counting.run(road(tmp_path), [(1,)], [InductionLoop("road_0", 105.0)])
