"""Every way to name a driver: by name, by file, by run, or several at once."""

import re
from pathlib import Path

from unjam.controller.file import SUFFIX, load_controller
from unjam.drivers.driver import Driver
from unjam.drivers.from_file import is_file_reference
from unjam.drivers.mixed import Mixed
from unjam.drivers.registry import DRIVERS, named_driver

_SEVERAL = re.compile(r"\+(?=[^\W\d]|[./~])")
"""between two drivers of a mixture; not the + of 1e+5"""


def make_driver(text: str, time_step: float) -> Driver:
    """Return the driver that `text` names.

    Args:
        text: a name (`pi`), with parameters (`pi:time_constant=1,window=30`), your own (`path.py:name`), a
            run folder, or a `.unjam` file; or several of them joined by `+`, for CAVs side by side.
        time_step: time between two decisions of the road [s].

    Raises:
        InputError: there is no such driver, or a parameter is wrong.
    """
    path = Path(text)
    parts = [] if path.exists() else _SEVERAL.split(text)
    if len(parts) > 1:
        return Mixed(tuple(make_driver(part, time_step) for part in parts))
    named = text.partition(":")[0] in DRIVERS or is_file_reference(text)
    if not named and (text.endswith(SUFFIX) or path.is_dir()):
        return load_controller(path)
    return named_driver(text, time_step)
