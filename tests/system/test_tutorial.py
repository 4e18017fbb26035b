"""The tutorials run, their figures are displayed, and they are stored without outputs."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

DOCS = Path(__file__).parents[2] / "docs"
SHOWN = {
    "tutorial": ("pi: feasible; mean speed better", "return, difference to the expert"),
    "tutorial-network": ("compared with human drivers", "unjam:best at a penetration rate of 10 %"),
    "tutorial-rl": ("PPO: feasible", "mean_speed, PPO - pi", "return compared with the expert"),
}
"""by tutorial: what its outputs contain"""


def outputs_of(notebook: nbformat.NotebookNode) -> list[dict[str, Any]]:
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def test_all_tutorials_are_listed_and_stored_without_outputs() -> None:
    assert {path.stem for path in DOCS.glob("*.ipynb")} == set(SHOWN)
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    for name in SHOWN:
        assert f"\n{name}\n" in index
        assert f"({name}.ipynb)" in index
        notebook = nbformat.read(DOCS / f"{name}.ipynb", as_version=4)
        nbformat.validate(notebook)
        assert outputs_of(notebook) == []
        assert {cell.execution_count for cell in notebook.cells if cell.cell_type == "code"} == {None}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHOWN)
def test_tutorial_runs(tmp_path: Path, name: str) -> None:
    notebook = nbformat.read(DOCS / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = outputs_of(notebook)
    displayed = [output["data"] for output in outputs if "data" in output]
    text = "".join(output.get("text", "") for output in outputs)
    text += "".join(str(data.get(kind, "")) for data in displayed for kind in ("text/html", "text/markdown"))
    assert [shown for shown in SHOWN[name] if shown not in text] == []
    assert all("image/png" in data for data in displayed if "Figure size" in data["text/plain"])
    assert list(tmp_path.iterdir()) == []
