"""An ONNX file of a third party as a driver, with a description of its inputs and outputs in TOML: data only.

The description is next to the graph (`policy.toml` for `policy.onnx`), or in the metadata of the graph itself.
"""

import os
import stat
from pathlib import Path
from typing import Any

import numpy as np

from unjam.drivers.car_following import Constant
from unjam.drivers.onnx_policy import OnnxDriver
from unjam.drivers.policy import PolicyDescription
from unjam.drivers.registry import DRIVERS, driver_from_name
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError, invalid_value, prefix_errors, unknown_name
from unjam.folders import open_folder
from unjam.onnx_models import MAX_MODEL_BYTES, parse_model
from unjam.parameters import build_dataclass, parse_toml, split_parameters
from unjam.text import to_one_line

GRAPH_SUFFIX, DESCRIPTION_SUFFIX = ".onnx", ".toml"
DESCRIPTION_KEY = "unjam"  # key of the description among the metadata of a graph
MAX_DESCRIPTION_BYTES = 2**20


def onnx_driver(
    file: Path | str,
    description: PolicyDescription | None = None,
    expert: DriverLike | None = None,
    time_step: float = 0.1,
) -> OnnxDriver:
    """Return the driver of an ONNX graph, which onnxruntime runs; workers and controller files carry it as data.

    Args:
        file: the graph (.onnx), or its description (.toml).
        description: of inputs and outputs; None: that in the file next to the graph, or in its metadata.
        expert: a driver to which the accelerations are added; None: that of the description, if it has one.
        time_step: control step of the road [s].

    Raises:
        InputError: a file is missing, or is not allowed: the graph is not pure arithmetic, or does not fit its
            description.
        MissingPartError: onnx or onnxruntime is not installed.
    """
    path = Path(file)
    content, table = _read_described(path) if description is None else (_read(path, MAX_MODEL_BYTES), {})
    with prefix_errors(f"driver {path.name}: "):
        name = table.pop("expert", Constant.name)
        if not isinstance(name, str) or split_parameters(name)[0] not in DRIVERS:
            raise unknown_name("expert", name, DRIVERS)
        named = driver_from_name(name, time_step)
        inner = named if expert is None else as_driver(expert, time_step)
        if description is None:
            description = build_dataclass(PolicyDescription, table, "")
        return OnnxDriver(path.name, description, inner, time_step, graph=np.frombuffer(content, np.uint8))


def _read_described(path: Path) -> tuple[bytes, dict[str, Any]]:
    description_file = path.with_suffix(DESCRIPTION_SUFFIX)
    if os.path.lexists(description_file):
        table = _parse_description(_read(description_file, MAX_DESCRIPTION_BYTES), description_file.name)
        name = table.pop("graph", path.with_suffix(GRAPH_SUFFIX).name)
        if not isinstance(name, str) or Path(name).name != name or not name.endswith(GRAPH_SUFFIX):
            allowed = f"the name of a file in its folder that ends in {GRAPH_SUFFIX}"
            raise invalid_value(f"driver {description_file.name}: graph", name, allowed)
        if path.suffix == GRAPH_SUFFIX and path.name != name:
            raise invalid_value(f"driver {description_file.name}: graph", name, f"{path.name}, which was given")
        return _read(path.with_name(name), MAX_MODEL_BYTES), table
    content = _read(path, MAX_MODEL_BYTES)
    with prefix_errors(f"driver {path.name}: "):
        texts = {entry.key: entry.value for entry in parse_model(content).metadata_props}
    if DESCRIPTION_KEY not in texts:
        needed = f"{description_file.name}, with the inputs and the output of the graph"
        raise InputError(f"driver {path.name}: its description is missing; needed: {needed}")
    return content, _parse_description(texts[DESCRIPTION_KEY].encode(), path.name)


def _read(path: Path, max_bytes: int) -> bytes:
    if path.is_symlink():
        raise InputError(f"driver {path.name}: a symbolic link is not allowed; allowed: the file itself")
    try:
        with open_folder(path.parent) as folder, open(folder.open(path.name, os.O_RDONLY), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise InputError(f"driver {path.name}: it is not a file")
            content = file.read(max_bytes + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"driver: {str(path)!r}: {reason}") from None
    if len(content) > max_bytes:
        raise InputError(f"driver {path.name}: more than {max_bytes:,} bytes are not allowed; allowed: at most that")
    return content


def _parse_description(content: bytes, name: str) -> dict[str, Any]:
    try:
        return parse_toml(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"driver {name}: not TOML: {to_one_line(error)}") from None
