import json
from pathlib import Path

import pytest

from unjam.errors import EpisodeError
from unjam.scenarios import Ring
from unjam.training.evaluate import Evaluation
from unjam.worlds.worker_pool import WorkerPool
from unjam_paper import study
from unjam_paper.results_file import CONTROLLERS_FILE, StudyPart, measure_parts, read_part
from unjam_paper.study import evaluate_on_test_seeds, study_manifest

MEASURED: list[object] = []
"""arguments of the functions below, in calls of this process"""


@pytest.fixture(autouse=True)
def nothing_measured() -> None:
    MEASURED.clear()


def square(number: int) -> dict[str, int]:
    MEASURED.append(number)
    return {"square": number * number}


def refuse(number: int) -> None:
    raise AssertionError(f"{number} is finished already")


def named(drivers: dict[str, str]) -> dict[str, str]:
    MEASURED.extend(drivers.values())
    return drivers


def parts(count: int) -> dict[str, StudyPart]:
    return {f"of-{number}": (square, (number,)) for number in range(count)}


def test_each_part_is_a_file(tmp_path: Path) -> None:
    measure_parts(tmp_path / "parts", parts(3), 1)
    assert MEASURED == [0, 1, 2]
    assert read_part(tmp_path / "parts", "of-2") == {"square": 4}


def test_finished_parts_are_not_measured_again(tmp_path: Path) -> None:
    measure_parts(tmp_path, parts(2), 1)
    again: dict[str, StudyPart] = {name: (refuse, (number,)) for number, name in enumerate(parts(2))}
    measure_parts(tmp_path, {**again, **parts(3)} | again, 1)
    assert read_part(tmp_path, "of-2") == {"square": 4}


def test_a_part_is_measured_again_if_a_packaged_controller_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, StudyPart] = {
        "packaged": (named, ({"ours": "unjam:ring-tuned"},)),
        "other": (named, ({"ours": "pi"},)),
    }
    for _ in range(2):
        measure_parts(tmp_path, given, 1)
    assert MEASURED == ["unjam:ring-tuned", "pi"]
    monkeypatch.setattr("unjam_paper.results_file.controller_digest", lambda driver: "another")
    measure_parts(tmp_path, given, 1)
    assert MEASURED == ["unjam:ring-tuned", "pi", "unjam:ring-tuned"]
    (tmp_path / f"{CONTROLLERS_FILE}.json").unlink()  # as in older folders
    measure_parts(tmp_path, given, 1)
    assert len(MEASURED) == 3


def test_a_failing_part_keeps_the_others(tmp_path: Path) -> None:
    broken: dict[str, StudyPart] = {**parts(1), "broken": (refuse, (1,))}
    with pytest.raises(AssertionError):
        measure_parts(tmp_path, broken, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["of-0.json"]


@pytest.mark.slow
def test_processes_measure_the_same(tmp_path: Path) -> None:
    measure_parts(tmp_path, parts(3), 2)
    assert [read_part(tmp_path, f"of-{number}")["square"] for number in range(3)] == [0, 1, 4]


def test_a_study_keeps_its_first_manifest_and_lists_resumptions(tmp_path: Path) -> None:
    first = study_manifest(tmp_path)
    assert "resumptions" not in first
    (tmp_path / "manifest.json").write_text(json.dumps({**first, "started": "long ago"}))
    study_manifest(tmp_path)
    found = study_manifest(tmp_path)
    assert found["started"] == "long ago"
    assert [one["commit"] for one in found["resumptions"]] == [first["commit"]] * 2


def test_a_failed_episode_raises_instead_of_being_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = {"status": "failed", "error": "EpisodeError", "reason": "SUMO cannot start", "seed": [1, 0]}
    monkeypatch.setattr(study, "evaluate", lambda *given: Evaluation({"pi": [failed]}, {}))
    with WorkerPool(1) as workers, pytest.raises(EpisodeError, match=r"SUMO cannot start \(seed \[1, 0\]\)"):
        evaluate_on_test_seeds(Ring(), {}, 1, (), workers)
