"""How the cells of the pages are run: in one kernel, for imports take longer than all that they do; and kept.

What they make is kept for as long as nothing changes that they are made of: measured files, code, and Python.
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
MADE_OF = ("results", "src", "docs/*.py", "constraints.txt")
"""what cells read and run, beside themselves"""
KERNEL = AsyncKernelManager()


def kept_in(build: Path) -> Path:
    """Return the folder for what cells make of what is there now; those of what was before are removed."""
    content = hashlib.sha256(sys.version.encode())
    files = [path for pattern in MADE_OF for path in ROOT.glob(pattern)]
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
    """Run a page in the kernel of all pages, which knows nothing of those before it."""
    fresh = f"import os; os.chdir({cwd!r})\n%reset -f\nimport unjam"  # it pins what NumPy computes with
    notebook.cells.insert(0, new_code_cell(fresh))
    try:
        return single_nb_execution(notebook, cwd, km=KERNEL, **options)
    finally:
        del notebook.cells[0]


cache.single_nb_execution = _run
logging.getLogger("traitlets").setLevel(logging.ERROR)  # it tells of each page, and of each client that is left
