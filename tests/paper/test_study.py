import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.test_processes import linux, soon
from unjam.errors import EpisodeError, InputError
from unjam.scenarios import Ring
from unjam.training.evaluate import Evaluation
from unjam.training.run_folder import create_run_folder, save_checkpoint
from unjam_paper import results_file, study
from unjam_paper.results_file import StudyPart, measure_parts
from unjam_paper.study import PlannedRun, StudyFolder, evaluate_in_batches, evaluate_metrics, write_manifest

MEASURED: list[object] = []
"""arguments of the functions below, in calls of this process"""


@pytest.fixture(autouse=True)
def nothing_measured() -> None:
    MEASURED.clear()


def square(number: int, workers: int) -> dict[str, int]:
    MEASURED.append(number)
    return {"square": number * number}


def refuse(number: int, workers: int) -> None:
    raise AssertionError(f"{number} is finished already")


def named(drivers: dict[str, str], workers: int) -> dict[str, str]:
    MEASURED.extend(drivers.values())
    return drivers


def numbers_below(limit: int, workers: int) -> list[int]:
    return list(range(limit))


def wait_long(file: str, workers: int) -> None:
    Path(file).write_text(f"{os.getpid()}\n")
    time.sleep(300.0)


def parts(count: int) -> dict[str, StudyPart]:
    return {f"of-{number}": (square, (number,)) for number in range(count)}


def test_each_part_is_a_file(tmp_path: Path) -> None:
    assert measure_parts(tmp_path / "parts", parts(3), 1)["of-2"] == {"square": 4}
    assert MEASURED == [0, 1, 2]
    assert json.loads((tmp_path / "parts/of-2.json").read_text())["result"] == {"square": 4}


def test_entries_of_a_part_are_joined(tmp_path: Path) -> None:
    entries: dict[str, StudyPart] = {
        **{f"squares/of {number}": (square, (number,)) for number in (1, 2)},
        **{f"rows/{number}": (numbers_below, (number,)) for number in (2, 3)},
    }
    assert measure_parts(tmp_path, entries, 1) == {
        "squares": {"of 1": {"square": 1}, "of 2": {"square": 4}},
        "rows": [0, 1, 0, 1, 2],
    }


PROGRAM = """
import signal, sys
from pathlib import Path
from tests.paper.test_study import measure_parts, wait_long
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
measure_parts(Path(sys.argv[1]), {name: (wait_long, (f"{sys.argv[1]}/{name}",)) for name in ("one", "two")}, 2)
"""


