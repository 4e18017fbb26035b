"""Are the cells of the documentation run and cached?"""

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
    made_of = [tmp_path / "results/ring.json", tmp_path / "src/unjam/table.py", tmp_path / "docs/tables.py"]
    for path in made_of:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("1")
    build, found = tmp_path / "build", []
    for path in (None, *made_of):
        if path:
            path.write_text("2")
        found.append(cells.kept_in(build))
        found[-1].mkdir(parents=True)
    assert len(set(found)) == 4
    assert cells.kept_in(build) == found[-1]
    assert list(build.iterdir()) == [found[-1]]


def test_pages_share_a_kernel_but_no_variables(cells: ModuleType, tmp_path: Path) -> None:
    process = "import os, sys; print(os.getpid(), os.getcwd(), 'mine' in globals(), 'unjam' in sys.modules)"
    words = []
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        page = new_notebook(cells=[new_code_cell(process), new_code_cell("mine = 1")])
        found = cells._run(page, str(folder), timeout=60, allow_errors=False)
        assert found.err is None
        assert len(page.cells) == 2
        words.append(page.cells[0].outputs[0].text.split())
    (first, *of_one), (second, *of_other) = words
    assert first == second
    assert of_one == [str(tmp_path / "one"), "False", "True"]
    assert of_other == [str(tmp_path / "other"), "False", "True"]


def test_every_figure_of_a_cell_has_an_alternative_text() -> None:
    """Screen readers would read the name of the file instead."""
    drawn = [
        (page.name, cell)
        for page in (ROOT / "docs").glob("*.md")
        for cell in re.findall(r"^```{code-cell} ipython3\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)
        if re.search(r"^(Image|draw)\(", cell, re.MULTILINE)
    ]
    assert len(drawn) > 20
    assert [page for page, cell in drawn if not re.search(r"^    alt: .{20}", cell, re.MULTILINE)] == []
