"""Parts of a study: each is measured once, and again where a shipped controller in it is another file."""

import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from hashlib import sha256
from pathlib import Path
from typing import Any

from unjam.children import isolated_start
from unjam.controller import SHIPPED, shipped_file
from unjam.files import make_folder, to_json, write_whole
from unjam.studies.results_file import read_part

SHIPPED_THEN = "shipped-then.json"
"""which files the shipped controllers were that drove in parts of a study, by part"""
Part = tuple[Callable[..., Any], tuple[Any, ...]]
"""a function of a module, and its arguments; it answers what JSON can hold"""
OnProgress = Callable[[str], None]
"""told the name of what is there, when it is there"""


def measure_parts(
    folder: Path, parts: dict[str, Part], workers: int, on_progress: OnProgress = lambda name: None
) -> list[Any]:
    """Return the answers of all parts; those without a `folder/NAME.json` are measured, and get one.

    So are those in which a shipped controller drove that is another file now.
    """
    file = folder / SHIPPED_THEN
    then: dict[str, dict[str, str]] = json.loads(file.read_text()) if file.is_file() else {}

    def is_known(name: str, shipped: dict[str, str]) -> bool:
        return (folder / f"{name}.json").is_file() and then.get(name, shipped) == shipped

    def keep(name: str, answer: Any) -> None:
        write_whole(folder / f"{name}.json", to_json(answer))
        if shipped := _shipped_in(parts[name][1]):
            then[name] = shipped
            write_whole(file, to_json(then, indent=1))
        on_progress(name)

    make_folder(folder)
    missing = {name: part for name, part in parts.items() if not is_known(name, _shipped_in(part[1]))}
    if workers == 1 or len(missing) < 2:
        for name, (function, arguments) in missing.items():
            keep(name, function(*arguments))
    else:
        # Fresh processes: a forked one would inherit threads of torch that are not there.
        context = multiprocessing.get_context("spawn")
        absolute = filter(os.path.isabs, sys.path)  # in a notebook the working folder is on it
        with isolated_start(absolute), ProcessPoolExecutor(workers, mp_context=context) as pool:
            running = {pool.submit(function, *given): name for name, (function, given) in missing.items()}
            for done in as_completed(running):
                keep(running[done], done.result())
    return [read_part(folder, name) for name in parts]


def file_of(driver: str) -> str:
    """Return which file a shipped controller is; nothing for others, whose name says what they are."""
    name = driver.removeprefix(SHIPPED)
    return "" if name == driver else sha256(shipped_file(name).read_bytes()).hexdigest()[:12]


def _shipped_in(arguments: Any) -> dict[str, str]:
    """Return which file each shipped controller is that arguments name."""
    if isinstance(arguments, str):
        return {arguments: file_of(arguments)} if arguments.startswith(SHIPPED) else {}
    if isinstance(arguments, Mapping):
        return _shipped_in(list(arguments.values()))
    inner = arguments if isinstance(arguments, list | tuple) else ()
    return {name: file for each in inner for name, file in _shipped_in(each).items()}
