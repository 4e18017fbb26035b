"""Running a benchmark: seeds, backends, resumption and refusals."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import PPO
from typer.testing import CliRunner

import unjam
from tests.adapters.test_stable_baselines3 import Space
from tests.adapters.test_stable_baselines3_file import save
from unjam.benchmarks.leaderboard import read_leaderboard
from unjam.benchmarks.result import RoadRecord, read_result
from unjam.benchmarks.suites import SUITES, Suite
from unjam.cli import app
from unjam.errors import InputError
from unjam.files import sha256_of_file
from unjam.scenarios import make_scenario

ROADS = "ring-22-no-warm-up", "figure-eight-14"
IDLE = """
def idle(state):
    assert len(state.speed) == 1, "rows of one road"
    return 0.0 * state.speed
"""


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> str:
    """A suite of two roads whose episodes have three seconds."""
    for name, roads in (("short", ROADS), ("ring", ROADS[:1]), ("mixed", (ROADS[0], "one-lane-10"))):
        monkeypatch.setitem(SUITES, name, Suite(name, "", roads))
    short = lambda name: replace(make_scenario(name), horizon=30)  # noqa: E731
    monkeypatch.setattr("unjam.benchmarks.run.make_scenario", short)
    return "short"


def test_rings_run_in_batches_and_figure_eights_in_sumo(suite: str, tmp_path: Path) -> None:
    result = unjam.benchmark("unjam:ring-tuned", suite, tmp_path / "a.json", workers=1)
    assert [road.backend for road in result.roads.values()] == ["batch", "sumo"]
    assert result.training_steps == 1_992_000
    assert result.sha256 is not None
    assert list(result.table().index) == [*ROADS, "mean, all roads", "mean, training", "mean, unseen"]
    assert read_result(tmp_path / "a.json") == result


def test_a_second_call_drives_only_the_missing_roads(
    suite: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, lines = tmp_path / "a.json", list[str]()

    def stop(line: str) -> None:
        lines.append(line)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        unjam.benchmark("pi", suite, file, workers=1, progress=stop)
    assert read_result(file).missing_roads == [ROADS[1]]
    assert "summary" not in (document := json.loads(file.read_text()))
    assert document["training_steps_unit"] == "environment steps: control steps in the simulator"
    first = read_result(file).roads[ROADS[0]]
    result = unjam.benchmark("pi", suite, file, workers=1, progress=lines.append)
    again = "1 of 2 roads in a.json; not driven again"
    assert [line.partition(": gain")[0] for line in lines] == [f"1 of 2: {ROADS[0]}", again, f"2 of 2: {ROADS[1]}"]
    assert result.roads[ROADS[0]] == first
    assert not result.missing_roads
    monkeypatch.setattr("unjam.benchmarks.run._drive_road", None)  # nothing is driven
    assert unjam.benchmark("pi", suite, file) == result
    unjam.benchmark("pi", suite, file, progress=lines.append, roads=ROADS[:1])
    assert lines[-1] == "1 of 1 road in a.json; not driven again"


def test_a_trial_on_some_roads_cannot_be_compared_and_can_be_continued(suite: str, tmp_path: Path) -> None:
    file, runner = tmp_path / "a.json", CliRunner()
    command = ["benchmark", "pi", "--suite", suite, "--roads", f"family/{ROADS[0]}", "--workers", "1"]
    ran = runner.invoke(app, [*command, "--out", str(file)])
    assert ran.exit_code == 0, ran.output
    assert ROADS[0] in ran.stdout
    assert "mean, all roads" not in ran.stdout
    assert "trial: 1 of 2 roads of short; the same command without --roads drives all" in ran.stderr
    with pytest.raises(InputError, match=r"a\.json: roads: 1 are missing \(figure-eight-14, \.\.\.\)"):
        read_leaderboard([file])
    printed = json.loads(runner.invoke(app, [*command, "--json"]).stdout)
    assert [row["road"] for row in printed["gains"]] == list(printed["roads"]) == [ROADS[0]]
    assert printed["missing_roads"] == [ROADS[1]]
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    content = json.loads(file.read_text())
    content["manifest"]["command"] = command
    file.write_text(json.dumps(content))
    result = unjam.benchmark("pi", suite, file, workers=1)
    assert list(result.roads) == list(ROADS)
    assert "--roads" not in result.manifest["command"]
    assert result.roads[ROADS[0]] == RoadRecord(**printed["roads"][ROADS[0]])


@pytest.mark.long
def test_code_of_users_drives_one_road_at_a_time(suite: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(IDLE)
    named = unjam.benchmark("mine.py:idle", "ring", workers=1)
    namespace: dict[str, Any] = {}
    exec(IDLE, namespace)
    given = unjam.benchmark(namespace["idle"], "ring", workers=1)
    assert [each.roads[ROADS[0]].backend for each in (named, given)] == ["sumo", "sumo"]
    assert named.roads[ROADS[0]].driver == given.roads[ROADS[0]].driver
    assert (named.driver, given.sha256) == ("mine.py:idle", None)
    (tmp_path / "other").mkdir()
    Path("other/mine.py").write_text(IDLE)
    assert unjam.benchmark("other/mine.py:idle", "ring", workers=1).sha256 == named.sha256
    Path("given.json").write_text("")
    with pytest.raises(InputError, match=r"given\.json"):
        unjam.benchmark(namespace["idle"], "ring", "given.json")


@pytest.mark.long
def test_a_result_of_a_model_file_continues_only_with_the_same_file(suite: str, tmp_path: Path) -> None:
    file, lines = save(PPO("MlpPolicy", Space(), seed=0, device="cpu"), tmp_path), list[str]()
    first = unjam.benchmark(str(file), "ring", tmp_path / "a.json", workers=1, progress=lines.append)
    assert "does not contain its control step: here it acts every 0.1 s" in lines[0]
    assert first.sha256 == sha256_of_file(file)
    assert unjam.benchmark(str(file), "ring", tmp_path / "a.json", workers=1) == first
    slow = unjam.benchmark(f"{file}:policy_time_step=1.0", "ring", tmp_path / "b.json", workers=1)
    assert slow.sha256 not in (None, first.sha256)
    assert unjam.benchmark(f"{file}:policy_time_step=1.0", "ring", tmp_path / "b.json", workers=1) == slow
    save(PPO("MlpPolicy", Space(), seed=1, device="cpu"), tmp_path)
    with pytest.raises(InputError, match="hash of the driver"):
        unjam.benchmark(str(file), "ring", tmp_path / "a.json", workers=1)


BACKEND = """
from unjam.worlds.batch.backend import BatchBackend
class Mine(BatchBackend): pass
"""


def test_a_result_of_a_backend_file_continues_only_with_the_same_code(suite: str, tmp_path: Path) -> None:
    file, out = tmp_path / "mine.py", tmp_path / "a.json"
    file.write_text(BACKEND)
    first = unjam.benchmark("pi", "ring", out, workers=1, backend=f"{file}:Mine")
    assert first.manifest["backend_sha256"] == sha256_of_file(file)
    assert unjam.benchmark("pi", "ring", out, workers=1, backend=f"{file}:Mine") == first
    before = out.read_bytes()
    file.write_text(f"{BACKEND}# edited")
    with pytest.raises(
        InputError, match=r"a\.json has hash of the backend '.*', not '.*'; allowed: the same, or a new"
    ):
        unjam.benchmark("pi", "ring", out, workers=1, backend=f"{file}:Mine")
    assert out.read_bytes() == before


@pytest.mark.long
def test_a_driver_that_cannot_drive_on_a_road_counts_as_the_human_baseline_there(suite: str) -> None:
    result = unjam.benchmark("unjam:ring-best", "mixed", workers=1)
    ring, motorway = result.road_rows()[:2]
    assert motorway["gain"] == motorway["low"] == motorway["high"] == 0.0
    assert motorway["feasible"].startswith("not driven: ")
    assert not ring["feasible"].startswith("not driven: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"driver": "pie"}, "driver: 'pie' is not allowed.*did you mean 'pi'"),
        ({"suite": "short-v2"}, "suite: 'short-v2' is not allowed; allowed: all-roads-v1"),
        ({"roads": "ring"}, "roads: 'ring' is not allowed; allowed: a list of names of roads of ring"),
        ({"roads": ["ring-22-grwn"]}, "roads of ring: 'ring-22-grwn' is not allowed; allowed: ring-22-no-warm-up"),
        ({"roads": ["rnig-22-no-warm-up"]}, "did you mean 'ring-22-no-warm-up'"),
        *(({"out": out}, f"out: {out!r} is not allowed; allowed: the path of a file") for out in (5, "", b"x")),
        ({"progress": 5}, "progress: 5 is not allowed; allowed: a function of a line"),
        ({"suite": {}}, "suite: {} is not allowed; allowed: all-roads-v1"),
        ({"workers": 0}, "workers: 0 is not allowed; allowed: an integer >= 1"),
        ({"workers": "x"}, "workers: 'x' is not allowed; allowed: an integer >= 1"),
        ({"training_steps": 1.5}, "training_steps: 1.5 is not allowed; allowed: an integer from 0 to 9,007"),
        ({"backend": "sumi"}, "backend: 'sumi' is not allowed"),
        ({"driver": "unjam:on-ramp-best"}, "it is not allowed on ring"),
        ({"driver": lambda state: math.nan * state.speed}, "finite"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(suite: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(unjam.errors.UnjamError, match=message) as error:
        unjam.benchmark(**{"driver": "pi", "suite": "ring", "workers": 1, **arguments})
    assert "\n" not in str(error.value)


def test_one_process_at_a_time_writes_a_result(suite: str, tmp_path: Path) -> None:
    def run_second(line: str) -> None:
        unjam.benchmark("pi", "ring", tmp_path / "b.json", workers=1)  # another file
        with pytest.raises(InputError, match=r"^out: '.*a\.json' is being written by another process; allowed: one at"):
            unjam.benchmark("pi", "ring", tmp_path / "a.json", workers=1)

    unjam.benchmark("pi", "ring", tmp_path / "a.json", workers=1, progress=run_second)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "b.json"]


def test_a_file_of_another_driver_or_suite_is_not_overwritten(suite: str, tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    unjam.benchmark("pi", "ring", file, workers=1)
    before = file.read_bytes()
    for driver, name, message in (
        ("pi", suite, "has suite 'ring'"),
        ("idm", "ring", "has driver 'pi'"),
        ("pi:window=10", "ring", "has driver 'pi'"),
    ):
        with pytest.raises(InputError, match=message):
            unjam.benchmark(driver, name, file, workers=1)
    assert file.read_bytes() == before
