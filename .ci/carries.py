"""Does an installed unjam carry all that its tree has beside its Python files? Run by .ci/release."""

import sys
from importlib.resources import files
from pathlib import Path

import unjam

tree = Path(__file__).parents[1] / "src" / "unjam"
here = files("unjam")
assert Path(str(here)).resolve() != tree.resolve(), "the tree itself is on the path"
assert "torch" not in sys.modules

wanted = [path.relative_to(tree) for path in tree.rglob("*") if path.is_file() and path.suffix != ".pyc"]
missing = [str(path) for path in wanted if not here.joinpath(*path.parts).is_file()]
assert not missing, f"not in the installed package: {missing}"
kinds = {path.suffix for path in wanted}
assert {".unjam", ".html", ".css", ".js", ".typed", ".py"} <= kinds, kinds
print(f"unjam {unjam.__version__}: all {len(wanted)} files")
