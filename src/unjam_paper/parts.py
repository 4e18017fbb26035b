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

from unjam.child_processes import isolated_start
from unjam.controller import PACKAGED_PREFIX, packaged_file
from unjam.files import atomic_write, make_folder, to_json
from unjam_paper.results_file import read_part

CONTROLLERS_FILE = "shipped-then.json"
"""which files the shipped controllers were that drove in parts of a study, by part"""
StudyPart = tuple[Callable[..., Any], tuple[Any, ...]]
"""a function of a module, and its arguments; it answers what JSON can hold"""
PartCallback = Callable[[str], None]
"""told the name of what is there, when it is there"""


def measure_parts(
    folder: Path, parts: dict[str, StudyPart], workers: int, on_part: PartCallback = lambda name: None
) -> list[Any]:
    """Return the answers of all parts; those without a `folder/NAME.json` are measured, and get one.

    So are those in which a shipped controller drove that is another file now.
    """
    file = folder / CONTROLLERS_FILE
    then: dict[str, dict[str, str]] = json.loads(file.read_text()) if file.is_file() else {}

    def is_current(name: str, controllers: dict[str, str]) -> bool:
        return (folder / f"{name}.json").is_file() and then.get(name, controllers) == controllers

    def save_part(name: str, answer: Any) -> None:
        atomic_write(folder / f"{name}.json", to_json(answer))
        if shipped := _packaged_digests(parts[name][1]):
            then[name] = shipped
            atomic_write(file, to_json(then, indent=1))
        on_part(name)

    make_folder(folder)
    missing = {name: part for name, part in parts.items() if not is_current(name, _packaged_digests(part[1]))}
    if workers == 1 or len(missing) < 2:
        for name, (function, arguments) in missing.items():
            save_part(name, function(*arguments))
    else:
        # Fresh processes: a forked one would inherit threads of torch that are not there.
        context = multiprocessing.get_context("spawn")
        absolute = filter(os.path.isabs, sys.path)  # in a notebook the working folder is on it
        with isolated_start(absolute), ProcessPoolExecutor(workers, mp_context=context) as pool:
            running = {pool.submit(function, *given): name for name, (function, given) in missing.items()}
            for done in as_completed(running):
                save_part(running[done], done.result())
    return [read_part(folder, name) for name in parts]


def controller_digest(driver: str) -> str:
    """Return which file a shipped controller is; nothing for others, whose name says what they are."""
    name = driver.removeprefix(PACKAGED_PREFIX)
    return "" if name == driver else sha256(packaged_file(name).read_bytes()).hexdigest()[:12]


def _packaged_digests(arguments: Any) -> dict[str, str]:
    """Return which file each shipped controller is that arguments name."""
    if isinstance(arguments, str):
        return {arguments: controller_digest(arguments)} if arguments.startswith(PACKAGED_PREFIX) else {}
    if isinstance(arguments, Mapping):
        return _packaged_digests(list(arguments.values()))
    inner = arguments if isinstance(arguments, list | tuple) else ()
    return {name: file for each in inner for name, file in _packaged_digests(each).items()}
