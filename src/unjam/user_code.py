"""Read Python files of users, with the modules that they import from their folder, hash them, and run them as read.

Bytecode in the folder is neither read nor written, and replacing a file after reading has no effect. Modules of
several folders can have the same names; in `sys.modules` their names have a prefix for each file.
"""

import ast
import builtins
import importlib.util
import linecache
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.abc import InspectLoader
from importlib.machinery import BYTECODE_SUFFIXES, EXTENSION_SUFFIXES, PathFinder
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from unjam.errors import InputError
from unjam.files import sha256_of

USER_MODULE_PREFIX = "unjam_user_"  # beginning of names in `sys.modules`
INIT_FILE = "__init__.py"
_compile_source = lru_cache(1024)(InspectLoader.source_to_code)


@dataclass(frozen=True)
class UserCode:
    """Source of a Python file, and of the modules of its folder that it imports, also in functions."""

    path: Path
    modules: Mapping[str, tuple[Path, bytes]]
    """path and source by module name in the folder; the name of the file itself is empty, and the source of a folder
    without `__init__.py` is empty"""

    @property
    def sha256(self) -> str:
        """The hash of all code that can run; for a single file, the hash of its bytes."""
        hashes = {name: sha256_of(source) for name, (_, source) in self.modules.items()}
        if len(hashes) == 1:
            return hashes[""]
        lines = (f"{name} {self.modules[name][0].name} {sha256}\n" for name, sha256 in sorted(hashes.items()))
        return sha256_of("".join(lines).encode())

    def run(self) -> ModuleType:
        """Run the file, and its imports from its folder, again, and return its module."""
        return _Modules(self).run()


def read_code(path: Path) -> UserCode:
    """Read a Python file, and modules of its folder that import statements name unless they are installed packages.

    Raise `InputError` for a compiled module of the folder, `OSError` if a file cannot be read.
    """
    modules = {"": (path, path.read_bytes())}
    unread = [""]
    while unread:
        name = unread.pop()
        file, source = modules[name]
        for imported in _imported_names(source, _package_name(name, file)):
            parts = imported.split(".")
            for end in range(1, len(parts) + 1):
                module, parent = ".".join(parts[:end]), ".".join(parts[: end - 1])
                if module in modules:
                    continue
                if parent and not _is_package(modules[parent][0]):
                    break
                if (file := _find_source(path, module)) is None:
                    break
                modules[module] = file, file.read_bytes() if file.suffix == ".py" else b""
                unread.append(module)
    return UserCode(path, modules)


def _find_source(path: Path, name: str) -> Path | None:
    """Return the source file of a module in the folder of `path`, or the folder of a package without source."""
    base = path.parent.joinpath(*name.split("."))
    sources = [file for file in (base / INIT_FILE, base.with_name(f"{base.name}.py")) if file.is_file()]
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
    """Return whether a module belongs to unjam, the standard library, or an installed package."""
    spec = PathFinder.find_spec(name, list(filter(is_package_folder, sys.path)))
    is_package = spec is not None and spec.origin is not None  # a folder alone has no origin
    return is_package or name == "unjam" or name in sys.stdlib_module_names


def is_package_folder(folder: str) -> bool:
    """Return whether a folder of `sys.path` is for installed packages."""
    return Path(folder).name in ("site-packages", "dist-packages")


