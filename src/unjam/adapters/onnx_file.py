"""ONNX files of third parties as drivers, with a description of inputs and outputs in TOML.

The description is in a file next to the graph (`policy.toml` for `policy.onnx`), or in the metadata of the graph.
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
DESCRIPTION_KEY = "unjam"  # key of the description in the metadata of a graph
MAX_DESCRIPTION_BYTES = 2**20


def onnx_driver(
    file: Path | str,
    description: PolicyDescription | None = None,
    expert: DriverLike | None = None,
    time_step: float = 0.1,
) -> OnnxDriver:
    """Return the driver of an ONNX graph, which onnxruntime runs; workers and controller files contain it as data.

    Args:
        file: the graph (.onnx), or its description (.toml).
        description: description of inputs and outputs; None: from the file next to the graph, or from its metadata.
        expert: driver to which the accelerations are added; None: the expert of the description, if there is one.
        time_step: control step of the road [s].

    Raises:
        InputError: a file is missing, the graph is not pure arithmetic, or the graph does not fit its description.
        MissingPartError: onnx or onnxruntime is not installed.
    """
    path = Path(file)
    if description is None:
        graph, table = _read_graph_and_description(path)
    else:
        graph, table = _read_file(path, MAX_MODEL_BYTES), {}
    with prefix_errors(f"driver {path.name}: "):
        expert_name = table.pop("expert", Constant.name)
        if not isinstance(expert_name, str) or split_parameters(expert_name)[0] not in DRIVERS:
            raise unknown_name("expert", expert_name, DRIVERS)
        described_expert = driver_from_name(expert_name, time_step)
        expert_driver = described_expert if expert is None else as_driver(expert, time_step)
        if description is None:
            description = build_dataclass(PolicyDescription, table, "")
        return OnnxDriver(path.name, description, expert_driver, time_step, graph=np.frombuffer(graph, np.uint8))


def _read_graph_and_description(path: Path) -> tuple[bytes, dict[str, Any]]:
    description_file = path.with_suffix(DESCRIPTION_SUFFIX)
    if os.path.lexists(description_file):
        table = _parse_description(_read_file(description_file, MAX_DESCRIPTION_BYTES), description_file.name)
        name = table.pop("graph", path.with_suffix(GRAPH_SUFFIX).name)
        if not isinstance(name, str) or Path(name).name != name or not name.endswith(GRAPH_SUFFIX):
            allowed = f"the name of a file in its folder that ends in {GRAPH_SUFFIX}"
            raise invalid_value(f"driver {description_file.name}: graph", name, allowed)
        if path.suffix == GRAPH_SUFFIX and path.name != name:
            raise invalid_value(f"driver {description_file.name}: graph", name, f"{path.name}, which was given")
        return _read_file(path.with_name(name), MAX_MODEL_BYTES), table
    graph = _read_file(path, MAX_MODEL_BYTES)
    with prefix_errors(f"driver {path.name}: "):
        metadata = {entry.key: entry.value for entry in parse_model(graph).metadata_props}
    if DESCRIPTION_KEY not in metadata:
        needed = f"{description_file.name}, with the inputs and the output of the graph"
        raise InputError(f"driver {path.name}: its description is missing; needed: {needed}")
    return graph, _parse_description(metadata[DESCRIPTION_KEY].encode(), path.name)


def _read_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of a file; raise `InputError` if it is no regular file, cannot be read, or is too large."""
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
        raise InputError(f"driver {path.name}: more than {max_bytes:,} bytes are not allowed; allowed: a smaller file")
    return content


def _parse_description(content: bytes, name: str) -> dict[str, Any]:
    try:
        return parse_toml(content.decode())
    except (ValueError, RecursionError) as error:
        raise InputError(f"driver {name}: not TOML: {to_one_line(error)}") from None
