"""Results with values of wrong types give a page or an error of one line."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.reports.test_assessment import HARMS, HELPS, assessment_folder
from tests.reports.test_html import results_in
from unjam.errors import InputError
from unjam.reports.assessment import ASSESSMENT_FILE, write_assessment
from unjam.reports.html import write_report_page

WRONG_VALUES = (1, None)


def parents_and_keys(value: Any, depth: int = 2) -> Iterator[tuple[Any, Any]]:
    """The first entries of JSON tables and lists to a depth."""
    keys = (
        list(value)[:14] if isinstance(value, dict) else list(range(len(value)))[:1] if isinstance(value, list) else []
    )
    for key in keys:
        yield value, key
        if depth:
            yield from parents_and_keys(value[key], depth - 1)


def count_refusals(file: Path, write_page: Callable[[], object]) -> int:
    """Write a page for each wrong value in a file, and return how often this is refused in one line."""
    original, messages = file.read_text(), list[str]()
    document = json.loads(original)
    for parent, key in parents_and_keys(document):
        value = parent[key]
        for wrong_value in WRONG_VALUES if type(value) in (dict, list) else WRONG_VALUES[:1]:
            parent[key] = wrong_value
            file.write_text(json.dumps(document))
            try:
                write_page()
            except InputError as error:
                messages.append(str(error))
            parent[key] = value
    file.write_text(original)
    assert not any("\n" in message for message in messages)
    return len(messages)


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take most of the time of a page."""
    monkeypatch.setattr("unjam.reports.figures.data_uri", lambda figure: "data:,")
    for function in ("space_time.space_time_figure", "figures.time_series_figure", "assessment.effect_figure"):
        monkeypatch.setattr(f"unjam.reports.{function}", lambda *arguments: None)


@pytest.mark.usefixtures("without_figures")
def test_a_wrong_value_in_results_ends_in_one_line(tmp_path: Path) -> None:
    manifest = {"unjam": "0.1", "python": "3.11", "packages": {"numpy": "2"}, "machine": {}, "command": ["unjam"]}
    folder = results_in(tmp_path / "run", "human", "pi", manifest=manifest, controllers={"pi": "0" * 64})
    write_report_page([folder], tmp_path / "page.html")
    assert count_refusals(folder / "evaluation.json", lambda: write_report_page([folder], tmp_path / "page.html")) > 9


@pytest.mark.usefixtures("without_figures")
def test_a_wrong_value_in_an_assessment_ends_in_one_line(tmp_path: Path) -> None:
    folder = assessment_folder(tmp_path / "assessment", [HELPS, HARMS])
    write_assessment(folder, tmp_path / "page.html")
    assert count_refusals(folder / ASSESSMENT_FILE, lambda: write_assessment(folder, tmp_path / "page.html")) > 9
