"""Export of a torch network as an ONNX file that contains a description of its inputs and output."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from unjam.adapters.onnx_file import DESCRIPTION_KEY, GRAPH_SUFFIX
from unjam.drivers.car_following import Constant
from unjam.drivers.observation import PolicyInput, observation_size
from unjam.drivers.policy import PolicyOutput
from unjam.drivers.registry import driver_from_name
from unjam.errors import InputError, import_optional, invalid_value
from unjam.files import atomic_write, check_parent_folder
from unjam.onnx_models import quiet_onnx_export
from unjam.text import to_one_line

if TYPE_CHECKING:
    from torch import Tensor, nn


def write_onnx_policy(
    network: "nn.Module",
    file: Path | str,
    inputs: Sequence[PolicyInput | str],
    output: PolicyOutput | None = None,
    time_step: float | None = None,
    expert: str = "",
) -> None:
    """Write a network and its description into one file, which `unjam drive -d` and `onnx_driver` read.

    Args:
        network: a network that returns numbers, shape (n,) or (n, 1), for observations in float32, shape (n, inputs).
        file: a path that ends in .onnx.
        inputs: quantities, and names of features, such as `"local"`, in the order of the columns.
        output: the meaning of the numbers; None: accelerations [m/s2].
        time_step: control step of the policy [s]; None: control step of the road.
        expert: name of a driver to which the accelerations are added, such as `"pi"`; empty: no expert.

    Raises:
        InputError: the name of the file is not allowed, or the network does not fit the inputs.
        DiskError: the folder does not exist, or the disk is full.
        MissingPartError: torch or onnxscript is not installed.
    """
    path, torch = Path(file), import_optional("torch")
    if path.suffix != GRAPH_SUFFIX:
        raise invalid_value("file", str(file), f"a name that ends in {GRAPH_SUFFIX}")
    import_optional("onnxscript")
    check_parent_folder(path)
    size = observation_size(inputs, driver_from_name(expert or Constant.name, time_step or 0.1))
    observations, rows = torch.zeros(2, size, dtype=torch.float32, device="cpu"), torch.export.Dim("rows")
    was_training = network.training
    try:
        with torch.no_grad(), quiet_onnx_export():
            _check_shapes(network.eval(), observations)
            program = torch.onnx.export(network, (observations,), dynamic_shapes=({0: rows},), verbose=False)
    finally:
        network.train(was_training)
    from onnx_ir.passes import common

    common.ClearMetadataAndDocStringPass()(program.model)  # stack traces contain paths of this machine
    graph = program.model_proto
    tables = [entry if isinstance(entry, str) else _as_table(entry) for entry in inputs]
    description: dict[str, Any] = {"inputs": tables, "output": _as_table(output or PolicyOutput())}
    description |= {} if time_step is None else {"time_step": time_step}
    description |= {"expert": expert} if expert else {}
    graph.metadata_props.add(key=DESCRIPTION_KEY, value=tomli_w.dumps(description))
    atomic_write(path, graph.SerializeToString())


def _check_shapes(network: "nn.Module", observations: "Tensor") -> None:
    """Raise `InputError` unless a network takes the observations, and returns one number for each row."""
    rows, size = observations.shape
    try:
        shape = tuple(network(observations).shape)
    except (RuntimeError, TypeError, AttributeError, IndexError) as error:
        raise InputError(f"network: it does not take {size} inputs: {to_one_line(error, 120)}") from None
    if shape not in ((rows,), (rows, 1)):
        raise invalid_value(f"network: shape of its output for {rows} rows", shape, f"({rows},), ({rows}, 1)")


def _as_table(record: PolicyInput | PolicyOutput) -> dict[str, Any]:
    return {name: value for name, value in asdict(record).items() if value is not None}
