"""Calibration: human drivers and flows with which detectors measure what they did."""

import json
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import Any

import pytest
from optuna.distributions import FloatDistribution

from tests.worlds.sumo.user_networks import straight
from unjam.drivers import PISaturation
from unjam.errors import InputError, LostWorkerError, UnjamError
from unjam.measures.detectors import DETECTOR_COLUMNS, aggregate_passages, compute_agreement
from unjam.scenarios.user_network import UserNetwork, load_user_network
from unjam.seeds import held_out_seeds
from unjam.sumo_files import read_sumo_files
from unjam.training.calibrate import (
    CALIBRATED_NETWORK_FILE,
    CALIBRATION_FILE,
    FACTOR_RANGES,
    CalibrationResult,
    Corridor,
    calibrate,
    load_corridor,
    parse_factor_space,
    scale_vehicle_types,
)
from unjam.training.trial_log import REQUEST_FILE, TRIALS_FILE
from unjam.worlds.episode import run_episode
from unjam.worlds.sumo.detectors import DetectorPool
from unjam.worlds.sumo.simulation import DetectorPassage

INTERVAL = 60
END = 240
TRUE_SPEED, TRUE_FLOW, FLOW_NOW = 0.8, 600.0, 800.0
HUMAN_TYPE = '<vType id="person" carFollowModel="IDM" minGap="2" tau="{}" speedFactor="{}" speedDev="0.05"/>'
FLOW = '<flow id="f" type="person" route="along" begin="0" end="240" vehsPerHour="{}" departSpeed="max"/>'


def road(folder: Path, tau: float = 1.0, speed: float = 1.0, flow: float = FLOW_NOW) -> Path:
    """A road with one lane and human drivers with these parameters."""
    folder.mkdir(exist_ok=True)
    return straight(folder, HUMAN_TYPE.format(tau, speed) + FLOW.format(flow), 800.0, END)


def write_detectors(path: Path, file: Path, places: tuple[float, ...] = (200.0, 700.0)) -> Path:
    """A file of what detectors measure on a road, seed 12345."""
    rows = [
        f"road,{position},{begin},{begin + INTERVAL},0," for position in places for begin in range(0, END, INTERVAL)
    ]
    head = ",".join(("edge", *DETECTOR_COLUMNS))
    file.write_text("\n".join([head, *rows]) + "\n")
    corridor = load_corridor(str(path), file)
    with DetectorPool(1) as counting:
        (passed,) = counting.run(corridor.load_scenario(path), [(12345,)], corridor.loops)
    flows, speeds = aggregate_passages(corridor.measurements, corridor.loop_indices, passed)
    lines = [
        row.removesuffix("0,") + f"{flow:.1f},{'' if isnan(speed) else f'{speed:.3f}'}"
        for row, flow, speed in zip(rows, flows, speeds, strict=True)
    ]
    file.write_text("\n".join([head, *lines]) + "\n")
    return file


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Corridor:
    """A road with faster human drivers and a larger flow than measured."""
    folder = tmp_path_factory.mktemp("roads")
    detectors = write_detectors(road(folder / "true", 1.5, TRUE_SPEED, TRUE_FLOW), folder / "detectors.csv")
    return load_corridor(str(road(folder / "mine")), detectors)


SPACE = {"speedFactor": FACTOR_RANGES["speedFactor"], "flow": FACTOR_RANGES["flow"]}
TRIALS = 10


@pytest.fixture(scope="module")
def done(corridor: Corridor, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CalibrationResult]:
    """The folder of a calibration, and what it found."""
    folder = tmp_path_factory.mktemp("calibration")
    with pytest.MonkeyPatch.context() as patched, DetectorPool(2) as counting:
        patched.setattr("unjam.training.calibrate.CALIBRATION_TEST_SEEDS", 4)
        return folder, calibrate(corridor, folder, counting, SPACE, TRIALS, seeds_per_trial=1)


@pytest.mark.slow
def test_calibration_improves_the_agreement(corridor: Corridor, done: tuple[Path, CalibrationResult]) -> None:
    folder, found = done
    estimates = found.estimates()
    for name in ("geh", "flow_rmse", "speed_rmse", "score"):
        assert estimates[name]["difference"].high < 0, name
    assert found.factors["speedFactor"] == pytest.approx(TRUE_SPEED, abs=0.06)
    assert found.factors["flow"] == pytest.approx(TRUE_FLOW / FLOW_NOW, abs=0.1)
    written = json.loads((folder / CALIBRATION_FILE).read_text())
    assert written["factors"] == found.factors
    assert written["manifest"]["starts"]
    assert written["trials"][0]["factors"] == {"speedFactor": 1.0, "flow": 1.0}
    assert len(written["trials"]) == TRIALS
    assert read_sumo_files(corridor.files.path) == corridor.files  # the files have not changed


