"""The interface of drivers, which compute commands of vehicles from their observations and memories."""

from array import array
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.local_state import LocalState, ScaledInput
from unjam.drivers.requirements import NO_REQUIREMENTS, Requirements, RoadInterface, merge_requirements
from unjam.errors import InputError
from unjam.parameters import Subclassable
from unjam.physics.arrays import Array, replace_entries
from unjam.tree import leaves, map_leaves, named_parts

Memory = dict[str, Any]
"""state of a driver between control steps: arrays by name, with one row for each CAV; a driver that contains another
driver also stores the memory of that driver, as a dict"""
Recipe = dict[str, Any]
"""specification of a driver as JSON, with its class as `kind`; the weights of its networks are separate arrays"""
NoiseSampler = Callable[[], Array]
"""function that returns standard normal noise for one evaluation of a network, one number for each row"""


class Decision(NamedTuple):
    """A decision of a driver and its components: arrays with a row for each CAV, or plain numbers for a single CAV."""

    command: Command
    expert: Array
    """acceleration of the expert, within the limits [m/s2], shape (n,)"""
    residual: Array
    """acceleration of the network with exploration noise, without limits [m/s2], shape (n,); zero without a network"""
    observation: Array | None
    """network input, shape (n, inputs); an empty tuple while a single CAV repeats a residual; None without a network"""
    memory: Memory
    """memory of the driver after the decision"""


