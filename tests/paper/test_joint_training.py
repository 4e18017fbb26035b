"""Do studies of what is trained on many roads together say what their files hold?"""

import json
from pathlib import Path
from typing import Any

import pytest

from unjam.drivers.road_type_switch import MIN_SHARED_PENETRATION_RATE
from unjam.training.presets import RINGS_EXPERT
from unjam.training.road_family import FAMILY, family_roads
from unjam_paper.all_roads import FAMILY_TEST_SEEDS
from unjam_paper.joint_training import (
    FRESH_TEST_SEEDS,
    RING_BASELINES,
    RING_GROUP,
    SHARED_RING_ROADS,
    _measure_road,
    joint_controller,
    joint_training_table,
)
from unjam_paper.results_file import read_part
from unjam_paper.study import PlannedRun, StudyFolder

EVERYWHERE = Path(__file__).parents[2] / "results/everywhere.json"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three rings with three trainings each, which drive as known drivers do."""
    for number, name in enumerate(("ring-22-grown", "ring-44-grown", "ring-22-dense")):
        at = list(FAMILY).index(name)
        found = read_part(EVERYWHERE, f"{at:02d}")
        rows = found["rows"]
        careful, slow = rows["unjam:best"], rows["jam-ahead"]
        found["rows"] |= dict.fromkeys(RING_BASELINES, careful) | {found["best"]: careful}
        found["rows"] |= {"residual 0": careful, "residual 1": careful, "residual 2": slow}
        (tmp_path / f"{number:02d}.json").write_text(json.dumps(found))
    return tmp_path


def test_a_row_is_the_mean_of_the_trainings_and_of_what_they_are_beyond_the_expert(folder: Path) -> None:
    shown = joint_training_table(["residual"], ("seen",), RING_BASELINES, folder).set_index("road")
    assert list(shown.index) == ["ring-22-grown", "ring-44-grown", "mean", "worst", "not drivable"]
    assert shown.loc["ring-22-grown", RINGS_EXPERT].startswith("+1.00")
    # Two of three are the expert, and one gains next to nothing: 0.08 and 0.05 of what it gains.
    assert shown.loc["ring-22-grown", "residual"].startswith("+0.69")
    assert shown.loc["mean", f"residual, beyond {RINGS_EXPERT}"].startswith("-0.31")
    faster = shown.loc["ring-22-grown", f"residual, mean speed beyond {RINGS_EXPERT} [m/s]"]
    assert faster.startswith("-0."), "the whole episode, beside a driver that dissolves the wave"
    assert shown.loc["worst", "residual"] == "+0.68"
    assert shown.loc["not drivable", "residual"] == "0 of 6"


def test_roads_of_another_part_have_a_table_of_their_own(folder: Path) -> None:
    rows = list(joint_training_table(["residual"], ("axis",), RING_BASELINES, folder)["road"])
    assert rows == ["ring-22-dense", "mean", "worst", "not drivable"]


def test_shared_rings_are_judged_on_seeds_and_rings_that_chose_nothing() -> None:
    assert not set(FRESH_TEST_SEEDS) & set(FAMILY_TEST_SEEDS)
    new = [name for name in SHARED_RING_ROADS if name not in FAMILY]
    assert len(new) == 8
    for name, road in SHARED_RING_ROADS.items():
        assert road.part == (FAMILY[name].part if name in FAMILY else "axis")
        assert road.options["cavs"] >= MIN_SHARED_PENETRATION_RATE * road.options["vehicles"]


def test_a_training_on_several_roads_is_finished_when_all_are_judged(tmp_path: Path) -> None:
    studies, run = StudyFolder(tmp_path), PlannedRun("rings", "rings", 0)
    assert studies.controller_folder(run) == studies.run_folder(run) / "ring-22-standing"
    assert set(run.config.task_configs()) == {
        name for name, ring in family_roads(RING_GROUP).items() if ring.part == "seen"
    }
    assert not studies.is_finished(run)


def test_each_kind_of_road_is_driven_with_its_own_limits_and_decisions(tmp_path: Path) -> None:
    studies, run = StudyFolder(tmp_path), PlannedRun("everywhere", "everywhere", 0)
    for name, of in (
        ("ring-88-grown", "ring-22-standing"),
        ("figure-eight-wide", "figure-eight-14"),
        ("one-lane-10", "on-ramp-5"),
    ):
        assert joint_controller(FAMILY[name], run, studies) == studies.run_folder(run) / of


def test_a_ring_is_driven_by_all_on_the_same_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[set[str], list[tuple[int, ...]]]] = []

    def driven(scenario: object, drivers: dict[str, str], seeds: list[tuple[int, ...]], run: object) -> Any:
        asked.append((set(drivers.values()), seeds))
        return {label: [] for label in drivers}

    monkeypatch.setattr("unjam_paper.joint_training.driven", driven)
    monkeypatch.setattr("unjam_paper.joint_training.best_of", lambda rows: "pi")
    found = _measure_road(
        "ring-22-grown", FAMILY["ring-22-grown"], RING_BASELINES | {"residual 0": "runs/0"}, FAMILY_TEST_SEEDS
    )
    (chose, tuning), (judged, judging) = asked
    assert {"human", "pi", RINGS_EXPERT} <= judged
    assert "runs/0" in judged - chose
    assert not set(tuning) & set(judging)
    assert (found["best"], found["part"]) == ("pi", "seen")
