import json
from pathlib import Path

import pytest

from unjam.errors import EpisodeError
from unjam.scenarios import Ring
from unjam.training.evaluate import Evaluation
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper import study
from unjam_paper.parts import CONTROLLERS_FILE, StudyPart, measure_parts
from unjam_paper.results_file import read_part
from unjam_paper.study import evaluate_on_test_seeds, study_manifest


def square(number: int) -> dict[str, int]:
    return {"square": number * number}


def refuse(number: int) -> None:
    raise AssertionError(f"{number} is there already")


def named(drivers: dict[str, str]) -> dict[str, str]:
    return drivers


def parts(count: int) -> dict[str, StudyPart]:
    return {f"of-{number}": (square, (number,)) for number in range(count)}


def test_each_part_is_a_file(tmp_path: Path) -> None:
    told: list[str] = []
    measure_parts(tmp_path / "parts", parts(3), 1, told.append)
    assert told == ["of-0", "of-1", "of-2"]
    assert read_part(tmp_path / "parts", "of-2") == {"square": 4}


def test_what_is_there_is_not_measured_again(tmp_path: Path) -> None:
    measure_parts(tmp_path, parts(2), 1)
    again: dict[str, StudyPart] = {name: (refuse, (number,)) for number, name in enumerate(parts(2))}
    measure_parts(tmp_path, {**again, **parts(3)} | again, 1)
    assert read_part(tmp_path, "of-2") == {"square": 4}


def test_a_part_is_measured_again_where_a_shipped_controller_in_it_is_another_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    given: dict[str, StudyPart] = {
        "shipped": (named, ({"ours": "unjam:ring-tuned"},)),
        "other": (named, ({"ours": "pi"},)),
    }
    for _ in range(2):
        measure_parts(tmp_path, given, 1, told.append)
    assert told == ["shipped", "other"]
    monkeypatch.setattr("unjam_paper.parts.file_of", lambda driver: "another")
    measure_parts(tmp_path, given, 1, told.append)
    assert told == ["shipped", "other", "shipped"]
    (tmp_path / CONTROLLERS_FILE).unlink()  # as folders of before have it
    measure_parts(tmp_path, given, 1, told.append)
    assert len(told) == 3


def test_a_part_that_fails_leaves_the_others(tmp_path: Path) -> None:
    broken: dict[str, StudyPart] = {**parts(1), "broken": (refuse, (1,))}
    with pytest.raises(AssertionError):
        measure_parts(tmp_path, broken, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["of-0.json"]


@pytest.mark.slow
def test_processes_measure_the_same(tmp_path: Path) -> None:
    measure_parts(tmp_path, parts(3), 2)
    assert [read_part(tmp_path, f"of-{number}")["square"] for number in range(3)] == [0, 1, 4]


def test_a_study_keeps_its_first_manifest_and_says_when_it_went_on(tmp_path: Path) -> None:
    first = study_manifest(tmp_path)
    assert "went_on" not in first
    (tmp_path / "manifest.json").write_text(json.dumps({**first, "started": "long ago"}))
    study_manifest(tmp_path)
    found = study_manifest(tmp_path)
    assert found["started"] == "long ago"
    assert [later["commit"] for later in found["went_on"]] == [first["commit"]] * 2


def test_an_episode_that_failed_is_told_and_not_left_out_of_a_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = {"status": "failed", "error": "EpisodeError", "reason": "SUMO cannot start", "seed": [1, 0]}
    monkeypatch.setattr(study, "evaluate", lambda *given: Evaluation({"pi": [failed]}, {}))
    with WorkerPool(1) as workers, pytest.raises(EpisodeError, match=r"SUMO cannot start \(seed \[1, 0\]\)"):
        evaluate_on_test_seeds(Ring(), {}, 1, (), workers)
