"""CLAIMS.md is what its generator makes of the results."""

import sys
from importlib import import_module

import pytest

from tests.system.conftest import ROOT


def test_the_page_of_claims_is_that_of_the_results(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    for name in ("claims", "studies", "tables", "people"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    claims = import_module("claims")
    assert (ROOT / "CLAIMS.md").read_text() == claims.page_text(), "run: python docs/claims.py"
    assert len(claims.claims_table()) == len(claims.CLAIMS) + len(claims.people_claims())
