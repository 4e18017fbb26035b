"""The worked examples of docs/architecture.md do what the page says."""

import re
from pathlib import Path

import pytest

from unjam.drivers.registry import DRIVER_CLASSES

PAGE = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text()
EXAMPLES = dict(re.findall(r"^### ([^\n]+)\n.*?^```python\n(.*?)^```$", PAGE, flags=re.S | re.M))


def test_the_page_has_eight_worked_examples_of_eleven_changes() -> None:
    assert len(EXAMPLES) == 8
    table = PAGE.partition("## Eleven changes")[2].partition("\nEight of them")[0]
    assert len(re.findall(r"^\| [^|]+ \| \d \|", table, flags=re.M)) == 11


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("title", EXAMPLES)
def test_an_example_of_the_architecture_runs(title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = dict(DRIVER_CLASSES)  # what an example adds is taken away again
    try:
        exec(compile(EXAMPLES[title], title, "exec"), {"__name__": "example"})
    finally:
        DRIVER_CLASSES.clear()
        DRIVER_CLASSES.update(before)


def test_the_page_lists_all_sub_packages() -> None:
    section = PAGE.partition("## Packages")[2].partition("\n## ")[0]
    listed = set(re.findall(r"^\| `(\w+)/`", section, flags=re.M))
    packages = {place.parent.name for place in Path(__file__).parents[1].glob("src/unjam/*/__init__.py")}
    assert listed == packages
