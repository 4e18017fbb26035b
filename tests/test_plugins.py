"""Entry points of installed packages add commands and presets; a broken one does no harm."""

import logging
from importlib.metadata import EntryPoint, EntryPoints

import pytest

from unjam import plugins
from unjam.plugins import load_plugins, plugin_names

GOOD = EntryPoint("good", "math:sqrt", "unjam.commands")
MISSING_MODULE = EntryPoint("missing", "no_such_module:command", "unjam.commands")
MISSING_NAME = EntryPoint("nameless", "math:no_such_name", "unjam.commands")


@pytest.fixture
def installed_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    points = EntryPoints([MISSING_NAME, GOOD, MISSING_MODULE])
    monkeypatch.setattr(plugins, "entry_points", lambda group: points.select(group=group))


@pytest.mark.usefixtures("installed_plugins")
def test_plugins_that_cannot_be_imported_are_left_out_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        loaded = load_plugins("unjam.commands")
    assert list(loaded) == ["good"]
    assert loaded["good"](9.0) == 3.0
    assert "the plugin missing (no_such_module:command) cannot be loaded: No module named" in caplog.text
    assert "the plugin nameless (math:no_such_name) cannot be loaded" in caplog.text
    assert load_plugins("unjam.presets") == {}


@pytest.mark.usefixtures("installed_plugins")
def test_only_the_named_plugins_are_imported(caplog: pytest.LogCaptureFixture) -> None:
    assert list(load_plugins("unjam.commands", "good", "unknown")) == ["good"]
    assert not caplog.records
    assert plugin_names("unjam.commands") == ["good", "missing", "nameless"]


def test_the_studies_of_the_paper_are_a_plugin() -> None:
    assert "reproduce" in plugin_names("unjam.commands")
    assert "paper" in plugin_names("unjam.presets")
