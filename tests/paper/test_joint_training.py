"""Tables and controllers of studies that train on many roads together."""

import json
from pathlib import Path
from typing import Any

import pytest

from unjam.drivers.wrappers import MIN_SHARED_PENETRATION_RATE
from unjam.road_family import FAMILY
from unjam.scenarios.family import family_roads
from unjam_paper.all_roads import (
    FAMILY_EXPERTS,
    FAMILY_TEST_SEEDS,
    FRESH_TEST_SEEDS,
    RING_BASELINES,
    RING_GROUP,
    SHARED_RING_ROADS,
    joint_controller,
    joint_training_table,
    measure_road,
)
from unjam_paper.results_file import read_part
from unjam_paper.study import PlannedRun, StudyFolder
from unjam_paper.variants import RINGS_EXPERT

ALL_ROADS = Path(__file__).parents[2] / "results/all-roads.json"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the results of three rings with three trainings each, which have the rows of known drivers."""
    for number, name in enumerate(("ring-22-grown", "ring-44-grown", "ring-22-dense")):
        results = read_part(ALL_ROADS, f"{list(FAMILY).index(name):02d}")
        rows = results["rows"]
        careful, slow = rows["unjam:best"], rows["jam-ahead"]
        results["rows"] |= dict.fromkeys(RING_BASELINES, careful) | {results["best"]: careful}
        results["rows"] |= {"residual 0": careful, "residual 1": careful, "residual 2": slow}
        (tmp_path / f"{number:02d}.json").write_text(json.dumps(results))
    return tmp_path


def test_a_row_has_the_mean_of_trainings_and_their_difference_to_the_expert(folder: Path) -> None:
    table = joint_training_table(["residual"], ("training",), RING_BASELINES, folder).set_index("road")
    assert list(table.index) == ["ring-22-grown", "ring-44-grown", "mean", "worst", "infeasible"]
    assert table.loc["ring-22-grown", RINGS_EXPERT].startswith("+1.00")
    # Two of three are the expert, and one gains 0.08 and 0.05.
    assert table.loc["ring-22-grown", "residual"].startswith("+0.69")
    assert table.loc["mean", f"residual, difference to {RINGS_EXPERT}"].startswith("-0.31")
    faster = table.loc["ring-22-grown", f"residual, mean speed, difference to {RINGS_EXPERT} [m/s]"]
    assert faster.startswith("-0."), "of whole episodes, compared with a driver that dissolves the wave"
    assert table.loc["worst", "residual"] == "+0.68"
    assert table.loc["infeasible", "residual"] == "0 of 6"


def test_a_table_has_only_the_roads_of_its_parts(folder: Path) -> None:
    rows = list(joint_training_table(["residual"], ("axis",), RING_BASELINES, folder)["road"])
    assert rows == ["ring-22-dense", "mean", "worst", "infeasible"]


def test_shared_rings_are_evaluated_on_fresh_seeds_and_unseen_rings() -> None:
    assert not set(FRESH_TEST_SEEDS) & set(FAMILY_TEST_SEEDS)
    additional = [name for name in SHARED_RING_ROADS if name not in FAMILY]
    assert len(additional) == 8
    for name, road in SHARED_RING_ROADS.items():
        assert road.part == (FAMILY[name].part if name in FAMILY else "axis")
        assert road.options["cavs"] >= MIN_SHARED_PENETRATION_RATE * road.options["vehicles"]


def test_a_training_on_several_roads_is_finished_when_all_are_evaluated(tmp_path: Path) -> None:
    studies, run = StudyFolder(tmp_path), PlannedRun("rings", "rings", 0)
    assert studies.controller_folder(run) == studies.run_folder(run) / "ring-22-no-warm-up"
    assert set(run.config.task_configs()) == {
        name for name, ring in family_roads(RING_GROUP).items() if ring.part == "training"
    }
    assert not studies.is_finished(run)


def test_each_road_type_is_driven_with_its_own_limits_and_control_step(tmp_path: Path) -> None:
    studies, run = StudyFolder(tmp_path), PlannedRun("all-roads", "all-roads", 0)
    for name, training_road in (
        ("ring-88-grown", "ring-22-no-warm-up"),
        ("figure-eight-wide", "figure-eight-14"),
        ("one-lane-10", "on-ramp-5"),
    ):
        assert joint_controller(FAMILY[name], run, studies) == studies.run_folder(run) / training_road


def test_all_drivers_of_a_ring_have_the_same_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[tuple[set[str], list[tuple[int, ...]]]] = []

    def drive(scenario: object, drivers: dict[str, str], seeds: list[tuple[int, ...]], *rest: object) -> Any:
        runs.append((set(drivers.values()), seeds))
        return {label: [] for label in drivers}

    monkeypatch.setattr("unjam_paper.all_roads.drive_by_label", drive)
    monkeypatch.setattr("unjam_paper.all_roads.best_feasible_driver", lambda rows: "pi")
    drivers = RING_BASELINES | {"residual 0": "runs/0"}
    name, experts = "ring-22-grown", FAMILY_EXPERTS["rings"]
    results = measure_road(name, FAMILY[name], experts, drivers, FAMILY_TEST_SEEDS, in_batches=True, workers=1)
    (candidates, tuning), (evaluated, testing) = runs
    assert {"human", "pi", RINGS_EXPERT} <= evaluated
    assert "runs/0" in evaluated - candidates
    assert not set(tuning) & set(testing)
    assert (results["best"], results["part"]) == ("pi", "training")
