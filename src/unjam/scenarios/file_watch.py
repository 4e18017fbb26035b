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
    """Return a watch of the files of scenarios, of their rewards, and of the code and TOML files that `names` name."""
    scenarios = tuple(scenarios)
    texts = {name for name in (*names, *(scenario.reward for scenario in scenarios)) if isinstance(name, str)}
    return FileWatch(partial(_list_files, scenarios, texts))  # environments are pickled with it


def _list_files(scenarios: Sequence[Scenario], texts: set[str]) -> set[Path]:
    codes = {split_parameters(text)[0] for text in texts if not text.endswith(".toml")}
    files = {FileReference.parse(code).path for code in codes if is_file_reference(code)}
    files |= {Path(text) for text in texts if text.endswith(".toml")}
    return files.union(*(scenario.user_files for scenario in scenarios))
