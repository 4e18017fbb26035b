"""Pages of the documentation are plain Markdown, with the tables and pictures that the results give."""

import ast
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from tests.system.conftest import ROOT

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
PICTURE = re.compile(r'!\[(.*?)\]\((\S+?)\)|<img alt="(.*?)" src="(.*?)"')


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(DOCS))
    return import_module("pages")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_the_tables_of_the_results(pages: ModuleType, page: Path) -> None:
    assert page.read_text() == pages.render_page(page)[0], "run: make pages"


def test_pictures_of_pages_exist_with_an_alternative_text_and_none_is_left_over() -> None:
    """Without the text, screen readers read the name of the file."""
    found = [match for page in PAGES for match in PICTURE.findall(page.read_text())]
    texts = {DOCS / (link or source): text or other for text, link, other, source in found}
    assert len(texts) > 30
    assert [path for path, text in texts.items() if len(text) < 20 or not path.is_file()] == []
    assert set((DOCS / "pictures/pages").iterdir()) <= set(texts)


def test_cells_share_variables_and_show_what_they_display(pages: ModuleType, tmp_path: Path) -> None:
    loop = 'words = ["a", "b"]\nfor word in words:\n    display(word, None)\n'
    last = 'from tables import Picture\n\nPicture("c", None, words[0])\n'
    before = f"Text.\n\n<!-- cell\n{loop}-->\n\nold\n\n<!-- end -->\n\n<!-- cell\n{last}-->\n<!-- end -->\n"
    after = before.replace("old", "a\n\nb").replace("-->\n<!-- end", "-->\n\n![a](pictures/pages/c.png)\n\n<!-- end")
    page = tmp_path / "page.md"
    for text in (before, after):
        page.write_text(text)
        rendered, pictures = pages.render_page(page)
        assert rendered == after
        assert [picture.name for picture in pictures] == ["c"]


@pytest.mark.parametrize("cell", ["1\n-->\n", '"-->"\n-->\n\n<!-- end -->\n', "1 -->\n\n<!-- end -->\n"])
def test_a_cell_that_readers_would_see_is_refused(pages: ModuleType, tmp_path: Path, cell: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"<!-- cell\n{cell}\n<!-- cell\n2\n-->\n\n2\n\n<!-- end -->\n")
    with pytest.raises(ValueError, match=r"^page\.md: a cell without"):
        pages.render_page(page)


def test_tables_are_markdown_with_numbers_to_the_right_and_intervals_on_one_line(pages: ModuleType) -> None:
    rows = {"a:b=1,c=2": (1.0, "+1 [-2, 3] %", 5, ""), "d": (2.0, "–", 12, "`e:f=1,g=2|h`\ni")}
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["x", "y", "n", ""])
    text = import_module("tables").show(table, index=True, digits=1)
    assert text.replace("\N{NO-BREAK SPACE}", "_").splitlines() == [
        "|  | x | y | n |  |",
        "| --- | --: | --: | --: | --- |",
        "| a:b=1, c=2 | 1.0 | +1 [-2,_3] % | 5 |  |",
        r"| d | 2.0 | – | 12 | `e:f=1,g=2\|h` i |",
    ]


def test_settings_in_texts_are_fields_of_the_package() -> None:
    """A renamed setting also changes in the documentation."""
    trees = [ast.parse(path.read_text()) for path in (ROOT / "src").rglob("*.py")]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    fields = {ast.unparse(node.target) for cls in classes for node in cls.body if isinstance(node, ast.AnnAssign)}
    texts = [path.read_text() for path in (*PAGES, *ROOT.glob("*.md"), *(ROOT / "src").rglob("*.py"))]
    keys = {key for text in texts for key in re.findall(r"""--set\s+['"]?([A-Za-z_][\w.]*)=""", text)}
    assert len(keys) > 50
    unknown = {part for key in keys for part in key.split(".") if not part.isdigit()} - fields
    assert unknown <= {"key"}
