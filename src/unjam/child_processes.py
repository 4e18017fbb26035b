"""Start Python child processes that import nothing from the working folder or from the folder of a script.

`python -m` and `python -c` search the working folder first, which can be a downloaded one.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import chdir, contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

from unjam.processes import bind_to_parent, follow_parent
from unjam.trust import expected_code_environment
from unjam.user_code import is_package_folder

PACKAGE_PARENT = str(Path(__file__).parents[1])  # folder from which unjam itself is imported
DATA_FOLDER = Path(__file__).with_name("controllers")  # contains no Python modules and no settings of libraries


def python_command(*arguments: str) -> list[str]:
    """Return the command line of a Python child; use it with `child_environment`."""
    return [sys.executable, "-P", *arguments]


def child_environment(**changes: str) -> dict[str, str]:
    """Return the environment of a child that ends with this process; its children are isolated too."""
    return bind_to_parent({**os.environ, **_isolation_variables(), **expected_code_environment(), **changes})


def child_import_path() -> list[str]:
    """Return the folders of `sys.path` without the working folder and the folder of the script."""
    script = getattr(sys.modules["__main__"], "__file__", None) or sys.argv[0]
    excluded = {os.path.realpath(os.curdir), os.path.realpath(os.path.dirname(script))}
    return [
        folder
        for folder in sys.path
        if is_package_folder(folder) or (os.path.isabs(folder) and os.path.realpath(folder) not in excluded)
    ]


def isolate_children() -> None:
    """Isolate all Python processes that this process starts from now on."""
    os.environ.update(_isolation_variables())


@contextmanager
def isolated_start(import_path: Iterable[str]) -> Iterator[None]:
    """Isolate Python processes that a library starts within the block, and set their import path."""
    original_path = sys.path[:]
    original_variables = {name: os.environ.get(name) for name in _isolation_variables()}
    sys.path[:] = import_path
    isolate_children()
    try:
        yield
    finally:
        sys.path[:] = original_path
        for name, value in original_variables.items():
            os.environ.pop(name)
            os.environ.update({} if value is None else {name: value})


@contextmanager
def leave_working_folder() -> Iterator[None]:
    """Change to a safe folder within the block: some libraries read settings or import from the working folder."""
    with chdir(DATA_FOLDER):
        yield


class _MatplotlibFinder(MetaPathFinder):
    """Loads matplotlib outside the working folder, so that it does not read the `matplotlibrc` there."""

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname) if fullname == "matplotlib" else None
        if spec is not None and spec.loader is not None:
            spec.loader.exec_module = leave_working_folder()(spec.loader.exec_module)
        return spec


def isolate_matplotlib() -> None:
    """Let matplotlib ignore settings in the working folder; it must not be imported yet."""
    sys.meta_path.insert(0, _MatplotlibFinder())


def initialize_pool_process(parent: int) -> None:
    """Initialize a process of a pool, so that it ends with its parent."""
    follow_parent(parent)
    isolate_matplotlib()


def _isolation_variables() -> dict[str, str]:
    """Return environment variables that keep the working folder and folders relative to it out of the import path."""
    folders = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    safe_folders = [folder for folder in folders if os.path.isabs(folder) or os.path.abspath(folder) == PACKAGE_PARENT]
    return {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(map(os.path.abspath, safe_folders))}
