"""Each public name has one definition, so that a search for it finds one place."""

import ast
from collections import defaultdict
from collections.abc import Iterator

from tests.test_layers import MODULES

HOMONYMS: dict[str, set[str]] = {}
"""names that more than one module defines, with these modules: entries may be removed, never added"""


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield the functions, classes and constants that a module defines for others, imports left out."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            targets = [part for target in node.targets for part in ast.walk(target)]
            names = [part.id for part in targets if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names = [node.target.id]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def test_a_public_name_has_one_definition() -> None:
    modules: defaultdict[str, set[str]] = defaultdict(set)
    for module, tree in MODULES.items():
        for name in public_names(tree):
            modules[name].add(module)
    assert {name: found for name, found in modules.items() if len(found) > 1} == HOMONYMS


def test_definitions_of_all_kinds_are_found() -> None:
    source = (
        "import a\nA = B, C = 1, 2\nD: int = 3\nD += 1\n_E = 4\nclass F: G = 5\ndef h(): i = 6\nasync def j(): ...\n"
    )
    assert sorted(public_names(ast.parse(source))) == ["A", "B", "C", "D", "F", "h", "j"]
