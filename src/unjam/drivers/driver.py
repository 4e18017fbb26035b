"""The interface of drivers, which decide for their vehicles from observation and memory."""

from array import array
from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, fields, is_dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.local_state import COMMON_FIELDS, LocalState, ScaledInput
from unjam.physics.arrays import Array
from unjam.tree import Arrays, map_leaves

Memory = dict[str, Any]
"""State of a driver between control steps: arrays by name, whose first axis is the row of the CAV. A driver that
contains another driver keeps the memory of that driver within its own."""
Recipe = dict[str, Any]
"""Specification of a driver as JSON; the weights of its networks are stored separately as arrays."""
STEP_TOLERANCE = 1e-9
"""difference up to which control steps are equal [s]"""
NoiseSampler = Callable[[], Array]
"""returns standard normal noise for one evaluation of a network, one number for each row"""


class Decision(NamedTuple):
    """One decision and its components; arrays have a row per CAV, plain numbers have none."""

    command: Command
    expert: Array
    """acceleration of the expert, within the limits [m/s2], shape (n,)"""
    residual: Array
    """acceleration of the network with exploration noise, without limits [m/s2], shape (n,); zero without a network"""
    observation: Array | None
    """network input, shape (n, inputs); empty for a single CAV with a repeated residual; None without a network"""
    memory: Memory
    """memory of the driver after the decision"""


class Driver:
    """Drives any number of CAVs: `(local state, memory) -> (acceleration, memory)`.

    A driver holds parameters only. Everything that changes while driving is in `memory`. Therefore the same
    driver drives n vehicles at once, in the simulator and in a learned model, and can be restarted from any
    step. Rows do not influence each other: n rows at once equal n single calls.

    Your own driver does not need to inherit from this class: `act` and `initial_memory` are enough, and a plain
    function `state -> acceleration` if it needs no memory. `unjam.check_driver` tests it.
    """

    name: ClassVar[str] = ""
    """name for `--driver`; empty for drivers without one"""
    accepts_floats: ClassVar[bool] = False
    """whether `act` also takes a single CAV as plain floats (memory: `scalar_memory`) and returns a float, which is
    several times faster than arrays of one row"""
    accepts_tensors: ClassVar[bool] = False
    """whether `act` also takes torch tensors, as in a learned model; otherwise NumPy arrays are used there, slower"""
    needs_loop: ClassVar[bool] = False
    """whether it needs the position on a closed road"""
    required_fields: ClassVar[tuple[str, ...]] = ()
    """fields of `LocalState` that it reads and that only some roads provide"""
    policy_inputs: ClassVar[tuple[str, ...]] = ()
    """names of the features that its networks read, on any road"""
    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = ()
    """description of `memory_features`, in order"""
    is_native: ClassVar[bool] = False
    """whether the simulator itself drives (a human driver): `act` is then not called"""
    action_repeat: int = 1
    """control steps for which one residual is repeated"""
    episode_noise_size: int = 0
    """count of exploration noise numbers that stay constant for an episode; 0: new noise in each control step"""
    limits: Limits | None = None
    """limits of its own acceleration [m/s2]; None: those of the road"""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `n` CAVs before their first step: NumPy arrays of shape (n, ...)."""
        return {name: inner.initial_memory(n) for name, inner in self.inner_drivers.items()}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if the driver had observed `history` before it took over.

        Called once, after a warm-up. `history` holds arrays of shape (n, steps), oldest first.
        """
        return memory | {name: inner.recall(memory[name], history) for name, inner in self.inner_drivers.items()}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the desired acceleration [m/s2], shape (n,), and the memory after this step.

        The road limits the acceleration. `state` and `memory` are not changed.
        """
        raise NotImplementedError

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision with its components; with `noise`, learned parts explore."""
        acceleration, after = self.act(state, memory)
        return Decision(Command(acceleration, self.time_gaps(state, memory)), acceleration, 0.0, None, after)

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps for the CAVs' own ACCs, as in `Command`."""
        return None

    def observation(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the current network input, (n, inputs), also while a residual is repeated; None without a network."""
        return None

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the part of `memory` that a residual network may read, (n, m), about unit size; None: nothing."""
        return None

    # The description of a driver for the registry, workers and controller files.

    @property
    def inner_drivers(self) -> dict[str, "Driver"]:
        """The drivers that it contains, by the names of their memories, which prefix their networks' weights."""
        return {}

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...] | None:
        """Inputs of its own network, in order; None without a network."""
        return None

    @property
    def input_fields(self) -> tuple[str, ...]:
        """The fields of `LocalState` that it receives."""
        inner = (driver.input_fields for driver in self.inner_drivers.values())
        names = {*COMMON_FIELDS, *self.required_fields}.union(*inner)
        return tuple(name for name in LocalState._fields if name in names)

    @property
    def measured_fields(self) -> frozenset[str]:
        """The fields of `LocalState` that a road must measure for it and for the drivers that it contains."""
        return frozenset(self.input_fields).union(*(inner.measured_fields for inner in self.inner_drivers.values()))

    def active_drivers(self, is_closed: bool, provided_fields: Collection[str]) -> Iterable["Driver"]:
        """Return the inner drivers that can drive on a road; arguments are properties of its `Scenario`."""
        return self.inner_drivers.values()

    def time_steps(self, is_closed: bool, provided_fields: Collection[str]) -> frozenset[float]:
        """Return the control steps [s] that its formulas and those of its active drivers assume; empty: any step."""
        own = getattr(self, "time_step", None)
        inner = self.active_drivers(is_closed, provided_fields)
        assumed = (driver.time_steps(is_closed, provided_fields) for driver in inner)
        return frozenset(() if own is None else (own,)).union(*assumed)

    def describe(self) -> str:
        """Return its name and the parameters that differ from the defaults."""
        if not self.name:
            return type(self).__name__
        default = {field.name: field.default for field in fields(self)}  # pyright: ignore[reportArgumentType]
        parameters = self.recipe()["parameters"]
        changed = {key: value for key, value in parameters.items() if value != default[key] and key != "time_step"}
        return label_with_parameters(self.name, changed)

    def recipe(self) -> Recipe:
        """Return its specification, without `weights`."""
        parameters = asdict(self) if is_dataclass(self) else {}
        own = vars(type(self)).get("name", "")  # not the name of a base class
        return {"kind": "named", "name": own, "parameters": parameters}

    def weights(self) -> Arrays:
        """Return the weights of its networks, with prefixes for those of inner drivers."""
        inner = self.inner_drivers.items()
        return {f"{name}.{key}": array for name, driver in inner for key, array in driver.weights().items()}


