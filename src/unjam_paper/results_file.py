"""Measure, write and read the parts of a study, and its results file: one JSON object with its manifest and each part.

A part is measured once, and again if its arguments, or the controllers that they name, have changed. Tables of rows
with the same keys are stored by columns, `{"columns": {NAME: [VALUES]}}`; a value of all rows is stored once,
`{NAME: VALUE}`, and repeated texts as `{"texts": [TEXTS], "rows": [INDICES]}`. Numbers have seven digits. Figures and
controllers are separate files: NAME-FIGURE.png and NAME-controllers.zip. Manifests contain names of the commit that
made the results (CONTRIBUTING.md).
"""

import json
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from matplotlib.figure import Figure

from unjam.child_processes import initialize_pool_process, isolated_start
from unjam.controller import controller_hash
from unjam.errors import InputError
from unjam.files import atomic_write, make_folder, read_json_object, sha256_of, to_json
from unjam.reports.figures import png_bytes

COLUMNS = "columns"
"""the only key of a table that is stored by columns"""
TEXTS = "texts"
"""key of the different texts of a column; `rows` has the index of the text in each row"""
CONTROLLERS = "controllers"
"""subfolder with controllers, in the working folder of a study"""
StudyPart = tuple[Callable[..., Any], tuple[Any, ...]]
"""a function of a module, which returns a JSON value, and its arguments without the last, the number of processes"""


def write_part(folder: Path, name: str, part: Any) -> None:
    """Write a part of a study into its working folder."""
    atomic_write(folder / f"{name}.json", to_json(part, indent=1))


def write_figure(folder: Path, name: str, figure: Figure) -> None:
    """Write a figure of a study into its working folder."""
    atomic_write(folder / f"{name}.png", png_bytes(figure))


def write_results(path: Path, parts: Mapping[str, Any]) -> None:
    """Write a results file, one line for each part; NaN and infinities become null."""
    lines = list[str]()
    for name, part in parts.items():
        rounded = json.loads(to_json(_to_columns(part)), parse_float=lambda text: float(f"{float(text):.7g}"))
        lines.append(f"{json.dumps(name)}: {json.dumps(rounded, separators=(',', ':'))}")
    atomic_write(path, "{\n" + ",\n".join(lines) + "\n}\n")


def collect_results(folder: Path) -> Path:
    """Write the parts of a study from its working folder into one file next to it, and return this file.

    The manifest comes first, then the parts ordered by name. Figures and controllers are copied.
    """
    path = folder.with_name(f"{folder.name}.json")
    parts = read_parts(folder)
    write_results(path, {name: parts[name] for name in sorted(parts, key=lambda name: (name != "manifest", name))})
    for figure in sorted(folder.glob("*.png")):
        name = figure.name if figure.stem == folder.name else f"{folder.name}-{figure.name}"
        atomic_write(folder.with_name(name), figure.read_bytes())
    controllers = sorted((folder / CONTROLLERS).glob("*.unjam"))
    if controllers:
        atomic_write(folder.with_name(f"{folder.name}-controllers.zip"), _zip_files(controllers))
    return path


def read_part(path: Path, name: str) -> Any:
    """Return a part of a study from its results file or folder; `KeyError` or `FileNotFoundError` if it is missing."""
    if path.is_dir():
        return json.loads((path / f"{name}.json").read_text(encoding="utf-8"))
    return _to_rows(json.loads(path.read_text(encoding="utf-8"))[name])


def read_part_or_empty(path: Path, name: str) -> Any:
    """Return a part of a study as `read_part`; an empty object if it is missing."""
    with suppress(KeyError, FileNotFoundError):
        return read_part(path, name)
    return {}


def read_parts(path: Path) -> dict[str, Any]:
    """Return all parts of a study by name, from its results file or its working folder."""
    if path.is_dir():
        return {file.stem: read_part(path, file.stem) for file in sorted(path.glob("*.json"))}
    return _to_rows(json.loads(path.read_text(encoding="utf-8")))


def _zip_files(files: list[Path]) -> bytes:
    content = BytesIO()
    with ZipFile(content, "w") as archive:
        for file in files:
            archive.writestr(ZipInfo(file.name), file.read_bytes(), ZIP_DEFLATED, compresslevel=9)
    return content.getvalue()


def _to_columns(value: Any) -> Any:
    """Return a JSON value with all its tables stored by columns."""
    if isinstance(value, Mapping):
        return {key: _to_columns(entry) for key, entry in value.items()}
    if not isinstance(value, (list, tuple)):
        return value
    if len(value) > 1 and all(isinstance(row, Mapping) and row for row in value):
        names = list(value[0])
        if all(list(row) == names for row in value):
            columns = {name: [row[name] for row in value] for name in names}
            constant = {name for name, entries in columns.items() if _is_constant(entries)}
            if len(constant) < len(names):  # the length of a column is the number of rows
                stored = {
                    name: entries[0] if name in constant else _pack_column(entries) for name, entries in columns.items()
                }
                return {COLUMNS: stored}
    return [_to_columns(entry) for entry in value]


