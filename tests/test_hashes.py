"""What is installed by hash: the versions that were tested, all of them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def pinned_hashes(file: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / file).read_text(), flags=re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_all_tested_versions_have_hashes() -> None:
    assert pinned_hashes("hashes/all.txt") == pinned_hashes("constraints.txt")


def test_core_packages_are_installed_by_hash_in_the_tested_versions() -> None:
    tested, core = pinned_hashes("constraints.txt"), pinned_hashes("hashes/core.txt")
    assert core.pop("colorama")  # on Windows alone, where nothing was tested
    assert core.items() <= tested.items()
    assert {"libsumo", "numpy", "typer", "safetensors"} <= core.keys()
    assert "torch" not in core


@pytest.mark.parametrize("file", ["core", "all"])
def test_every_pin_is_followed_by_its_hashes(file: str) -> None:
    blocks = re.split(r"^(?=[\w.-]+==)", (ROOT / "hashes" / f"{file}.txt").read_text(), flags=re.MULTILINE)
    for block in blocks[1:]:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", block), block