class FormulaDriver(Driver):
    """A driver with one formula for arrays, tensors and plain numbers (see `unjam.physics.arrays`)."""

    accepts_floats: ClassVar[bool] = True
    accepts_tensors: ClassVar[bool] = True


def other_time_steps(
    driver: Driver, step: float, is_closed: bool | None = None, provided_fields: Collection[str] = ()
) -> list[float]:
    """Return the control steps [s] that a driver assumes and that differ from `step`, in order.

    The other arguments are those of `Driver.time_steps`; with None for `is_closed`, all roads are regarded.
    """
    kinds = (True, False) if is_closed is None else (is_closed,)
    steps = frozenset[float]().union(*(driver.time_steps(kind, provided_fields) for kind in kinds))
    return sorted(each for each in steps if abs(each - step) > STEP_TOLERANCE)


def label_with_parameters(name: str, parameters: dict[str, Any]) -> str:
    """Return `name:key=value,key=value`; the name alone without parameters."""
    values = ",".join(f"{key}={value}" for key, value in parameters.items())
    return f"{name}:{values}" if values else name


def scalar_memory(memory: Memory) -> Memory:
    """Return the memory of one CAV as plain numbers: floats, and Python's own arrays of floats."""
    return map_leaves(lambda rows: rows[0].item() if rows.ndim == 1 else array("d", rows[0]), memory)


def carry_over_memory(memory: Memory, kept_rows: Any, new_memory: Memory, new_count: int) -> Memory:
    """Return the rows `kept_rows` of `memory`, followed by the last `new_count` rows of `new_memory`."""
    if not new_count:
        return map_leaves(lambda rows: rows[kept_rows], memory)
    return map_leaves(lambda rows, fresh: np.concatenate([rows[kept_rows], fresh[-new_count:]]), memory, new_memory)
