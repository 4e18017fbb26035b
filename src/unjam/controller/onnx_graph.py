"""A complete controller as an ONNX graph: from state and memory to acceleration and memory."""

from collections.abc import Callable
from functools import partial
from math import nan
from typing import Any

import numpy as np
import tomli_w
import torch
from torch import Tensor, nn

from unjam.adapters.onnx_file import DESCRIPTION_KEY
from unjam.controller.manifest import driver_interface, graph_names
from unjam.controller.verify import ONNX_OPSET
from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver
from unjam.drivers.local_state import LocalState, state_of_ones
from unjam.drivers.speed_history import CircularWindow
from unjam.errors import InputError, import_optional
from unjam.onnx_models import EXPORT_NOTE, parse_model, quiet_onnx_export
from unjam.tree import leaves, replace_leaves


class ControllerModule(nn.Module):
    """A driver and the limit of its acceleration as a pure function of tensors, in the order of the graph."""

    def __init__(self, driver: Driver, action_limit: float) -> None:
        super().__init__()
        self.driver = driver
        self.limits = Limits.symmetric(action_limit)
        self.initial_memory = driver.initial_memory(1)
        self.field_names = driver.requirements().input_fields
        self.memory_names = [name for name, _ in leaves(self.initial_memory)]

    def forward(self, *arrays: Tensor) -> tuple[Tensor, ...]:
        """Return the acceleration [m/s2] and the new memory, for state and memory in `arrays`."""
        names = self.field_names
        state = LocalState(**dict(zip(names, arrays[: len(names)], strict=True)))
        memory: dict[str, Any] = dict(zip(self.memory_names, arrays[len(names) :], strict=True))
        for name in self.memory_names:
            if name.rpartition(".")[2] == "window":  # a graph can contain only this form of windows
                memory[name] = CircularWindow(memory[name], memory[f"{name.removesuffix('window')}count"])
        acceleration, new_memory = self.driver.act(state, replace_leaves(self.initial_memory, memory))
        values = dict(leaves(new_memory))
        ordered_values = (values[name] for name in self.memory_names)
        tensors = (value.rows if isinstance(value, CircularWindow) else value.clone() for value in ordered_values)
        return self.limits.clip(acceleration), *tensors


def _float64_constant() -> Callable[..., Any]:
    """Return a function that adds a plain number to the graph in float64; onnxscript's own one uses float32."""
    operators = import_optional("onnxscript").opset20
    import onnx_ir  # a dependency of onnxscript

    def add_constant(value: float, dtype: int = onnx_ir.DataType.DOUBLE, **_: Any) -> Any:
        array = np.asarray(value, onnx_ir.DataType(dtype).numpy())
        return operators.Constant(value=onnx_ir.tensor(array))  # pyright: ignore[reportArgumentType]

    return add_constant


def onnx_graph(driver: Driver, action_limit: float) -> bytes:
    """Return the ONNX graph of a driver with its acceleration clipped to `action_limit` [m/s2], in float64.

    Inputs are the fields of `LocalState`, and `memory.NAME` for each entry of the memory; outputs are `acceleration`
    and `next.NAME`. All of them have one row for each CAV. Raise `InputError` if the driver does not consist of
    formulas for torch, and `MissingPartError` if onnxscript is not installed.
    """
    if driver.requirements().needs_numpy or driver.is_driven_by_simulator:
        raise InputError(f"onnx: {driver.describe()} is not allowed; allowed: drivers that run on tensors")
    translations = {torch.ops.aten.scalar_tensor.default: _float64_constant()}
    inputs, outputs = graph_names(driver)
    example_rows = 2  # the exported graph takes any number of rows
    tensor_options: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}  # torch may have other defaults
    state = state_of_ones(driver.requirements().input_fields, partial(torch.ones, **tensor_options), example_rows)
    memory = driver.initial_memory(example_rows)
    examples = [tensor for tensor in state if tensor is not None]
    examples += [torch.as_tensor(array, **tensor_options) for _, array in leaves(memory)]
    if driver.time_gaps(state, memory) is not None:
        raise InputError(f"onnx: {driver.describe()} is not allowed: a graph cannot command time gaps")
    options: dict[str, Any] = {"input_names": inputs, "output_names": outputs, "custom_translation_table": translations}
    rows = torch.export.Dim("cavs")
    options |= {"dynamic_shapes": (tuple({0: rows} for _ in examples),), "opset_version": ONNX_OPSET}
    module = ControllerModule(driver, action_limit).eval()
    with torch.no_grad(), quiet_onnx_export():
        program: Any = torch.onnx.export(module, tuple(examples), dynamo=True, optimize=False, verbose=False, **options)
    _simplify_graph(program.model)
    proto = program.model_proto
    for value_info in (*proto.graph.input, *proto.graph.output, *proto.graph.value_info):
        value_info.ClearField("metadata_props")  # `ClearMetadataAndDocStringPass` clears only metadata of nodes
    return proto.SerializeToString()


def describe_graph(part: bytes, driver: Driver, action_limit: float, time_step: float) -> bytes:
    """Return a graph with units, and with a description for `unjam.adapters.onnx_driver`; `time_step` is in seconds."""
    interface, requirements = driver_interface(driver, action_limit), driver.requirements()
    action, memory = interface["action"], {entry["name"]: entry["initial"] for entry in interface["memory"]}
    is_required = {"loop_length": requirements.needs_loop, "route_position": requirements.needs_coordinate}
    names = [entry["name"] for entry in interface["observation"]]
    description = {
        "inputs": [{"quantity": name} | ({} if is_required.get(name, True) else {"optional": True}) for name in names],
        "output": {"tensor": action["name"], "limits": [float(action["low"]), float(action["high"])]},
        "time_step": time_step,
        "memory": [
            {"input": f"memory.{name}", "output": f"next.{name}", "initial": nan if initial is None else initial}
            for name, initial in memory.items()
        ],
    }
    model = parse_model(part)
    model.doc_string = f"{driver.describe()}: a control step of {time_step:g} s; {EXPORT_NOTE}"
    model.metadata_props.add(key=DESCRIPTION_KEY, value=tomli_w.dumps(description))
    units = {entry["name"]: entry["unit"] for entry in (*interface["observation"], action)}
    memory_text = "state, given back in the next control step; initial values are in the metadata"
    for value_info in (*model.graph.input, *model.graph.output):
        value_info.doc_string = f"[{units[value_info.name]}]" if value_info.name in units else memory_text
    return model.SerializeToString()


def _simplify_graph(model: Any) -> None:
    """Fold constants, and remove file paths; torch's own optimizer breaks graphs with nested clips."""
    from onnx_ir.passes import common
    from onnxscript import optimizer

    optimizer.fold_constants(model)
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(model)
    common.CommonSubexpressionEliminationPass()(model)
    common.RemoveUnusedNodesPass()(model)
    common.ClearMetadataAndDocStringPass()(model)
