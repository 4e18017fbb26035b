"""Foreign files and folders do no harm on the command line."""

from pathlib import Path
from typing import Any

import pytest

from tests.controller.test_verify import content_of
from tests.system.conftest import Run
from tests.system.test_invalid_inputs import one_line
from tests.test_processes import holder
from tests.training.test_tasks import mixture
from tests.worlds.sumo.user_networks import straight
from unjam.controller.file import GRAPH_PART
from unjam.drivers import Constant
from unjam.training.run_folder import create_run_folder


def test_a_graph_that_needs_too_much_memory_is_refused_in_one_line(unjam: Run, tmp_path: Path) -> None:
    helper, graph = (pytest.importorskip("onnx").helper, pytest.importorskip("tests.controller.test_graph").graph)
    pytest.importorskip("onnxruntime")

    def bomb(model: Any) -> None:
        huge = helper.make_tensor("huge", 7, [1], [3 * 2**29])
        model.graph.initializer.append(huge)
        nodes = [
            helper.make_node("Expand", ["speed", "huge"], ["much"]),
            helper.make_node("ReduceMean", ["much"], ["mean"]),
            helper.make_node("Mul", ["mean", "leader_speed"], ["acceleration"]),
        ]
        del model.graph.node[:]
        model.graph.node.extend(nodes)

    (tmp_path / "bomb.unjam").write_bytes(content_of(Constant(), 1.0, {GRAPH_PART: graph(bomb)}))
    ran = unjam("verify", "bomb.unjam")
    assert (ran.returncode, ran.stdout) == (2, "")
    assert one_line(ran.stderr), ran.stderr
    assert "graph: cannot be run" in ran.stderr


def test_a_report_from_or_in_a_locked_folder_is_refused(unjam: Run, tmp_path: Path) -> None:
    drive = ["drive", "ring", "--driver", "pi", "--episodes", "1", "--set", "horizon=20", "--out", "run"]
    assert unjam(*drive, pictures=False).returncode == 0
    before = (tmp_path / "run" / "report.html").read_bytes()
    (tmp_path / "locked").mkdir()
    processes = holder(tmp_path / "run"), holder(tmp_path / "locked")
    (tmp_path / "free").mkdir()
    for file in ("evaluation.json", "episodes.parquet", "plot_episodes.safetensors"):
        (tmp_path / "free" / file).write_bytes((tmp_path / "run" / file).read_bytes())
    for arguments in (
        ["report", "run"],
        ["report", "run", "--out", "x.html"],
        ["report", "free", "--out", "locked/x.html"],
    ):
        ran = unjam(*arguments, pictures=False)
        assert (ran.returncode, one_line(ran.stderr)) == (2, True), ran.stderr
        assert "is being written by another process" in ran.stderr
    assert unjam("report", "free", pictures=False).returncode == 0
    for process in processes:
        process.communicate("")
    assert (tmp_path / "run" / "report.html").read_bytes() == before
    assert not (tmp_path / "x.html").exists()
    assert unjam("report", "run", "--out", "x.html", pictures=False).returncode == 0


SHORT_RING = ("ring", "--set", "horizon=20")
WRITERS = [
    ("drive", *SHORT_RING, "--driver", "pi", "--episodes", "1", "--out", "locked"),
    ("tune", *SHORT_RING, "--steps", "10000", "--out", "locked"),
    ("search", "ring", "--set", "scenario_options.horizon=20", "--vary", "trpo.target_kl=0.1,0.2", "--out", "locked"),
    ("train", "ring", "--set", "scenario_options.horizon=20", "--steps", "100", "--out", "locked"),
    ("reproduce", "theory", "--out", "locked"),
    ("assess", "straight.sumocfg", "-d", "acc", "--penetration-rates", "0.5", "--set", "horizon=20", "--out", "locked"),
]


@pytest.mark.parametrize("arguments", WRITERS, ids=lambda arguments: arguments[0])
def test_a_locked_output_folder_is_refused(arguments: tuple[str, ...], unjam: Run, tmp_path: Path) -> None:
    straight(tmp_path, '<vehicle id="a" type="car" route="along" depart="0"/>')
    locked = tmp_path / "locked"
    locked.mkdir()
    process = holder(locked)
    ran = unjam(*arguments)
    assert (ran.returncode, ran.stdout) == (2, ""), ran.stderr
    assert ran.stderr.splitlines()[-1].startswith("unjam: run: 'locked' is being written by another process")
    assert "Traceback" not in ran.stderr
    assert [path.name for path in locked.iterdir()] == [".lock"]
    process.communicate("")


@pytest.mark.parametrize(
    ("arguments", "locked"),
    [(("model", "run"), "run"), (("train", "--resume", "run"), "run"), (("train", "--resume", "run"), "run/ring")],
    ids=["model", "train", "train, one of several roads"],
)
def test_a_locked_run_is_refused(arguments: tuple[str, ...], locked: str, unjam: Run, tmp_path: Path) -> None:
    create_run_folder(tmp_path / "run", mixture())
    (tmp_path / "run" / "ring").mkdir()
    process = holder(tmp_path / locked)
    ran = unjam(*arguments)
    assert ran.returncode == 2, ran.stderr
    message = f"unjam: run: {locked!r} is being written by another process; allowed: one at a time"
    assert ran.stderr.splitlines()[-1] == message
    assert not (tmp_path / "run" / "progress.jsonl").exists()
    process.communicate("")
