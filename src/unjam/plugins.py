"""Load commands and presets that other installed packages add to unjam as entry points.

Groups of entry points:

- `unjam.commands`: `NAME = "module:function"`, the function of the command `unjam NAME`, with annotations of typer.
- `unjam.presets`: `NAME = "module:mapping"`, a mapping from names of presets to changes of the run configuration.

The studies of the paper (`unjam_paper`) are such a package, with entry points in the metadata of unjam.
"""

import logging
from importlib.metadata import entry_points
from typing import Any, Literal

_LOGGER = logging.getLogger(__name__)

PluginGroup = Literal["unjam.commands", "unjam.presets"]


def plugin_names(group: PluginGroup) -> list[str]:
    """Return the sorted names of the entry points of a group, without importing them."""
    return sorted({point.name for point in entry_points(group=group)})


def load_plugins(group: PluginGroup, *names: str) -> dict[str, Any]:
    """Return the objects of a group by name, all or only `names`; warn of entry points that cannot be loaded."""
    loaded: dict[str, Any] = {}
    for point in sorted(entry_points(group=group)):
        if not names or point.name in names:
            try:
                loaded[point.name] = point.load()
            except (ImportError, AttributeError) as error:
                _LOGGER.warning("the plugin %s (%s) cannot be loaded: %s", point.name, point.value, error)
    return loaded
