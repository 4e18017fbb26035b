"""What a driver is."""

from array import array
from typing import Any, ClassVar

from unjam.drivers.local_state import LocalState, Observed
from unjam.physics.arrays import Array

Memory = dict[str, Any]
"""What a driver remembers from one step to the next: arrays whose first axis is the CAV's row."""


class Driver:
    """Drives any number of CAVs: `(what they perceive, memory) -> (acceleration, memory)`.

    A driver holds parameters only. Everything that changes while driving is in `memory`, so that the same
    driver drives n vehicles at once, in the simulator and in the virtual environment, and can be started
    again from any moment. Rows do not influence each other: n rows at once equal n single calls.

    Your own driver need not inherit from this class; `act` and `initial_memory` are enough, and a plain
    function `state -> acceleration` does where nothing is remembered. `unjam.check_driver` tests it.
    """

    plain_numbers: ClassVar[bool] = False
    """True where `act` also takes a single CAV in plain numbers (see `single_row` for its memory): it then
    answers a float, several times faster than with arrays of one row."""

    tensors: ClassVar[bool] = False
    """True where `act` also takes torch tensors, as in the virtual environment; otherwise it is asked there
    through NumPy, which is slower."""

    needs_loop: ClassVar[bool] = False
    """True where it must know its place on a closed road"""

    observed_memory: ClassVar[tuple[Observed, ...]] = ()
    """what `memory_features` are, in order"""

    native: ClassVar[bool] = False
    """True where the simulator itself drives (a human driver): `act` is then not asked."""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `n` CAVs before their first step: NumPy arrays of shape (n, ...)."""
        return {}

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return `memory` as if the driver had watched `history` before it took over.

        Called once, where a warm-up came before. `history` holds arrays of shape (n, steps), oldest first.
        """
        return memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the wanted acceleration [m/s2], shape (n,), and the memory after this step.

        The road clips the acceleration to its action limit. `state` and `memory` are left as they are.
        """
        raise NotImplementedError

    def memory_features(self, memory: Memory) -> Array | None:
        """Return what a residual network may see of `memory`, (n, m), about unit size; None: nothing."""
        return None


def single_row(memory: Memory) -> Memory:
    """Return the memory of one CAV in plain numbers: floats, and Python's own arrays of them."""
    return {
        key: value[0].item() if value.ndim == 1 else array("d", value[0]) for key, value in memory.items()
    }
