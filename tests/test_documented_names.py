"""Files and Python names that the documentation mentions exist."""

import re
from pathlib import Path
from pkgutil import resolve_name

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "SECURITY.md", *sorted((ROOT / "docs").glob("*.md"))]
CODE = [*PAGES, *sorted((ROOT / "docs").glob("*.ipynb")), *sorted((ROOT / "examples").glob("*.py"))]
FOLDERS = ("src", "tests", "docs", "results", "examples")
FILE = re.compile(rf"`((?:{'|'.join(FOLDERS)})/[\w./-]*\w)/?`")
NAME = re.compile(r"`(?!unjam\.cdx\.json)(unjam(?:_paper)?(?:\.\w+)+)(?:\(\))?`")

MODULE = re.compile(r"`(?:[\w-]+/)*(\w+\.py)`")
"""a Python file, of which a table of the architecture may name the last part alone"""
USERS_FILES = {"my_driver.py"}
IMPORT = re.compile(r"from (unjam(?:_paper)?[\w.]*) import ([\w, ]+)")


def is_importable(name: str) -> bool:
    """Return whether a dotted name is a module, or an attribute of one."""
    try:
        resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_names_of_a_page_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    missing = [path for path in FILE.findall(text) if not (ROOT / path).exists()]
    missing += [name for name in NAME.findall(text) if not is_importable(name)]
    assert missing == []


def test_python_files_that_the_architecture_names_exist() -> None:
    named = set(MODULE.findall((ROOT / "docs/architecture.md").read_text(encoding="utf-8")))
    existing = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    assert len(named) > 20
    assert named - existing - USERS_FILES == set()


@pytest.mark.parametrize("file", CODE, ids=lambda file: file.name)
def test_imports_of_documented_code_exist(file: Path) -> None:
    imports = IMPORT.findall(file.read_text(encoding="utf-8"))
    names = [f"{module}.{name.split(' as ')[0].strip()}" for module, listed in imports for name in listed.split(",")]
    assert [name for name in names if not is_importable(name)] == []