@pytest.mark.slow
def test_written_network_has_the_reported_agreement(corridor: Corridor, done: tuple[Path, CalibrationResult]) -> None:
    folder, found = done
    files = read_sumo_files(folder / CALIBRATED_NETWORK_FILE)
    own = corridor.files.types["person"]
    assert float(files.types["person"]["speedFactor"]) == pytest.approx(found.factors["speedFactor"])
    assert {**files.types["person"], "speedFactor": own["speedFactor"]} == own
    with DetectorPool(1) as counting:
        (passed,) = counting.run(
            corridor.load_scenario(folder / CALIBRATED_NETWORK_FILE), held_out_seeds(1), corridor.loops
        )
    flows, speeds = aggregate_passages(corridor.measurements, corridor.loop_indices, passed)
    assert compute_agreement(corridor.measurements, flows, speeds) == found.calibrated[0]
    road = load_user_network(str(folder / CALIBRATED_NETWORK_FILE), {"penetration_rate": 0.2})
    episode = run_episode(road, PISaturation(time_step=road.control_step), 1)
    assert episode.status == "completed"


@pytest.mark.slow
def test_interrupted_calibration_resumes(
    corridor: Corridor, done: tuple[Path, CalibrationResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, before = done
    rows = (folder / TRIALS_FILE).read_text().splitlines(keepends=True)
    (tmp_path / REQUEST_FILE).write_bytes((folder / REQUEST_FILE).read_bytes())
    (tmp_path / TRIALS_FILE).write_text("".join(rows[:-1]) + rows[-1][:9])  # killed while it wrote
    monkeypatch.setattr("unjam.training.calibrate.CALIBRATION_TEST_SEEDS", 4)
    driven: list[int] = []

    class Watched(DetectorPool):
        def run(self, scenario: UserNetwork, seeds: Any, loops: Any) -> list[list[DetectorPassage]]:
            driven.append(len(seeds))
            return super().run(scenario, seeds, loops)

    with Watched(2) as counting:
        again = calibrate(corridor, tmp_path, counting, SPACE, TRIALS, seeds_per_trial=1)
    assert driven == [2, 4, 4]
    assert again.trials == before.trials
    assert (again.factors, again.calibrated) == (before.factors, before.calibrated)


def test_folder_of_another_calibration_is_refused(corridor: Corridor, done: tuple[Path, CalibrationResult]) -> None:
    with DetectorPool(1) as counting, pytest.raises(InputError, match="was made with other settings"):
        calibrate(corridor, done[0], counting, SPACE, TRIALS, seeds_per_trial=2)


def test_unusable_original_network_is_reported(corridor: Corridor, tmp_path: Path) -> None:
    path = road(tmp_path / "broken")
    demand = path.with_name("demand.rou.xml")
    demand.write_text(demand.read_text().replace('route="along"', 'route="astray"'))
    broken = load_corridor(str(path), corridor.detectors)
    message = r"^\S+\.sumocfg: the original network cannot be simulated: SUMO cannot start.*astray"
    with DetectorPool(1) as counting, pytest.raises(UnjamError, match=message):
        calibrate(broken, tmp_path / "out", counting, SPACE, 2, seeds_per_trial=1)


TYPES = (
    '<vType id="drawn" tau="1.2" speedFactor="normc(1, 0.1,0.5,1.5)"/><vType id="bare"/>'
    '<vType id="quick" tau="0.05"/><vType id="lorry" vClass="truck" tau="2"/>'
)
EACH = "".join(
    f'<trip id="{name}" type="{name}" from="road" to="road" depart="0"/>'
    for name in ("drawn", "bare", "quick", "lorry")
)


def test_factors_scale_passenger_types_or_sumo_defaults(tmp_path: Path) -> None:
    files = read_sumo_files(straight(tmp_path, TYPES + EACH))
    assert scale_vehicle_types(files, {"tau": 0.5, "speedFactor": 0.9, "accel": 1.0, "flow": 2.0}) == {
        "drawn": {"tau": "0.6", "speedFactor": "normc(0.9,0.09,0.45,1.35)"},
        "bare": {"tau": "0.5", "speedFactor": "0.9"},
        "quick": {"tau": "0.05", "speedFactor": "0.9"},  # not below the step
    }
    assert scale_vehicle_types(files, {"tau": 0.05})["bare"] == {"tau": "0.1"}
    assert scale_vehicle_types(files, {"tau": 1.0, "flow": 2.0}) == {}


def test_attribute_that_is_not_a_number_is_refused(tmp_path: Path) -> None:
    files = read_sumo_files(straight(tmp_path, TYPES.replace("1.2", "long") + EACH))
    with pytest.raises(InputError, match="vType drawn: tau: 'long' is not allowed; allowed: a number"):
        scale_vehicle_types(files, {"tau": 0.5})


@pytest.mark.parametrize(
    ("kind", "row", "words"),
    [
        ("edge", "rood,5,0,60,1,1", "edge: 'rood' is not allowed; allowed: one of road.net.xml; did you mean 'road'?"),
        ("lane", "road_1,5,0,60,1,1", "lane: 'road_1' is not allowed; allowed: one of road.net.xml; did you mean"),
        ("edge", "road,5000,0,60,1,1", "edge road: position: 5000.0 is not allowed; allowed: <= 800 m"),
        ("edge", "road,5,300,360,1,1", "detectors.csv: no interval lies between 0 s and 240 s"),
    ],
)
def test_detector_off_the_network_is_refused(kind: str, row: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "detectors.csv"
    file.write_text(f"{kind},{','.join(DETECTOR_COLUMNS)}\n{row}\n")
    with pytest.raises(InputError) as error:
        load_corridor(str(road(tmp_path / "road")), file)
    assert words in str(error.value)


@pytest.mark.parametrize("unit", [1.0, 2.2369, 3.6])
def test_speeds_in_another_unit_are_refused(unit: float, tmp_path: Path) -> None:
    """On the road with a limit of 20 m/s: free flow at times, a jam at others, and one interval without vehicles."""
    file, speeds = tmp_path / "detectors.csv", (19.0, 18.5, 5.0)
    rows = [f"road,5,{60 * number},{60 * number + 60},9,{unit * speed:.1f}" for number, speed in enumerate(speeds)]
    file.write_text("\n".join([f"edge,{','.join(DETECTOR_COLUMNS)}", *rows, "road,5,180,240,0,"]))
    if unit == 1.0:
        assert len(load_corridor(str(road(tmp_path / "road")), file).measurements) == 4
        return
    with pytest.raises(
        InputError, match=r"detectors.csv: speed: .* times the speed limit is not allowed; allowed: m/s"
    ):
        load_corridor(str(road(tmp_path / "road")), file)


def test_intervals_outside_the_simulated_time_are_excluded(tmp_path: Path) -> None:
    file = tmp_path / "detectors.csv"
    rows = [f"road_0,5,{begin},{begin + 60},1,1" for begin in range(0, 360, 60)]
    file.write_text("\n".join([f"lane,{','.join(DETECTOR_COLUMNS)}", *rows]))
    path = str(road(tmp_path / "road"))
    corridor = load_corridor(path, file)
    assert (len(corridor.measurements), corridor.excluded_count, corridor.begin, corridor.end) == (4, 2, 0.0, 240.0)
    corridor = load_corridor(path, file, 60.0, 200.0)
    assert (len(corridor.measurements), corridor.excluded_count, corridor.begin, corridor.end) == (2, 4, 60.0, 180.0)
    assert len(corridor.loops) == 1


def test_network_without_passenger_cars_is_refused(tmp_path: Path) -> None:
    lorries = '<vType id="lorry" vClass="truck"/><trip id="a" type="lorry" from="road" to="road" depart="0"/>'
    file = tmp_path / "detectors.csv"
    file.write_text(f"edge,{','.join(DETECTOR_COLUMNS)}\nroad,5,0,60,1,1\n")
    with pytest.raises(InputError, match="no vehicle type is a passenger car; its types are lorry"):
        load_corridor(str(straight(tmp_path, lorries)), file)


def test_factor_space_needs_known_names_and_positive_ranges() -> None:
    assert parse_factor_space([]) == FACTOR_RANGES
    assert parse_factor_space(["tau=1..2"]) == {"tau": FloatDistribution(1.0, 2.0)}
    for text, words in (
        ("tua=1..2", "did you mean 'tau'"),
        ("tau=0..2", "factors > 0"),
        ("tau=0.5,1", "a range of factors"),
    ):
        with pytest.raises(InputError, match=words):
            parse_factor_space([text])


def test_requested_times_may_lie_after_those_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "detectors.csv"
    file.write_text(f"edge,{','.join(DETECTOR_COLUMNS)}\nroad,5,{END + 60},{END + 120},1,1\n")
    found = load_corridor(str(road(tmp_path / "road")), file, END + 30, END + 150)
    assert (found.begin, found.end) == (END + 30, END + 120)


def test_intervals_of_agreement_are_clipped_at_their_bounds(done: tuple[Path, CalibrationResult]) -> None:
    rows = [replace(done[1].original[0], geh_below_5=share, geh=9.0 * share) for share in (1.0, 1.0, 0.9, 0.0)]
    found = replace(done[1], original=rows, calibrated=rows[::-1]).estimates()
    assert found["geh_below_5"]["original"].high == 1.0
    assert found["geh"]["original"].low == 0.0
    assert found["geh"]["difference"].low < 0.0


def test_lost_process_is_not_a_verdict_on_the_factors(
    corridor: Corridor, done: tuple[Path, CalibrationResult], tmp_path: Path
) -> None:
    class Lost(DetectorPool):
        def run(self, scenario: UserNetwork, seeds: Any, loops: Any) -> list[list[DetectorPassage]]:
            raise LostWorkerError("SUMO was lost: its process ended with code -9")

    with Lost(1) as counting, pytest.raises(LostWorkerError):
        calibrate(corridor, tmp_path / "out", counting, SPACE, TRIALS, seeds_per_trial=1)
    assert not (tmp_path / "out" / TRIALS_FILE).exists()
