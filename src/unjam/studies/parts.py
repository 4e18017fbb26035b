"""A study in parts: each is a pure function, its answer a file, and what is there is not measured again."""

import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from unjam.files import make_folder, to_json, write_whole
from unjam.manifest import manifest

MANIFEST = "manifest.json"

Part = tuple[Callable[..., Any], tuple[Any, ...]]
"""a function of a module, and its arguments; it answers what JSON can hold"""
Told = Callable[[str], None]
"""told each part's name when it is there"""


def about_study(folder: Path) -> dict[str, Any]:
    """Return where a study comes from: the manifest of its first call, and when it went on, by what."""
    make_folder(folder)
    about, now = {}, manifest()
    if (folder / MANIFEST).is_file():
        about = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        went_on = {"commit": now["commit"], "started": now["started"]}
        about["went_on"] = [*about.get("went_on", []), went_on]
    write_whole(folder / MANIFEST, to_json(about or now, indent=1))
    return about or now


def measure_parts(folder: Path, parts: dict[str, Part], workers: int, told: Told | None = None) -> None:
    """Write `folder/NAME.json` for each part that is not there yet, with so many processes."""
    make_folder(folder)
    missing = {name: part for name, part in parts.items() if not _file(folder, name).is_file()}
    if workers == 1 or len(missing) < 2:
        for name, (function, arguments) in missing.items():
            _keep(folder, name, function(*arguments), told)
        return
    # Fresh processes: a forked one would inherit threads of torch that are not there.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        running = {pool.submit(function, *arguments): name for name, (function, arguments) in missing.items()}
        for done in as_completed(running):
            _keep(folder, running[done], done.result(), told)


def read_part(folder: Path, name: str) -> Any:
    """Return what a part has answered."""
    return json.loads(_file(folder, name).read_text(encoding="utf-8"))


def _keep(folder: Path, name: str, answer: Any, told: Told | None) -> None:
    write_whole(_file(folder, name), to_json(answer))
    if told is not None:
        told(name)


def _file(folder: Path, name: str) -> Path:
    return folder / f"{name}.json"
