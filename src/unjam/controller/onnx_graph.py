"""A whole controller as an ONNX graph: what is perceived and remembered in, acceleration and memory out."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from unjam.controller.graph import ONNX_OPSET, graph_names, require_package
from unjam.drivers.command import Limits
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState, state_of_ones
from unjam.drivers.speed_history import CircularWindow
from unjam.errors import InputError
from unjam.tree import leaves, replace_leaves

EXAMPLE_ROWS = 2
"""of the example that the graph is drawn from; it takes any number of CAVs"""


class ControllerModule(nn.Module):
    """A driver and the bounds of its action as a pure function of tensors, in the order of the graph."""

    def __init__(self, driver: Driver, action_limit: float) -> None:
        super().__init__()
        self.driver = driver
        self.limits = Limits.symmetric(action_limit)
        self.initial_memory = driver.initial_memory(1)
        self.memory_names = [name for name, _ in leaves(self.initial_memory)]

    def forward(self, *arrays: Tensor) -> tuple[Tensor, ...]:
        """Return the acceleration [m/s2] and what is remembered, for the state and memory `weights`."""
        names = self.driver.input_fields
        count = len(names)
        state = LocalState(**dict(zip(names, arrays[:count], strict=True)))
        memory = _writable_windows(dict(zip(self.memory_names, arrays[count:], strict=True)))
        wanted, after = self.driver.act(state, replace_leaves(self.initial_memory, memory))
        kept = dict(leaves(after))
        rows = (kept[name] for name in self.memory_names)
        rows = (value.rows if isinstance(value, CircularWindow) else value.clone() for value in rows)
        return self.limits.clip(wanted), *rows


def _writable_windows(memory: Memory) -> Memory:
    """Return the memory with each window of speeds in the form that a graph can be drawn of."""
    windows = [name for name in memory if name.rpartition(".")[2] == "window"]
    seen = {name: memory[f"{name.removesuffix('window')}count"] for name in windows}
    return {**memory, **{name: CircularWindow(memory[name], rows) for name, rows in seen.items()}}


def _float64_constant() -> Callable[..., Any]:
    """Return how a plain number enters the graph: onnxscript's own way would cut it to float32.

    Raises:
        MissingPartError: onnxscript is not installed.
    """
    operators = require_package("onnxscript").opset20
    import onnx_ir  # comes with it

    def constant(value: float, dtype: int = onnx_ir.DataType.DOUBLE, **_: Any) -> Any:
        exact = np.asarray(value, onnx_ir.DataType(dtype).numpy())
        return operators.Constant(value=onnx_ir.tensor(exact))  # pyright: ignore[reportArgumentType]

    return constant


def onnx_graph(driver: Driver, action_limit: float) -> bytes:
    """Return the ONNX graph of a driver whose acceleration is clipped to `limit` [m/s2], in float64.

    Inputs are the fields of `LocalState`, and `memory.NAME` for all that it remembers; outputs are
    `acceleration`, and `next.NAME`. The first axis of each is the CAV's row.

    Raises:
        InputError: the driver is not made of formulas that torch can follow.
        MissingPartError: onnxscript is not installed.
    """
    if not driver.accepts_tensors or driver.is_native:
        raise InputError(f"onnx: {driver.describe()} is not allowed; allowed: drivers that run on tensors")
    exact = {torch.ops.aten.scalar_tensor.default: _float64_constant()}
    inputs, outputs = graph_names(driver)
    ones = partial(torch.ones, dtype=torch.float64)
    state = [value for value in state_of_ones(driver.input_fields, ones, EXAMPLE_ROWS) if value is not None]
    memory = (rows for _, rows in leaves(driver.initial_memory(EXAMPLE_ROWS)))
    arrays = (*state, *(torch.as_tensor(value, dtype=torch.float64) for value in memory))
    asks = driver.time_gaps(
        LocalState(**dict(zip(driver.input_fields, state, strict=True))), driver.initial_memory(EXAMPLE_ROWS)
    )
    if asks is not None:
        raise InputError(f"onnx: {driver.describe()} is not allowed: a graph asks for no time headways")
    rows = torch.export.Dim("cavs")
    with torch.no_grad():
        program: Any = torch.onnx.export(
            ControllerModule(driver, action_limit).eval(),
            arrays,
            input_names=inputs,
            output_names=outputs,
            dynamic_shapes=(tuple({0: rows} for _ in arrays),),
            opset_version=ONNX_OPSET,
            dynamo=True,
            optimize=False,
            custom_translation_table=exact,
            verbose=False,
        )
    _simplify(program.model)
    proto = program.model_proto
    for value in (*proto.graph.input, *proto.graph.output, *proto.graph.value_info):
        value.ClearField("metadata_props")  # the pass clears those of nodes alone
    return proto.SerializeToString()


def _simplify(model: Any) -> None:
    """Work out what is constant, and drop what the graph does not need: names of files of this machine too.

    The exporter's own optimiser breaks a graph in which one clip follows another.
    """
    from onnx_ir.passes import common
    from onnxscript import optimizer

    optimizer.fold_constants(model)
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(model)
    common.CommonSubexpressionEliminationPass()(model)
    common.RemoveUnusedNodesPass()(model)
    common.ClearMetadataAndDocStringPass()(model)
