"""Write the tables and pictures of the pages from the files under results/, with the code in the pages' comments.

    python docs/pages.py

The cells of a page contain its code and share their variables. A cell shows the values that it passes to `display`, and
its last expression:

    <!-- cell
    show(page_table("fuel", "ring"))
    -->

    tables in Markdown, links to pictures

    <!-- end -->
"""

import ast
import re
from pathlib import Path
from typing import Any

from tables import Picture

from unjam.files import atomic_write
from unjam.reports.figures import png_bytes

DOCS = Path(__file__).parent
PICTURES = DOCS / "pictures" / "pages"
BEGIN = "<!-- cell\n"
CELL = re.compile(rf"^{BEGIN}((?:(?!-->).)*)^-->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)


def run_cell(code: str, name: str, variables: dict[str, Any]) -> list[str | Picture]:
    """Run a cell and return the values that it shows; error messages contain `name`."""
    shown: list[str | Picture] = []
    variables["display"] = lambda *values: shown.extend(value for value in values if value is not None)
    module = ast.parse(code, name)
    if isinstance(last := module.body[-1], ast.Expr):
        last.value = ast.Call(ast.Name("display", ast.Load()), [last.value], [])
    exec(compile(ast.fix_missing_locations(module), name, "exec"), variables)  # noqa: S102
    return shown


def render_page(page: Path) -> tuple[str, list[Picture]]:
    """Return the text of a page with the current outputs of its cells, and its pictures.

    Raise `ValueError` if a cell has no end, or if its code contains the end of a comment.
    """
    text, variables, pictures = page.read_text(), dict[str, Any](), list[Picture]()
    if text.count(BEGIN) != len(CELL.findall(text)):
        raise ValueError(f"{page.name}: a cell without lines '-->' and '<!-- end -->', or with '-->' in its code")

    def update(cell: re.Match[str]) -> str:
        line = text.count("\n", 0, cell.start(1))
        shown = run_cell("\n" * line + cell[1], str(page), variables)
        pictures.extend(value for value in shown if isinstance(value, Picture))
        outputs = [
            f"![{value.alt}](pictures/pages/{value.name}.png)" if isinstance(value, Picture) else value
            for value in shown
        ]
        return "\n\n".join([f"{BEGIN}{cell[1]}-->", *outputs, "<!-- end -->"])

    return CELL.sub(update, text), pictures


def write_pages() -> None:
    """Write all pages and their pictures, and remove pictures that no page shows."""
    updated = {page: render_page(page) for page in sorted(DOCS.glob("*.md"))}
    pictures = {
        PICTURES / f"{picture.name}.png": png_bytes(picture.figure)
        for _, page_pictures in updated.values()
        for picture in page_pictures
    }
    for path in set(PICTURES.glob("*")) - set(pictures):
        path.unlink()
    PICTURES.mkdir(exist_ok=True)
    for path, content in [*((page, text) for page, (text, _) in updated.items()), *pictures.items()]:
        atomic_write(path, content)


if __name__ == "__main__":
    write_pages()
