"""A watch of all files of the user that episodes depend on."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from unjam.drivers.user_driver import FileReference, is_file_reference
from unjam.files import FileWatch
from unjam.parameters import split_parameters
from unjam.scenarios.scenario import Scenario


def watch_files(scenarios: Iterable[Scenario], *names: Any) -> FileWatch:
    """Return a watch of the files of scenarios and of their rewards, and of the Python and TOML files among `names`."""
    scenarios = tuple(scenarios)
    references = {name for name in (*names, *(scenario.reward for scenario in scenarios)) if isinstance(name, str)}
    return FileWatch(partial(_list_files, scenarios, references))  # picklable, as environments are


def _list_files(scenarios: Sequence[Scenario], references: set[str]) -> set[Path]:
    toml_files = {reference for reference in references if reference.endswith(".toml")}
    labels = {split_parameters(reference)[0] for reference in references - toml_files}
    files = {FileReference.parse(label).path for label in labels if is_file_reference(label)}
    files |= set(map(Path, toml_files))
    return files.union(*(scenario.user_files for scenario in scenarios))