class Driver(Subclassable):
    """Drives any number of CAVs: `(local state, memory) -> (acceleration, memory)`.

    A driver contains only parameters; `memory` contains everything that changes while it drives. Therefore the same
    driver drives n vehicles at once, in the simulator and in a learned model, and can be restarted from any
    step. Rows do not influence each other: n rows at once equal n single calls.

    Your own driver does not need to inherit from this class: an object with `act` and `initial_memory` is enough, or,
    without a memory, a function `state -> acceleration`. `unjam.check_driver` tests it.
    """

    name: ClassVar[str] = ""
    """name for `--driver`; empty for drivers without one"""
    class_requirements: ClassVar[Requirements] = Requirements(needs_arrays=True, needs_numpy=True)
    """requirements of the class, without those of drivers that an object contains"""
    class_memory_inputs: ClassVar[tuple[ScaledInput, ...]] = ()
    """descriptions of the columns of `memory_features`, in order, without those of inner drivers"""
    portable_form: ClassVar[str] = "path.py:name, your class in a file"
    """what messages recommend in place of a driver of this class that other processes cannot build"""
    is_driven_by_simulator: ClassVar[bool] = False
    """whether the simulator drives the vehicle, as a human driver, and does not call `act`"""
    action_repeat: int = 1
    """control steps for which one residual is repeated"""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `n` CAVs before their first step: NumPy arrays of shape (n, ...)."""
        return {name: inner.initial_memory(n) for name, inner in self.inner_drivers.items()}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if the driver had observed `history`, a warm-up of shape (n, steps), oldest first."""
        return memory | {name: inner.recall(memory[name], history) for name, inner in self.inner_drivers.items()}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the desired acceleration [m/s2], shape (n,), and the memory after this step, as a new object."""
        raise NotImplementedError

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision with its components; networks explore with `noise`."""
        acceleration, new_memory = self.act(state, memory)
        return Decision(Command(acceleration, self.time_gaps(state, memory)), acceleration, 0.0, None, new_memory)

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps for the CAVs' own ACCs, as in `Command`."""
        return None

    def observation(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the current network input, (n, inputs), also while a residual is repeated; None without a network."""
        return None

    def memory_features(self, memory: Memory) -> Array | None:
        """Return what a residual network may read of `memory`, shape (n, m), about unit size; None: nothing."""
        return None

    # The description of a driver for the registry, workers and controller files.

    @cached_property
    def inner_drivers(self) -> dict[str, "Driver"]:
        """Drivers that this one contains, by the keys of their memories, which also prefix the names of weights."""
        return {}

    @cached_property
    def limits(self) -> Limits | None:
        """Limits of the driver's acceleration [m/s2]; None: those of the road."""
        return None

    @property
    def episode_noise_size(self) -> int:
        """Number of exploration noise values that are constant in an episode; 0: new noise in each control step."""
        return 0

    @property
    def memory_inputs(self) -> tuple[ScaledInput, ...]:
        """Descriptions of the columns of `memory_features`, in order."""
        return self.class_memory_inputs

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...] | None:
        """Descriptions of the inputs of the driver's network, in order; None without a network."""
        return None

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return the requirements of this driver, with its `time_step`, and of its active drivers on `road`."""
        step = getattr(self, "time_step", None)
        requirements = self.class_requirements._replace(time_steps=frozenset(() if step is None else (step,)))
        return merge_requirements(requirements, *(driver.requirements(road) for driver in self.active_drivers(road)))

    def active_drivers(self, road: RoadInterface | None) -> Iterable["Driver"]:
        """Return the inner drivers that drive on `road`; on some road if `road` is None."""
        return self.inner_drivers.values()

    def describe(self) -> str:
        """Return the name of the driver, and its parameters that differ from the defaults."""
        if not self.name:
            return type(self).__name__
        parameters = (named_parts(self) or {}).items()
        changes = {key: value for key, value in parameters if value != getattr(type(self), key) and key != "time_step"}
        return label_with_parameters(self.name, changes)


class FormulaDriver(Driver):
    """A driver with a formula that takes arrays, tensors and plain numbers (see `unjam.physics.arrays`)."""

    class_requirements: ClassVar[Requirements] = NO_REQUIREMENTS


def check_memory(memory: Any, rows: int, context: str) -> Memory:
    """Return `memory`; raise `InputError` unless it is a dict of arrays with one row for each of `rows` CAVs."""
    if not isinstance(memory, dict):
        raise InputError(f"{context} returns the memory {memory!r:.60}; allowed: a dict of arrays")
    for name, values in leaves(memory):
        if (shape := getattr(values, "shape", ()))[:1] != (rows,):
            answer_text = f"an array of shape {shape}" if shape else f"{values!r:.60}"
            allowed = f"allowed: arrays of shape ({rows}, ...), one row for each CAV"
            raise InputError(f"{context} returns {answer_text} as {name!r} of the memory; {allowed}")
    return memory


def label_with_parameters(name: str, parameters: dict[str, Any]) -> str:
    """Return `name:key=value,key=value`, or `name` without parameters."""
    values = ",".join(f"{key}={value}" for key, value in parameters.items())
    return f"{name}:{values}" if values else name


def scalar_memory(memory: Memory) -> Memory:
    """Return the memory of one CAV as floats, and as `array.array` where it has several numbers."""
    return map_leaves(lambda rows: rows[0].item() if rows.ndim == 1 else array("d", rows[0]), memory)


def replace_memory_rows(memory: Memory, rows: Any, source: Memory, source_rows: Any) -> Memory:
    """Return `memory` with `source_rows` of `source`, a memory of the same driver, in place of its `rows`."""

    def replace_rows(target_array: Any, source_array: Any) -> Any:
        if hasattr(target_array, "replace_rows"):  # a window of speeds
            return target_array.replace_rows(rows, source_array, source_rows)
        return replace_entries(target_array, rows, source_array, source_rows)

    return map_leaves(replace_rows, memory, source)


def carry_over_memory(memory: Memory, remaining_rows: Any, new_memory: Memory, new_count: int) -> Memory:
    """Return the rows `remaining_rows` of `memory`, followed by the last `new_count` rows of `new_memory`."""
    if not new_count:
        return map_leaves(lambda rows: rows[remaining_rows], memory)
    return map_leaves(
        lambda rows, new_rows: np.concatenate([rows[remaining_rows], new_rows[-new_count:]]), memory, new_memory
    )