def _pack_column(entries: list[Any]) -> Any:
    """Return a column as stored: texts that repeat are stored once, with their indices in each row."""
    if not all(isinstance(entry, str) for entry in entries) or len(texts := dict.fromkeys(entries)) > len(entries) / 4:
        return _to_columns(entries)
    indices = {text: index for index, text in enumerate(texts)}
    return {TEXTS: [*texts], "rows": [indices[entry] for entry in entries]}


def _unpack_column(stored: Any) -> Any:
    if isinstance(stored, dict) and TEXTS in stored:
        return [stored[TEXTS][index] for index in stored["rows"]]
    return _to_rows(stored)


def _is_constant(entries: list[Any]) -> bool:
    """Return whether all entries are the same number or text; 1, 1.0 and true differ."""
    is_plain = not isinstance(entries[0], (Mapping, list, tuple))
    return is_plain and len({(type(entry), str(entry)) for entry in entries}) == 1


def _to_rows(value: Any) -> Any:
    """Return a stored JSON value with all its tables as lists of rows."""
    if isinstance(value, list):
        return [_to_rows(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    if list(value) != [COLUMNS]:
        return {key: _to_rows(entry) for key, entry in value.items()}
    columns = {name: _unpack_column(entry) for name, entry in value[COLUMNS].items()}
    row_count = max(len(entries) for entries in columns.values() if isinstance(entries, list))
    full_columns = (entries if isinstance(entries, list) else [entries] * row_count for entries in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*full_columns, strict=True)]


def measure_parts(folder: Path, parts: Mapping[str, StudyPart], workers: int) -> dict[str, Any]:
    """Return the results of all parts; measure and write those without a current file `folder/NAME.json`.

    Parts NAME/ENTRY are returned as one part NAME: their rows in one list if they are lists, else an object by entry.
    """
    stamps = {name: _stamp(part) for name, part in parts.items()}
    files = {name: folder / f"{name}.json" for name in parts}

    def read_stored(name: str) -> dict[str, Any]:
        with suppress(InputError):  # a damaged part is measured again
            return read_json_object(files[name]) if files[name].is_file() else {}
        return {}

    def save_result(name: str, result: Any) -> None:
        make_folder(files[name].parent)
        atomic_write(files[name], to_json({"stamp": stamps[name], "result": result}))

    missing = {name: part for name, part in parts.items() if read_stored(name).get("stamp") != stamps[name]}
    processes = max(1, min(workers, len(missing)))
    if processes == 1:
        for name, (function, arguments) in missing.items():
            save_result(name, function(*arguments, workers))
    else:
        # Forked processes would inherit the locks of torch's threads without the threads.
        context, workers_per_part = multiprocessing.get_context("spawn"), max(1, workers // processes)
        import_folders = filter(os.path.isabs, sys.path)  # without the working folder, which a notebook has there
        other_children = set(multiprocessing.active_children())
        new_pool = ProcessPoolExecutor(processes, context, initialize_pool_process, (os.getpid(),))
        with isolated_start(import_folders), new_pool as pool:
            try:
                names = {
                    pool.submit(function, *arguments, workers_per_part): name
                    for name, (function, arguments) in missing.items()
                }
                for future in as_completed(names):
                    save_result(names[future], future.result())
            except BaseException:  # the pool would wait for its processes
                for process in set(multiprocessing.active_children()) - other_children:
                    process.terminate()
                raise
    results: dict[str, Any] = {}
    for name in parts:
        (part, _, entry), result = name.partition("/"), read_stored(name)["result"]
        if not entry:
            results[part] = result
        elif isinstance(result, list):
            results.setdefault(part, []).extend(result)
        else:
            results.setdefault(part, {})[entry] = result
    return results


def _stamp(part: StudyPart) -> str:
    """Return a hash of the function and arguments of a part, and of the controllers that these name."""
    return sha256_of(repr(_describe(part)).encode())[:12]


def _describe(value: Any) -> Any:
    """Return a value with the same text in each process, and with a hash for each controller."""
    if isinstance(value, str | Path):
        return str(value), controller_hash(str(value))
    if isinstance(value, Mapping):
        return [(key, _describe(entry)) for key, entry in value.items()]
    if isinstance(value, list | tuple):
        return list(map(_describe, value))
    return value.__qualname__ if callable(value) else value  # repr(function) contains an address
