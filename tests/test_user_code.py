"""Users' Python files run as they were read and hashed, with the modules of their folder."""

import importlib.machinery
import importlib.util
import inspect
import marshal
import os
import py_compile
import shutil
import sys
import traceback
from pathlib import Path

import pytest

from unjam.errors import InputError
from unjam.user_code import USER_MODULE_PREFIX, read_code

GOOD, EVIL = "value = 'good'\n", "value = 'evil'\n"


def plant_bytecode(source: Path, kind: str) -> None:
    """Put bytecode next to a source that Python itself would run instead."""
    evil = compile(EVIL, str(source), "exec")
    cached = Path(importlib.util.cache_from_source(str(source)))
    cached.parent.mkdir(exist_ok=True)
    found, stamp = importlib.util.MAGIC_NUMBER, source.stat()
    if kind == "by time":
        header = int(stamp.st_mtime).to_bytes(4, "little") + stamp.st_size.to_bytes(4, "little")
        cached.write_bytes(found + bytes(4) + header + marshal.dumps(evil))
    elif kind == "by an unchecked hash":
        cached.write_bytes(found + (1).to_bytes(4, "little") + bytes(8) + marshal.dumps(evil))
    else:
        hashed = importlib.util.source_hash(source.read_bytes())
        cached.write_bytes(found + (3).to_bytes(4, "little") + hashed + marshal.dumps(evil))


