"""What a driver is: it decides what its vehicles shall do, from what they perceive and what it remembers."""

from array import array
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from unjam.drivers.command import Command, Limits
from unjam.drivers.local_state import COMMON_FIELDS, LocalState, ScaledInput
from unjam.physics.arrays import Array
from unjam.tree import Arrays, map_leaves

Memory = dict[str, Any]
"""What a driver remembers from one decision to the next: arrays whose first axis is the CAV's row, by name. A
driver that holds another one keeps that one's memory within its own."""

Recipe = dict[str, Any]
"""What a driver is made from, as JSON; the weights of its networks travel beside it as arrays."""

NoiseSampler = Callable[[], Array]
"""answers standard normal noise, one number for each row, for one look of a network"""


class Decision(NamedTuple):
    """One decision, taken apart; every array has a row per CAV, plain numbers have none."""

    command: Command
    """what is asked for"""
    expert: Array
    """the expert's share of the acceleration, within the limits [m/s2], shape (n,)"""
    residual: Array
    """the network's share with its exploration noise, not limited [m/s2], shape (n,); zero without one"""
    observation: Array | None
    """what the network saw, shape (n, inputs); empty for a single CAV whose residual is being held; None
    without a network"""
    memory: Memory
    """after the decision"""


class Driver:
    """Drives any number of CAVs: `(what they perceive, memory) -> (acceleration, memory)`.

    A driver holds parameters only. Everything that changes while driving is in `memory`, so that the same
    driver drives n vehicles at once, in the simulator and in the virtual environment, and can be started
    again from any moment. Rows do not influence each other: n rows at once equal n single calls.

    Your own driver need not inherit from this class; `act` and `initial_memory` are enough, and a plain
    function `state -> acceleration` does where nothing is remembered. `unjam.check_driver` tests it.
    """

    name: ClassVar[str] = ""
    """what `--driver` calls it; empty where it cannot be named"""

    accepts_floats: ClassVar[bool] = False
    """True where `act` also takes a single CAV in plain numbers (see `scalar_memory` for its memory): it then
    answers a float, several times faster than with arrays of one row."""

    accepts_tensors: ClassVar[bool] = False
    """True where `act` also takes torch tensors, as in the virtual environment; otherwise it is asked there
    through NumPy, which is slower."""

    needs_loop: ClassVar[bool] = False
    """True where it must know its place on a closed road"""

    required_fields: ClassVar[tuple[str, ...]] = ()
    """fields of a `LocalState` that it looks at and that only some roads offer"""

    policy_inputs: ClassVar[tuple[str, ...]] = ()
    """features that networks in it see, whatever the road: by name"""

    memory_inputs: ClassVar[tuple[ScaledInput, ...]] = ()
    """what `memory_features` are, in order"""

    is_native: ClassVar[bool] = False
    """True where the simulator itself drives (a human driver): `act` is then not asked."""

    action_repeat: int = 1
    """decisions for which one residual is held"""

    episode_noise_size: int = 0
    """how many numbers it explores with that stay as they are all episode long; 0: a new one each time"""

    limits: Limits | None = None
    """within which it keeps its own acceleration [m/s2]; None: the road does"""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `n` CAVs before their first step: NumPy arrays of shape (n, ...)."""
        return {name: held.initial_memory(n) for name, held in self.inner_drivers.items()}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if the driver had watched `history` before it took over.

        Called once, where a warm-up came before. `history` holds arrays of shape (n, steps), oldest first.
        """
        return memory | {name: held.recall(memory[name], history) for name, held in self.inner_drivers.items()}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the wanted acceleration [m/s2], shape (n,), and the memory after this step.

        The road keeps the acceleration within its limits. `state` and `memory` are left as they are.
        """
        raise NotImplementedError

    def decide(self, state: LocalState, memory: Memory, noise: NoiseSampler | None = None) -> Decision:
        """Return the decision taken apart; with `noise`, what was learned explores."""
        acceleration, after = self.act(state, memory)
        command = Command(acceleration, self.time_gaps(state, memory))
        return Decision(command, acceleration, 0.0, None, after)

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time headways that its cars' own ACCs shall keep now, as a `Command` has them."""
        return None

    def observation(self, state: LocalState, memory: Memory) -> Array | None:
        """Return what a network would see now, (n, inputs), whether or not it is asked; None without one."""
        return None

    def memory_features(self, memory: Memory) -> Array | None:
        """Return what a residual network may see of `memory`, (n, m), about unit size; None: nothing."""
        return None

    # What a driver says of itself: to the registry, to workers, to the file that is shipped.

    @property
    def inner_drivers(self) -> dict[str, "Driver"]:
        """The drivers that it holds, by the names of their memories, which prefix their networks' weights."""
        return {}

    @property
    def network_inputs(self) -> tuple[ScaledInput, ...] | None:
        """What its own network sees, in order; None without one."""
        return None

    @property
    def input_fields(self) -> tuple[str, ...]:
        """The fields of a `LocalState` that it is given."""
        asked = {*COMMON_FIELDS, *self.required_fields}.union(
            *(held.input_fields for held in self.inner_drivers.values())
        )
        return tuple(name for name in LocalState._fields if name in asked)

    @property
    def measured_fields(self) -> frozenset[str]:
        """The fields of a `LocalState` that a road measures for it: what it and those it holds perceive."""
        return frozenset(self.input_fields).union(*(held.measured_fields for held in self.inner_drivers.values()))

    def describe(self) -> str:
        """Return it in a few words: its name and the parameters that differ from the defaults."""
        if not self.name:
            return type(self).__name__
        default = {field.name: field.default for field in fields(self)}  # pyright: ignore[reportArgumentType]
        parameters = self.recipe()["parameters"]
        changed = {key: value for key, value in parameters.items() if value != default[key] and key != "time_step"}
        return label_with_parameters(self.name, changed)

    def recipe(self) -> Recipe:
        """Return what it is made from; its networks' weights are `weights`."""
        parameters = asdict(self) if is_dataclass(self) else {}
        own = vars(type(self)).get("name", "")  # not that of a class which it inherits from
        return {"kind": "named", "name": own, "parameters": parameters}

    def weights(self) -> Arrays:
        """Return the weights of its networks, those of the drivers that it holds with their prefix."""
        return {
            f"{name}.{key}": array for name, held in self.inner_drivers.items() for key, array in held.weights().items()
        }


class FormulaDriver(Driver):
    """A driver that is written once for arrays, tensors and plain numbers (see `unjam.physics.arrays`)."""

    accepts_floats: ClassVar[bool] = True
    accepts_tensors: ClassVar[bool] = True


def label_with_parameters(name: str, parameters: dict[str, Any]) -> str:
    """Return `name:key=value,key=value`; the name alone where there are no parameters."""
    values = ",".join(f"{key}={value}" for key, value in parameters.items())
    return f"{name}:{values}" if values else name


def scalar_memory(memory: Memory) -> Memory:
    """Return the memory of one CAV in plain numbers: floats, and Python's own arrays of them."""
    return map_leaves(lambda rows: rows[0].item() if rows.ndim == 1 else array("d", rows[0]), memory)


def carry_over_memory(memory: Memory, kept_rows: Any, new_memory: Memory, new_count: int) -> Memory:
    """Return the rows `remaining_rows` of a memory and, behind them, the last `new` of `newcomers`."""
    if not new_count:
        return map_leaves(lambda rows: rows[kept_rows], memory)
    return map_leaves(lambda rows, fresh: np.concatenate([rows[kept_rows], fresh[-new_count:]]), memory, new_memory)
