"""Parts of a study: each is measured once, and again if a packaged controller that drives in it has changed."""

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
from unjam_paper.results_file import read_optional_part, read_part, write_part

CONTROLLERS_FILE = "controllers"
"""name of the part with the digests of the packaged controllers that drove, by part"""
StudyPart = tuple[Callable[..., Any], tuple[Any, ...]]
"""a function of a module and its arguments; it returns a JSON value"""
PartCallback = Callable[[str], None]
"""receives the name of each part that is finished"""


def measure_parts(
    folder: Path, parts: dict[str, StudyPart], workers: int, on_part: PartCallback = lambda name: None
) -> list[Any]:
    """Return the results of all parts; those without a current `folder/NAME.json` are measured and written.

    A part is not current if a packaged controller in it has another digest than when it was measured.
    """
    digests: dict[str, dict[str, str]] = read_optional_part(folder, CONTROLLERS_FILE)

    def is_current(name: str) -> bool:
        current = _packaged_digests(parts[name][1])
        return (folder / f"{name}.json").is_file() and digests.get(name, current) == current

    def save_part(name: str, result: Any) -> None:
        atomic_write(folder / f"{name}.json", to_json(result))
        if packaged := _packaged_digests(parts[name][1]):
            digests[name] = packaged
            write_part(folder, CONTROLLERS_FILE, digests)
        on_part(name)

    make_folder(folder)
    missing = {name: part for name, part in parts.items() if not is_current(name)}
    if workers == 1 or len(missing) < 2:
        for name, (function, arguments) in missing.items():
            save_part(name, function(*arguments))
    else:
        # Spawned processes: a forked one would inherit the locks of torch's threads without the threads.
        context = multiprocessing.get_context("spawn")
        absolute = filter(os.path.isabs, sys.path)  # in a notebook it holds the working folder
        with isolated_start(absolute), ProcessPoolExecutor(workers, mp_context=context) as pool:
            running = {pool.submit(function, *arguments): name for name, (function, arguments) in missing.items()}
            for done in as_completed(running):
                save_part(running[done], done.result())
    return [read_part(folder, name) for name in parts]


def controller_digest(driver: str) -> str:
    """Return the digest of a packaged controller; an empty text for other drivers, which their name identifies."""
    name = driver.removeprefix(PACKAGED_PREFIX)
    return "" if name == driver else sha256(packaged_file(name).read_bytes()).hexdigest()[:12]


def _packaged_digests(arguments: Any) -> dict[str, str]:
    """Return the digest of each packaged controller that arguments name."""
    if isinstance(arguments, str):
        return {arguments: controller_digest(arguments)} if arguments.startswith(PACKAGED_PREFIX) else {}
    inner = list(arguments.values()) if isinstance(arguments, Mapping) else arguments
    inner = inner if isinstance(inner, list | tuple) else ()
    return {name: digest for each in inner for name, digest in _packaged_digests(each).items()}
