"""Code cells of the documentation are run and cached."""

import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
from nbformat.v4 import new_code_cell, new_notebook

from tests.system.conftest import ROOT


@pytest.fixture
def cells(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return import_module("cells")


def test_outputs_of_cells_are_cached_until_results_or_code_change(
    cells: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "ROOT", tmp_path)
    sources = [tmp_path / "results/ring.json", tmp_path / "src/unjam/table.py", tmp_path / "docs/tables.py"]
    for path in sources:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("1")
    build, folders = tmp_path / "build", []
    for path in (None, *sources):
        if path:
            path.write_text("2")
        folders.append(cells.cache_folder(build))
        folders[-1].mkdir(parents=True)
    assert len(set(folders)) == 4
    assert cells.cache_folder(build) == folders[-1]
    assert list(build.iterdir()) == [folders[-1]]


def test_pages_share_a_kernel_but_no_variables(cells: ModuleType, tmp_path: Path) -> None:
    code = "import os, sys; print(os.getpid(), os.getcwd(), 'mine' in globals(), 'unjam' in sys.modules)"
    outputs = []
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        page = new_notebook(cells=[new_code_cell(code), new_code_cell("mine = 1")])
        result = cells._run(page, str(folder), timeout=60, allow_errors=False)
        assert result.err is None
        assert len(page.cells) == 2
        outputs.append(page.cells[0].outputs[0].text.split())
    (process, *first), (other_process, *second) = outputs
    assert process == other_process
    assert first == [str(tmp_path / "one"), "False", "True"]
    assert second == [str(tmp_path / "other"), "False", "True"]


def test_every_figure_of_a_cell_has_an_alternative_text() -> None:
    """Without it, screen readers read the name of the file."""
    figures = [
        (page.name, cell)
        for page in (ROOT / "docs").glob("*.md")
        for cell in re.findall(r"^```{code-cell} ipython3\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
        if re.search(r"^(Image|draw)\(", cell, re.MULTILINE)
    ]
    assert len(figures) > 20
    assert [page for page, cell in figures if not re.search(r"^    alt: .{20}", cell, re.MULTILINE)] == []
