"""Files of others on the command line: what is in them harms nobody who looks at them."""

from pathlib import Path
from typing import Any

import pytest

from tests.controller.test_verify import content_of
from tests.system.conftest import Run
from tests.system.test_wrong_inputs import one_line
from unjam.controller.file import GRAPH
from unjam.drivers import Constant


def test_a_graph_that_wants_all_memory_is_refused_in_one_line(unjam: Run, tmp_path: Path) -> None:
    helper, graph = (
        pytest.importorskip("onnx").helper,
        pytest.importorskip("tests.controller.test_graph").graph,
    )
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

    (tmp_path / "bomb.unjam").write_bytes(content_of(Constant(), 1.0, {GRAPH: graph(bomb)}))
    ran = unjam("verify", "bomb.unjam")
    assert (ran.returncode, ran.stdout) == (2, "")
    assert one_line(ran.stderr), ran.stderr
    assert "graph: cannot be run" in ran.stderr
