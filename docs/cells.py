"""Run the code cells of the pages in one kernel, because imports take longer than the cells, and cache their outputs.

The cache is valid until the results, the code or the version of Python change.
"""

import hashlib
import logging
import sys
from pathlib import Path
from shutil import rmtree
from typing import Any

from jupyter_cache.executors.utils import ExecutionResult, single_nb_execution
from jupyter_client.manager import AsyncKernelManager
from myst_nb.core.execute import cache
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell

ROOT = Path(__file__).parents[1]
SOURCES = ("results", "src", "docs/*.py", "constraints.txt")
"""files on which the outputs of cells depend, in addition to the cells"""
KERNEL = AsyncKernelManager()


def cache_folder(build: Path) -> Path:
    """Return the cache folder for the present sources, and remove those of earlier sources."""
    content = hashlib.sha256(sys.version.encode())
    files = [path for pattern in SOURCES for path in ROOT.glob(pattern)]
    files += [path for folder in files if folder.is_dir() for path in folder.rglob("*")]
    for path in sorted(path for path in files if path.is_file() and path.suffix != ".pyc"):
        content.update(f"{path.relative_to(ROOT)}\n".encode())
        content.update(path.read_bytes())
    folder = build / content.hexdigest()[:16]
    for other in build.glob("*"):
        if other != folder:
            rmtree(other)
    return folder


def _run(notebook: NotebookNode, cwd: str, **options: Any) -> ExecutionResult:
    """Run a page in the common kernel, without the variables of the pages before it."""
    fresh = f"import os; os.chdir({cwd!r})\n%reset -f\nimport unjam"  # unjam selects the kernels of NumPy
    notebook.cells.insert(0, new_code_cell(fresh))
    try:
        return single_nb_execution(notebook, cwd, km=KERNEL, **options)
    finally:
        del notebook.cells[0]


cache.single_nb_execution = _run
logging.getLogger("traitlets").setLevel(logging.ERROR)  # it warns about each page and each client