@linux
@pytest.mark.long
@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
def test_processes_that_measure_parts_end_with_the_program(signum: signal.Signals, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    program = subprocess.Popen([sys.executable, "-c", PROGRAM, str(tmp_path)], env=environment)
    files, patience = (tmp_path / "one", tmp_path / "two"), time.monotonic() + 60.0
    while not all(file.exists() and file.read_text().endswith("\n") for file in files):
        assert time.monotonic() < patience
        time.sleep(0.05)
    program.send_signal(signum)
    assert program.wait(timeout=15.0) == (143 if signum == signal.SIGTERM else -signum)
    assert all(soon(int(file.read_text())) for file in files)


def test_a_part_is_measured_again_only_if_its_arguments_changed(tmp_path: Path) -> None:
    for _ in range(2):
        measure_parts(tmp_path, parts(2), 1)
    assert MEASURED == [0, 1]
    changed: dict[str, StudyPart] = {**parts(2), "of-1": (square, (3,))}
    assert measure_parts(tmp_path, changed, 1) == {"of-0": {"square": 0}, "of-1": {"square": 9}}
    assert MEASURED == [0, 1, 3]
    (tmp_path / "of-0.json").write_text('{"stamp": "')  # damaged
    assert measure_parts(tmp_path, changed, 1)["of-0"] == {"square": 0}
    assert MEASURED == [0, 1, 3, 0]


def test_a_part_is_measured_again_if_a_controller_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries: dict[str, StudyPart] = {
        "packaged": (named, ({"ours": "unjam:ring-tuned"},)),
        "other": (named, ({"ours": "pi"},)),
    }
    for _ in range(2):
        measure_parts(tmp_path, entries, 1)
    assert MEASURED == ["unjam:ring-tuned", "pi"]
    monkeypatch.setattr(
        results_file, "controller_hash", lambda driver: "another" if driver.startswith("unjam:") else None
    )
    measure_parts(tmp_path, entries, 1)
    assert MEASURED == ["unjam:ring-tuned", "pi", "unjam:ring-tuned"]


def test_a_failing_part_keeps_the_others(tmp_path: Path) -> None:
    broken: dict[str, StudyPart] = {**parts(1), "broken": (refuse, (1,))}
    with pytest.raises(AssertionError):
        measure_parts(tmp_path, broken, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["of-0.json"]


@pytest.mark.slow
def test_processes_measure_the_same(tmp_path: Path) -> None:
    assert [each["square"] for each in measure_parts(tmp_path, parts(3), 2).values()] == [0, 1, 4]


def test_a_study_keeps_its_first_manifest_and_lists_resumptions(tmp_path: Path) -> None:
    write_manifest(tmp_path, seeds=2)
    first = json.loads((tmp_path / "manifest.json").read_text())
    assert "resumptions" not in first
    (tmp_path / "manifest.json").write_text(json.dumps({**first, "started": "long ago"}))
    for _ in range(2):
        write_manifest(tmp_path, seeds=3)
    last = json.loads((tmp_path / "manifest.json").read_text())
    assert (last["started"], last["seeds"]) == ("long ago", 3)
    assert [resumption["commit"] for resumption in last["resumptions"]] == [first["commit"]] * 2


def test_a_published_manifest_names_no_folder_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["unjam", "reproduce", "rings", "--out", str(tmp_path / "mine")])
    write_manifest(tmp_path, seeds=2)
    command = json.loads((tmp_path / "manifest.json").read_text())["command"]
    assert command == ["unjam", "reproduce", "rings", "--out", "mine"]


def test_a_failed_episode_raises_instead_of_being_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    failed = {"status": "failed", "error": "EpisodeError", "reason": "SUMO cannot start", "seed": [1, 0]}
    monkeypatch.setattr(study, "evaluate", lambda *arguments: Evaluation({"pi": [failed]}, {}))
    with pytest.raises(EpisodeError, match=r"SUMO cannot start \(seed \[1, 0\]\)"):
        evaluate_metrics(Ring(), {}, 1, (), 1)


def test_batches_have_the_metrics_of_sumo_except_fuel() -> None:
    road = Ring(vehicles=8, length=(85, 85), warmup=100, horizon=200)
    metrics = ("seed", "return", "mean_speed", "outflow_veh_per_h", "min_time_gap", "cav_max_braking", "steps")
    arguments = road, {"human": "human", "pi": "pi", "gap PI": "unjam:ring-gap-tuned"}, 2, metrics, 1
    in_batches, in_sumo = evaluate_in_batches(*arguments), evaluate_metrics(*arguments)
    assert in_batches.keys() == in_sumo.keys()
    for label, measured in in_sumo.items():
        assert in_batches[label]["feasibility"] == measured["feasibility"]
        for row, expected in zip(in_batches[label]["episodes"], measured["episodes"], strict=True):
            assert row.pop("seed") == expected.pop("seed")
            assert row == pytest.approx(expected, rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("iterations", [[], [1, 2], [1, 3], [2, 3]])
def test_a_finished_training_with_cut_progress_is_refused(iterations: list[int], tmp_path: Path) -> None:
    studies, run = StudyFolder(tmp_path), PlannedRun("ring", "trpo", 0)
    folder = studies.run_folder(run)
    create_run_folder(folder, run.config)
    rows_of_driver = [{"driver": "trained"}] * run.config.evaluation.episodes
    (folder / "evaluation.json").write_text(json.dumps({"rows": rows_of_driver}))
    save_checkpoint(folder / "checkpoint", {"iteration": 3}, {})
    rows = {number: {"iteration": number, "return_mean": float(number)} for number in (1, 2, 3)}
    (folder / "progress.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows.values()))
    assert studies.is_finished(run)
    assert studies.trained_runs("ring", ["trpo"], 1)["trpo"][0].final_training_mean("return_mean") == 3.0
    (folder / "progress.jsonl").write_text("".join(f"{json.dumps(rows[number])}\n" for number in iterations))
    for read in (lambda: studies.is_finished(run), lambda: studies.trained_runs("ring", ["trpo"], 1)):
        with pytest.raises(InputError, match=r"progress\.jsonl: rows? .* missing; allowed: all rows up to 3"):
            read()