@pytest.mark.parametrize("kind", ["by time", "by an unchecked hash", "by a checked hash"])
@pytest.mark.parametrize("name", ["main", "neighbor", "package/inner"])
def test_bytecode_in_the_folder_is_neither_run_nor_written(kind: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    for each in ("package/__init__", "neighbor", "package/inner", "main"):
        (tmp_path / f"{each}.py").write_text(GOOD)
    main = tmp_path / "main.py"
    main.write_text(
        f"{GOOD}import neighbor, package.inner\n"
        "found = {'main': value, 'neighbor': neighbor.value, 'package/inner': package.inner.value}\n"
    )
    plant_bytecode(tmp_path / f"{name}.py", kind)
    spec = importlib.util.spec_from_file_location("planted", tmp_path / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    planted = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(planted)
    assert planted.value == "evil"  # Python itself runs it
    before = sorted(tmp_path.rglob("*"))
    assert set(read_code(main).run().found.values()) == {"good"}
    assert sorted(tmp_path.rglob("*")) == before


LATE = """
import neighbor
def late():
    import later
    from package import inner
    return neighbor.value, later.value, inner.value
"""


def test_hashed_code_runs_also_if_it_is_imported_late(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    for name in ("neighbor", "later", "package/inner"):
        (tmp_path / f"{name}.py").write_text(GOOD)
    main = tmp_path / "main.py"
    main.write_text(LATE)
    code = read_code(main)
    for name in ("neighbor", "later", "package/inner"):
        (tmp_path / f"{name}.py").write_text(EVIL)
    main.write_text(f"{LATE}late = lambda: 'evil'\n")
    assert code.run().late() == ("good", "good", "good")
    assert read_code(main).sha256 != code.sha256
    assert read_code(main).run().late() == "evil"


@pytest.mark.parametrize("changed", ["main", "neighbor", "later", "package/inner", "package/__init__"])
def test_the_hash_is_of_all_that_can_run(changed: str, tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "main.py").write_text(LATE)
    for name in ("neighbor", "later", "package/inner"):
        (tmp_path / f"{name}.py").write_text(GOOD)
    before = read_code(tmp_path / "main.py").sha256
    file = tmp_path / f"{changed}.py"
    file.write_text(f"{file.read_text() if file.exists() else ''}# changed\n")
    assert read_code(tmp_path / "main.py").sha256 != before


@pytest.mark.parametrize("suffix", [".pyc", *importlib.machinery.EXTENSION_SUFFIXES])
@pytest.mark.parametrize("late", [False, True])
def test_a_compiled_neighbor_without_source_is_refused_in_one_line(suffix: str, late: bool, tmp_path: Path) -> None:
    source, main = tmp_path / "fast.py", tmp_path / "main.py"
    source.write_text(EVIL)
    py_compile.compile(str(source), str(tmp_path / f"fast{suffix}"))
    main.write_text("def late():\n    import fast\n" if late else "import fast\n")
    assert read_code(main).modules["fast"][0] == source
    source.unlink()
    with pytest.raises(InputError, match=r"^main\.py: imports '.*fast\..*', which is compiled; allowed: "):
        read_code(main)


def test_modules_of_the_standard_library_and_of_packages_come_before_neighbors(tmp_path: Path) -> None:
    for name in ("json", "numpy", "queue", "safetensors", "unjam"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError")
    main = tmp_path / "main.py"
    main.write_text("import json, numpy, queue, safetensors, unjam\nimport numpy.linalg as linalg\n")
    code = read_code(main)
    assert code.modules.keys() == {""}
    assert code.run().linalg.__name__ == "numpy.linalg"


def test_a_folder_without_init_does_not_hide_a_package(tmp_path: Path) -> None:
    (tmp_path / "numpy").mkdir()
    (tmp_path / "numpy" / "linalg.py").write_text("raise RuntimeError")
    (tmp_path / "main.py").write_text("import numpy.linalg\n")
    assert read_code(tmp_path / "main.py").run().numpy.linalg.norm([3, 4]) == 5


PACKAGE = {
    "main.py": "from pack import *\nimport pack.deep.leaf as leaf\nimport pack\nfrom pack.deep import up\n",
    "pack/__init__.py": "__all__ = ['one', 'two']\none = 1\nfrom . import two\nfrom .deep.leaf import own\n",
    "pack/two.py": "from __future__ import annotations\nfrom pack import one\n",
    "pack/deep/__init__.py": "",
    "pack/deep/leaf.py": "from ..two import one as own\n",
    "pack/deep/up.py": "from .. import two\nfrom .leaf import own\n",
}


def test_packages_of_the_folder_are_imported_as_usual(tmp_path: Path) -> None:
    for name, source in PACKAGE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(source)
    module = read_code(tmp_path / "main.py").run()
    assert (module.one, module.two.one, module.leaf.own, module.up.two) == (1, 1, 1, module.two)
    assert module.pack.deep.leaf is module.leaf
    assert not {"pack", "pack.two", "pack.deep.leaf"} & sys.modules.keys()
    assert module.two.__name__.startswith(USER_MODULE_PREFIX)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("from . import neighbor", "attempted relative import with no known parent package"),
        ("import nowhere_to_be_found", "No module named 'nowhere_to_be_found'"),
        ("import neighbor.inner", "No module named 'neighbor.inner'"),
        ("from neighbor import other", "cannot import name 'other'"),
    ],
)
def test_a_missing_module_is_an_import_error_as_usual(source: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "neighbor.py").write_text(GOOD)
    (tmp_path / "main.py").write_text(source)
    with pytest.raises(ImportError, match=words):
        read_code(tmp_path / "main.py").run()


def test_tracebacks_and_inspect_show_the_source_that_runs(tmp_path: Path) -> None:
    main, neighbor = tmp_path / "main.py", tmp_path / "neighbor.py"
    neighbor.write_text("class Keeper:\n    def fail(self):\n        return 1 / 0  # this one\n")
    main.write_text("from neighbor import Keeper\ndef fail():\n    return Keeper().fail()\n")
    module = read_code(main).run()
    neighbor.write_text("# nothing\n")
    assert inspect.getsource(module.fail) == "def fail():\n    return Keeper().fail()\n"
    assert inspect.getsource(module.Keeper).startswith("class Keeper:")
    with pytest.raises(ZeroDivisionError) as caught:
        module.fail()
    shown = "".join(traceback.format_exception(caught.value))
    assert f'File "{neighbor}", line 3, in fail\n    return 1 / 0  # this one\n' in shown


DATACLASS = """
from __future__ import annotations
import pickle
from dataclasses import dataclass
from typing import get_type_hints
@dataclass
class Gains:
    each: Inner
class Inner: ...
assert get_type_hints(Gains) == {"each": Inner}
again = pickle.loads(pickle.dumps(Inner()))
assert type(again) is Inner
"""


def test_classes_of_neighbors_are_found_by_typing_and_pickle(tmp_path: Path) -> None:
    (tmp_path / "gains.py").write_text(DATACLASS)
    (tmp_path / "main.py").write_text(
        "import importlib, pickle, gains\n"
        "same = importlib.import_module('gains') is gains\n"
        "old = pickle.loads(b'cgains\\nInner\\n.')\n"  # as a program of theirs has written it
    )
    module = read_code(tmp_path / "main.py").run()
    assert module.same
    assert module.old is module.gains.Inner
    assert "gains" not in sys.modules


def test_every_run_executes_all_modules_again(tmp_path: Path) -> None:
    (tmp_path / "count.py").write_text("calls = []\n")
    (tmp_path / "main.py").write_text("import count\ndef call():\n    import count\n    count.calls.append(1)\n")
    code = read_code(tmp_path / "main.py")
    one, other = code.run(), code.run()
    one.call()
    assert (len(one.count.calls), len(other.count.calls)) == (1, 0)
    names = [name for name in sys.modules if name.startswith(f"{USER_MODULE_PREFIX}main_")]
    assert len([name for name in names if name.endswith(".count")]) == 1


def test_a_neighbor_that_the_program_has_already_imported_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gains_of_mine.py").write_text(EVIL)
    monkeypatch.syspath_prepend(str(tmp_path))
    import gains_of_mine  # pyright: ignore[reportMissingImports]

    (tmp_path / "gains_of_mine.py").write_text(GOOD)
    (tmp_path / "main.py").write_text("from gains_of_mine import value\n")
    assert read_code(tmp_path / "main.py").run().value == "good"
    assert sys.modules["gains_of_mine"] is gains_of_mine
    del sys.modules["gains_of_mine"]


def test_a_file_that_cannot_be_parsed_fails_when_it_runs(tmp_path: Path) -> None:
    (tmp_path / "main.py").write_text("def x(:")
    with pytest.raises(SyntaxError):
        read_code(tmp_path / "main.py").run()
    shutil.rmtree(tmp_path / "__pycache__", ignore_errors=True)
    (tmp_path / "main.py").write_bytes(b"# -*- coding: latin-1 -*-\nvalue = '\xe9'\n")
    assert read_code(tmp_path / "main.py").run().value == "é"
    assert os.listdir(tmp_path) == ["main.py"]


@pytest.mark.parametrize("has_init", [True, False])
def test_packages_of_the_folder_are_not_searched_for_modules_that_were_not_read(has_init: bool, tmp_path: Path) -> None:
    package = tmp_path / "plug"
    package.mkdir()
    if has_init:
        (package / "__init__.py").touch()
    (package / "known.py").write_text("value = 1\n")
    (package / "late.py").write_text("raise SystemExit('not read, and run')\n")
    lines = [
        *("import importlib", "import plug.known", "names = []"),
        "for name in ('plug.late', plug.__name__ + '.late'):",
        *("    try:", "        importlib.import_module(name)"),
        "    except ModuleNotFoundError as error:",
        "        names.append(error.name)",
    ]
    file = tmp_path / "mine.py"
    file.write_text("\n".join(lines))
    module = read_code(file).run()
    assert module.plug.known.value == 1
    assert [name.rpartition(".")[2] for name in module.names] == ["late", "late"]
