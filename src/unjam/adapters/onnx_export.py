"""Write a network of torch as an ONNX file that describes its inputs and its output."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomli_w

from unjam.adapters.onnx_file import DESCRIPTION_KEY, GRAPH_SUFFIX
from unjam.drivers.observation import PolicyInput
from unjam.drivers.policy import PolicyOutput
from unjam.errors import import_optional, invalid_value
from unjam.files import atomic_write, check_parent_folder
from unjam.onnx_models import quiet_onnx_export

if TYPE_CHECKING:
    from torch import nn


def write_onnx_policy(
    network: "nn.Module",
    file: Path | str,
    inputs: Sequence[PolicyInput],
    output: PolicyOutput | None = None,
    time_step: float | None = None,
) -> None:
    """Write a network and its description into one file, which `unjam drive -d` and `onnx_driver` read.

    Args:
        network: returns numbers, shape (n,) or (n, 1), for observations in float32, shape (n, inputs).
        file: its name ends in .onnx.
        inputs: quantities in the order of the columns.
        output: the meaning of the numbers; None: accelerations [m/s2].
        time_step: control step of the policy [s]; None: that of the road.

    Raises:
        InputError: the name of the file is not allowed.
        DiskError: its folder does not exist, or the disk is full.
        MissingPartError: torch or onnxscript is not installed.
    """
    path, torch = Path(file), import_optional("torch")
    if path.suffix != GRAPH_SUFFIX:
        raise invalid_value("file", str(file), f"a name that ends in {GRAPH_SUFFIX}")
    import_optional("onnxscript")
    check_parent_folder(path)
    observations, rows = torch.zeros(2, len(inputs), dtype=torch.float32, device="cpu"), torch.export.Dim("rows")
    was_training = network.training
    with torch.no_grad(), quiet_onnx_export():
        program = torch.onnx.export(network.eval(), (observations,), dynamic_shapes=({0: rows},), verbose=False)
    network.train(was_training)
    from onnx_ir.passes import common

    common.ClearMetadataAndDocStringPass()(program.model)  # stack traces have paths of this machine
    graph = program.model_proto
    description = {"inputs": list(map(_as_table, inputs)), "output": _as_table(output or PolicyOutput())}
    description |= {} if time_step is None else {"time_step": time_step}
    graph.metadata_props.add(key=DESCRIPTION_KEY, value=tomli_w.dumps(description))
    atomic_write(path, graph.SerializeToString())


def _as_table(value: PolicyInput | PolicyOutput) -> dict[str, Any]:
    return {name: each for name, each in asdict(value).items() if each is not None}
