"""Users' Python files: read once with the modules that they import from their folder, hashed, run as read.

What runs is compiled from the bytes that were hashed. Bytecode in the folder is neither read nor written, and
a file that is replaced after it was read changes nothing. Modules of several folders may have the same names:
they are in `sys.modules` below a name that belongs to the file, and only they find each other by `import`.
"""

import ast
import builtins
import hashlib
import importlib.util
import linecache
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.abc import InspectLoader
from importlib.machinery import BYTECODE_SUFFIXES, EXTENSION_SUFFIXES, PathFinder
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from unjam.errors import InputError

PREFIX = "unjam_user_"
"""what names of users' modules in `sys.modules` begin with"""
INIT = "__init__.py"


@dataclass(frozen=True)
class UserCode:
    """A Python file and the modules of its folder that it imports, also in functions, as they were read."""

    path: Path
    modules: Mapping[str, tuple[Path, bytes]]
    """place and source by the name within the folder; the file's own is empty; a folder without `__init__.py`
    is a package without source"""

    @property
    def sha256(self) -> str:
        """Return the hash of all that can run: of the file alone, that of its bytes."""
        hashes = {name: hashlib.sha256(source).hexdigest() for name, (_, source) in self.modules.items()}
        if len(hashes) == 1:
            return hashes[""]
        lines = (f"{name} {self.modules[name][0].name} {sha256}\n" for name, sha256 in sorted(hashes.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def run(self) -> ModuleType:
        """Run the file and return its module; all that it imports from its folder runs anew, too."""
        return _Modules(self).run()


def read_code(path: Path) -> UserCode:
    """Read a Python file and, as its import statements name them, the modules of its folder.

    Installed packages come before modules of the folder that have the same name.

    Raises:
        InputError: it imports a compiled module of its folder.
        OSError: a file cannot be read.
    """
    found = {"": (path, path.read_bytes())}
    waiting = [""]
    while waiting:
        name = waiting.pop()
        place, source = found[name]
        for wanted in _imported_names(source, _package_of(name, place)):
            parts = wanted.split(".")
            for end in range(1, len(parts) + 1):
                inner, parent = ".".join(parts[:end]), ".".join(parts[: end - 1])
                if inner in found:
                    continue
                if parent and not _is_package(found[parent][0]):
                    break
                if (file := _find(path, inner)) is None:
                    break
                found[inner] = file, file.read_bytes() if file.suffix == ".py" else b""
                waiting.append(inner)
    return UserCode(path, found)


def _find(path: Path, name: str) -> Path | None:
    """Return the source of a module of a file's folder, or the folder of a package that has none."""
    base = path.parent.joinpath(*name.split("."))
    sources = [file for file in (base / INIT, base.with_name(f"{base.name}.py")) if file.is_file()]
    compiled = [
        file
        for stem in (base / "__init__", base)
        for suffix in (*EXTENSION_SUFFIXES, *BYTECODE_SUFFIXES)
        if (file := stem.with_name(stem.name + suffix)).is_file()
    ]
    folders = [base] if base.is_dir() else []
    if not (sources or compiled or folders) or ("." not in name and _is_installed(name)):
        return None
    if compiled and not sources:
        allowed = "allowed: modules in Python source, installed packages"
        raise InputError(f"{path.name}: imports {str(compiled[0])!r}, which is compiled; {allowed}")
    return [*sources, *folders][0]


@lru_cache(1024)
def _is_installed(name: str) -> bool:
    """Return whether a module is unjam's own, of the standard library, or of an installed package."""
    folders = [each for each in sys.path if is_of_packages(each)]
    spec = PathFinder.find_spec(name, folders)
    is_package = spec is not None and spec.origin is not None  # not merely a folder
    return is_package or name == "unjam" or name in sys.stdlib_module_names


def is_of_packages(folder: str) -> bool:
    """Return whether a folder of `sys.path` is one that packages are installed into."""
    return Path(folder).name in ("site-packages", "dist-packages")


@lru_cache(1024)
def _imported_names(source: bytes, package: str) -> tuple[str, ...]:
    """Return what the import statements of a source can name, in a package or, if that is empty, in none."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # running it says what is wrong
        return ()
    names = dict[str, None]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name: None for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: -(node.level - 1) or None] if node.level and package else []
            if node.level and not parts:
                continue
            base = ".".join([*parts, *([node.module] if node.module else [])])
            names |= dict.fromkeys([base, *(f"{base}.{alias.name}" for alias in node.names)])
    return tuple(names)


@lru_cache(1024)
def _compiled(source: bytes, path: str) -> CodeType:
    return InspectLoader.source_to_code(source, path)


def _is_package(place: Path) -> bool:
    return place.name == INIT or place.suffix != ".py"


def _package_of(name: str, place: Path) -> str:
    return name if name and _is_package(place) else name.rpartition(".")[0]


class _Modules(InspectLoader):
    """The modules of one run of a file, and how `import` within them finds and runs them."""

    def __init__(self, code: UserCode) -> None:
        self._code = code
        self._root = f"{PREFIX}{code.path.stem}_{abs(hash(str(code.path))):x}"
        self._modules: dict[str, ModuleType] = {}
        self._lock, self._running = threading.RLock(), False
        self._builtins = {**vars(builtins), "__import__": self._import}

    def run(self) -> ModuleType:
        """Run the file; meanwhile its modules have their short names, too, for other ways to import."""
        for name in list(sys.modules):
            if f"{name}.".startswith(f"{self._root}."):
                del sys.modules[name]  # of the run before
        missing = [name for name in self._code.modules if name and name not in sys.modules]
        self._running = True
        try:
            return self._load("")
        finally:
            self._running = False
            for name in missing:
                sys.modules.pop(name, None)

    def get_source(self, fullname: str) -> str:
        """Return the source of a module, for tracebacks."""
        return importlib.util.decode_source(self._code.modules[self._inner(fullname)][1])

    def get_code(self, fullname: str) -> CodeType:
        """Return the compiled source of a module; the lines that tracebacks show are those that run."""
        place, source = self._code.modules[self._inner(fullname)]
        code = _compiled(source, str(place))
        lines = self.get_source(fullname).splitlines(keepends=True)
        linecache.cache[str(place)] = (len(source), None, lines, str(place))
        return code

    def is_package(self, fullname: str) -> bool:
        """Return whether a module has modules below it."""
        inner = self._inner(fullname)
        return bool(inner) and _is_package(self._code.modules[inner][0])

    def _inner(self, fullname: str) -> str:
        return fullname[len(self._root) + 1 :]

    def _load(self, inner: str) -> ModuleType:
        """Return a module, which runs where it is imported first."""
        parent, _, own = inner.rpartition(".")
        if parent:
            self._load(parent)
        if inner in self._modules:
            return self._modules[inner]
        place, _ = self._code.modules[inner]
        name = f"{self._root}.{inner}" if inner else self._root
        below = [str(place.parent if place.name == INIT else place)] if self.is_package(name) else None
        spec = importlib.util.spec_from_file_location(
            name, place, loader=self, submodule_search_locations=below
        )
        assert spec is not None
        if below is not None:
            spec.submodule_search_locations = []  # or Python itself would search the folder, unhashed
        module = importlib.util.module_from_spec(spec)
        module.__dict__["__builtins__"] = self._builtins
        self._modules[inner] = sys.modules[name] = module
        if inner and self._running:
            sys.modules.setdefault(inner, module)
        try:
            self.exec_module(module)
        except BaseException:
            del self._modules[inner], sys.modules[name]
            raise
        if parent:
            setattr(self._modules[parent], own, module)
        return module

    def _import(
        self,
        name: str,
        globals: Mapping[str, Any] | None = None,
        locals: Mapping[str, Any] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """Do what `import` does in these modules: first of the folder, then as anywhere else."""
        inner = name
        if level:
            own = self._inner(str((globals or {})["__name__"]))
            package = _package_of(own, self._code.modules[own][0])
            if not package:
                raise ImportError("attempted relative import with no known parent package")
            inner = importlib.util.resolve_name("." * level + name, package)
        top = inner.partition(".")[0]
        if top not in self._code.modules:
            return builtins.__import__(name, globals, locals, fromlist or (), level)
        with self._lock:
            if inner not in self._code.modules:
                raise ModuleNotFoundError(f"No module named {inner!r}", name=inner)
            module = self._load(inner)
            if not fromlist:
                return self._load(top)
            for item in self._items(module, fromlist):
                if f"{inner}.{item}" in self._code.modules and not hasattr(module, item):
                    self._load(f"{inner}.{item}")
            return module

    def _items(self, module: ModuleType, fromlist: Sequence[str]) -> Iterator[str]:
        yield from getattr(module, "__all__", ()) if "*" in fromlist else fromlist
