"""What other installed packages add to unjam through entry points of their metadata.

The groups, with what an entry point of each names:

- `unjam.commands`: `NAME = "module:function"`, the function of the command `unjam NAME`, with typer's annotations.
- `unjam.presets`: `NAME = "module:mapping"`, changes to the run configuration by the name of the preset.

The studies of the paper (`unjam_paper`) are such a package. Its metadata is that of unjam itself.
"""

import logging
from importlib.metadata import entry_points
from typing import Any, Literal

_LOGGER = logging.getLogger(__name__)

PluginGroup = Literal["unjam.commands", "unjam.presets"]


def plugin_names(group: PluginGroup) -> list[str]:
    """Return the names of the entry points of a group, sorted; none of them is imported."""
    return sorted({point.name for point in entry_points(group=group)})


def load_plugins(group: PluginGroup, *names: str) -> dict[str, Any]:
    """Return the objects of a group by name, all or `names`; a broken one is left out, with a warning."""
    loaded: dict[str, Any] = {}
    for point in sorted(entry_points(group=group)):
        if not names or point.name in names:
            try:
                loaded[point.name] = point.load()
            except (ImportError, AttributeError) as error:
                _LOGGER.warning("the plugin %s (%s) cannot be loaded: %s", point.name, point.value, error)
    return loaded
