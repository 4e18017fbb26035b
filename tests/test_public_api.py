import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import unjam


@pytest.mark.parametrize("name", unjam.__all__)
def test_each_public_name_exists_and_is_documented(name: str) -> None:
    found = getattr(unjam, name)
    assert found.__name__ == name
    assert len(inspect.getdoc(found) or "") > 20


def test_every_name_that_can_be_imported_is_listed() -> None:
    assert sorted(unjam._LAZY_IMPORTS) == sorted(unjam.__all__)


@pytest.mark.parametrize("name", ["drvie", "Ring", "_drive"])
def test_an_unknown_name_is_an_attribute_error(name: str) -> None:
    with pytest.raises(AttributeError, match=f"module 'unjam' has no attribute '{name}'"):
        getattr(unjam, name)


def test_completion_offers_the_public_names_and_nothing_else() -> None:
    assert set(dir(unjam)) == {*unjam.__all__, "__version__"}


def test_the_package_has_type_information() -> None:
    assert Path(unjam.__file__).with_name("py.typed").is_file()


def test_a_star_import_gives_all_public_names() -> None:
    namespace: dict[str, object] = {}
    exec("from unjam import *", namespace)
    assert set(unjam.__all__) <= namespace.keys()


def test_importing_unjam_imports_nothing_heavy() -> None:
    heavy = {
        "torch",
        "libsumo",
        "matplotlib",
        "pandas",
    }  # the environments are registered with Gymnasium, which needs NumPy
    program = f"import sys, unjam; print(*({heavy!r} & set(sys.modules)))"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=60, check=True)
    assert ran.stdout.strip() == b""


def test_public_functions_have_type_annotations() -> None:
    for name in unjam.__all__:
        found = getattr(unjam, name)
        if inspect.isfunction(found):
            signature = inspect.signature(found)
            untyped = [p.name for p in signature.parameters.values() if p.annotation is p.empty]
            assert not untyped, f"{name}: {untyped}"
            assert signature.return_annotation is not signature.empty, name