@lru_cache(1024)
def _imported_names(source: bytes, package: str) -> tuple[str, ...]:
    """Return all modules that import statements of a source can mean; `package` is empty outside packages."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, MemoryError):  # running the code reports the error
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


def _is_package(path: Path) -> bool:
    return path.name == INIT_FILE or path.suffix != ".py"


def _package_name(name: str, path: Path) -> str:
    return name if name and _is_package(path) else name.rpartition(".")[0]


class _Modules(InspectLoader):
    """Modules of one run of a file; `import` in these modules finds and runs modules of the folder."""

    def __init__(self, code: UserCode) -> None:
        self._code = code
        self._root = f"{USER_MODULE_PREFIX}{code.path.stem}_{abs(hash(str(code.path))):x}"
        self._modules: dict[str, ModuleType] = {}
        self._lock, self._is_running = threading.RLock(), False
        self._builtins = {**vars(builtins), "__import__": self._import}

    def run(self) -> ModuleType:
        """Run the file; meanwhile its modules also have their short names, for other ways to import them."""
        for name in list(sys.modules):
            if f"{name}.".startswith(f"{self._root}."):
                del sys.modules[name]  # from the previous run
        missing = [name for name in self._code.modules if name and name not in sys.modules]
        self._is_running = True
        try:
            return self._load("")
        finally:
            self._is_running = False
            for name in missing:
                sys.modules.pop(name, None)

    def get_source(self, fullname: str) -> str:
        """Return the source of a module, for tracebacks."""
        return importlib.util.decode_source(self._code.modules[self._local_name(fullname)][1])

    def get_code(self, fullname: str) -> CodeType:
        """Return the compiled source of a module, and register its lines for tracebacks."""
        path, source = self._code.modules[self._local_name(fullname)]
        code = _compile_source(source, str(path))
        lines = self.get_source(fullname).splitlines(keepends=True)
        linecache.cache[str(path)] = (len(source), None, lines, str(path))
        return code

    def is_package(self, fullname: str) -> bool:
        """Return whether a module is a package."""
        local_name = self._local_name(fullname)
        return bool(local_name) and _is_package(self._code.modules[local_name][0])

    def _local_name(self, fullname: str) -> str:
        return fullname[len(self._root) + 1 :]

    def _load(self, local_name: str) -> ModuleType:
        """Return a module, and run it at its first import."""
        parent, _, short_name = local_name.rpartition(".")
        if parent:
            self._load(parent)
        if local_name in self._modules:
            return self._modules[local_name]
        path, _ = self._code.modules[local_name]
        name = f"{self._root}.{local_name}" if local_name else self._root
        folders = [str(path.parent if path.name == INIT_FILE else path)] if self.is_package(name) else None
        spec = importlib.util.spec_from_file_location(name, path, loader=self, submodule_search_locations=folders)
        assert spec is not None
        if folders is not None:
            spec.submodule_search_locations = []  # Python must not import files that are not hashed
        module = importlib.util.module_from_spec(spec)
        module.__dict__["__builtins__"] = self._builtins
        self._modules[local_name] = sys.modules[name] = module
        if local_name and self._is_running:
            sys.modules.setdefault(local_name, module)
        try:
            self.exec_module(module)
        except BaseException:
            del self._modules[local_name], sys.modules[name]
            raise
        if parent:
            setattr(self._modules[parent], short_name, module)
        return module

    def _import(
        self,
        name: str,
        globals: Mapping[str, Any] | None = None,
        locals: Mapping[str, Any] | None = None,
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """Import a module for these modules: first from the folder, then as usual."""
        local_name = name
        if level:
            importer = self._local_name(str((globals or {})["__name__"]))
            package = _package_name(importer, self._code.modules[importer][0])
            if not package:
                raise ImportError("attempted relative import with no known parent package")
            local_name = importlib.util.resolve_name("." * level + name, package)
        top_name = local_name.partition(".")[0]
        if top_name not in self._code.modules:
            return builtins.__import__(name, globals, locals, fromlist or (), level)
        with self._lock:
            if local_name not in self._code.modules:
                raise ModuleNotFoundError(f"No module named {local_name!r}", name=local_name)
            module = self._load(local_name)
            if not fromlist:
                return self._load(top_name)
            for item in getattr(module, "__all__", ()) if "*" in fromlist else fromlist:
                if f"{local_name}.{item}" in self._code.modules and not hasattr(module, item):
                    self._load(f"{local_name}.{item}")
            return module
