"""Drivers and rewards in the user's own Python file, given as `path.py:name`.

Such a file is code and is run as such: use only files that you trust.
"""

import importlib.util
import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from traceback import extract_tb
from typing import Any

import numpy as np

from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import LocalState
from unjam.errors import InputError
from unjam.physics.arrays import Array


def is_file_reference(text: str) -> bool:
    """Return whether `text` has the form `path.py:name`."""
    return ".py:" in text


def load_object(path: Path, name: str) -> Any:
    """Return the object `name` of the Python file at `path`, running the file.

    Raises:
        InputError: the file is missing or fails when run, or has no such name.
    """
    path = path.resolve()
    if not path.is_file():
        raise InputError(f"driver file: {str(path)!r} is not a file")
    module_name = f"unjam_user_{path.stem}_{abs(hash(str(path))):x}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"driver file: {str(path)!r} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    sys.path.insert(0, str(path.parent))  # so that the file may import its neighbours
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's code raises is the user's to mend
        raise InputError(f"{path.name}: {type(error).__name__} when loading it: {error}") from error
    finally:
        sys.path.remove(str(path.parent))
    if not hasattr(module, name):
        public = ", ".join(key for key in vars(module) if not key.startswith("_")) or "nothing"
        raise InputError(f"{path.name}: has no {name!r}; it has: {public}")
    return getattr(module, name)


def user_error(error: Exception, path: Path, name: str) -> InputError:
    """Return what went wrong in `name` of the user's file, with the last line of that file that ran."""
    lines = [str(frame.lineno) for frame in extract_tb(error.__traceback__) if frame.filename == str(path)]
    place = f" (line {lines[-1]})" if lines else ""
    return InputError(f"{path.name}:{name}: {type(error).__name__}: {error}{place}")


@dataclass(frozen=True)
class FileDriver(Driver):
    """The driver `name` of the user's file: a function of the state, a class, or an instance of one."""

    path: Path
    name: str
    parameters: dict[str, Any] = field(default_factory=dict)
    time_step: float = 0.1
    inner: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", self.path.resolve())
        object.__setattr__(self, "inner", self._build())

    def _build(self) -> Any:
        found = load_object(self.path, self.name)
        where = f"{self.path.name}:{self.name}"
        if inspect.isclass(found):
            arguments = dict(self.parameters)
            if "time_step" in inspect.signature(found).parameters:
                arguments.setdefault("time_step", self.time_step)
            try:
                found = found(**arguments)
            except Exception as error:
                raise InputError(f"{where}: {type(error).__name__} when made: {error}") from error
        elif self.parameters:
            raise InputError(f"{where}: takes no parameters; only a class does")
        if callable(getattr(found, "act", None)):
            if not callable(getattr(found, "initial_memory", None)):
                raise InputError(f"{where}: has act() but no initial_memory(n)")
            return found
        if callable(found):
            return FunctionDriver(found)
        raise InputError(f"{where}: is neither a function nor a class with act(state, memory)")

    def initial_memory(self, n: int) -> Memory:
        """Return what the user's driver remembers before its first step."""
        return self.inner.initial_memory(n)

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return what the user's driver makes of the warm-up, if it has `recall`."""
        recall = getattr(self.inner, "recall", None)
        return recall(memory, history) if recall else memory

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the user's acceleration and memory; raise `InputError` where the user's code fails.

        While no CAV is on the road it is not asked: the smallest gap of nobody is an error in NumPy.
        """
        if np.size(state.speed) == 0:
            return np.zeros(0), memory
        try:
            return self.inner.act(state, memory)
        except Exception as error:
            raise user_error(error, self.path, self.name) from error

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the user's features of the memory, if the driver has any."""
        features = getattr(self.inner, "memory_features", None)
        return features(memory) if features else None


@dataclass(frozen=True)
class FunctionDriver(Driver):
    """A plain function `state -> acceleration` as a driver."""

    function: Callable[[LocalState], Array]

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the function's acceleration; nothing is remembered."""
        return self.function(state), memory
