"""The user's own drivers and functions: objects of this process, and names in Python files, `path.py:name`.

unjam executes such a file: use only files that you trust.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import RLock
from traceback import extract_tb
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from unjam.drivers.command import to_answer_array
from unjam.drivers.driver import Driver, Memory, check_memory, label_with_parameters
from unjam.drivers.local_state import LocalState
from unjam.drivers.requirements import Requirements, RoadInterface
from unjam.errors import InputError, invalid_value
from unjam.physics.arrays import Array
from unjam.processes import ForkGuard, redirect_user_output
from unjam.tree import map_leaves
from unjam.trust import check_code_unchanged, remember_trusted, resolve_code_path
from unjam.user_code import UserCode, read_code

_module_lock = RLock()
"""lock while a file runs, because modules next to it then have short names in the global `sys.modules`"""
_modules: dict[tuple[Path, str], ModuleType] = {}
"""modules of files that have run in this process, by path and hash of their code"""


def is_file_reference(text: str) -> bool:
    """Return whether `text` has the form `path.py:name`."""
    return ".py:" in text


def object_label(candidate: Any) -> str:
    """Return the name of a function or a class; for other objects the name of their class."""
    return getattr(candidate, "__name__", type(candidate).__name__)


def object_reference(candidate: Any) -> str:
    """Return `path.py:name` for a function or a class at the top level of a Python file; empty for other objects."""
    module, name = sys.modules.get(getattr(candidate, "__module__", "")), getattr(candidate, "__qualname__", "")
    path = getattr(module, "__file__", None) or ""
    return f"{path}:{name}" if path.endswith(".py") and getattr(module, name, None) is candidate else ""


@dataclass(frozen=True, eq=False)
class UserFunction:
    """A function of the user; its errors become an `InputError` with the line that failed."""

    function: Callable[..., Any]
    label: str
    """name in messages: name of the function, or `path.py:name`"""
    file: str = ""
    """path of the function's code"""

    @classmethod
    def from_object(cls, candidate: Any, argument: str, reference: "FileReference | None" = None) -> "UserFunction":
        """Return a function of this process, or of the file of `reference`; `InputError` if it is not a function."""
        label = str(reference or object_label(candidate))
        if not callable(candidate) or inspect.isclass(candidate):
            raise InputError(f"{label}: is not a function of {argument}")
        code = getattr(candidate, "__code__", None) or getattr(type(candidate).__call__, "__code__", None)
        file = str(reference.path) if reference else getattr(code, "co_filename", "")
        return cls(_as_numpy_function(candidate), label, file)

    def __call__(self, *arguments: Any) -> Any:
        """Return the result of the function; raise `InputError` with its last executed line if it fails."""
        try:
            with ForkGuard():
                return self.function(*arguments)
        except (Exception, SystemExit) as error:
            line = last_line(error, self.file)
            raise InputError(f"{self.label}: {type(error).__name__}: {error}{line}") from error


def last_line(error: BaseException, file: str) -> str:
    """Return ` (line N)` with the last line of a file that ran before an error; empty if no line did."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == file]
    return f" (line {lines[-1]})" if lines else ""


def _as_numpy_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of arrays; for a `torch.nn.Module`, it converts arrays, and tensors with their gradients."""
    torch: Any = sys.modules.get("torch")  # imported already if there are modules; workers run without torch
    module: Any = function
    if torch is None or not isinstance(module, torch.nn.Module):
        return function

    def call_module(argument: Any) -> Any:
        """Return the results for an array, or for a record of arrays."""
        first = argument[0]
        is_tensor = isinstance(first, torch.Tensor)
        like = next(module.parameters(), first if is_tensor else torch.zeros((), dtype=torch.float32, device="cpu"))

        def to_module_tensor(values: Any) -> Any:
            tensor = values if isinstance(values, torch.Tensor) else torch.tensor(values, device="cpu")
            return tensor.to(like) if tensor.is_floating_point() else tensor.to(like.device)

        if hasattr(argument, "_fields"):
            module_argument = type(argument)(
                *(None if values is None else to_module_tensor(values) for values in argument)
            )
        else:
            module_argument = to_module_tensor(argument)
        if is_tensor:
            return map_leaves(lambda tensor: tensor.to(first), module(module_argument))
        with torch.no_grad():
            return map_leaves(lambda tensor: tensor.cpu().numpy(), module(module_argument))

    return call_module


@dataclass(frozen=True)
class FileReference:
    """A reference to an object at the top level of a Python file."""

    path: Path
    """resolved path of the file"""
    name: str
    sha256: str = field(default="", kw_only=True, repr=False, compare=False)
    """hash that the code must have; empty: any code"""

    @classmethod
    def parse(cls, text: str) -> "FileReference":
        """Return the reference for `path.py:name`."""
        if "\0" in text:
            raise InputError(f"Python file: {text!r} is not allowed; allowed: path.py:name")
        path, _, name = text.rpartition(":")
        return cls(resolve_code_path(path), name)

    def __str__(self) -> str:
        return f"{self.path.name}:{self.name}"

    def read_code(self) -> UserCode:
        """Return the code; `InputError` if the file is missing, unreadable or not Python, or has another hash."""
        if not os.path.isfile(self.path):
            raise InputError(f"Python file: {str(self.path)!r} is not a file")
        if self.path.suffix != ".py":
            raise InputError(f"Python file: {str(self.path)!r} is not a Python file")
        try:
            code = read_code(self.path)
        except OSError as error:
            raise InputError(f"Python file: {str(error.filename)!r}: {error.strerror}") from None
        if self.sha256 not in ("", code.sha256):
            raise InputError(f"{self}: its file has changed since; allowed: as it was when it was first loaded")
        return code

    def load_object(self, code: UserCode | None = None) -> Any:
        """Run `code`, or the code of the file, and return the object; `InputError` as `run_file` and `find_object`."""
        return self.find_object(self.run_file(code or self.read_code()))

    def load_object_once(self) -> tuple[Any, "FileReference"]:
        """Return the object as `load_object`, and the reference with the hash; the same code runs once in a process."""
        code = self.read_code()
        key = self.path, code.sha256
        if key not in _modules:
            _modules[key] = self.run_file(code)
        return self.find_object(_modules[key]), replace(self, sha256=code.sha256)

    def run_file(self, code: UserCode) -> ModuleType:
        """Run the code of the file and return its module; raise `InputError` if it fails."""
        check_code_unchanged(code)
        remember_trusted(code.path, code.sha256)  # references in run folders were checked before this call
        try:
            with _module_lock, redirect_user_output():
                return code.run()
        except (Exception, SystemExit) as error:  # the user's code may raise any error
            reason = "" if isinstance(error, InputError) else f"{type(error).__name__} when loading it: "
            raise InputError(f"{self.path.name}: {reason}{error}") from error

    def find_object(self, module: ModuleType) -> Any:
        """Return the object with the name in the module of the file; raise `InputError` if there is none."""
        if not hasattr(module, self.name):
            public_names = ", ".join(key for key in vars(module) if not key.startswith("_")) or "nothing"
            raise InputError(f"{self.path.name}: has no {self.name!r}; it has: {public_names}")
        return getattr(module, self.name)


def code_hashes(names: Iterable[str]) -> dict[str, str]:
    """Return the hashes of the files of all `names` with the form `path.py:name`, by path."""
    codes = (FileReference.parse(name).read_code() for name in names if is_file_reference(name))
    return {str(code.path): code.sha256 for code in codes}


class UserDriver(Driver):
    """A user's own driver: `implementation` is any object with `act` and `initial_memory`."""

    implementation: Any

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return the requirements of the class, all fields as possible inputs, and `time_step` of the user's driver."""
        if isinstance(self.implementation, Driver):
            time_steps = self.implementation.requirements(road).time_steps
        else:
            time_step = getattr(self.implementation, "time_step", None)
            time_steps = frozenset({float(time_step)} if isinstance(time_step, int | float) else ())
        return self.class_requirements._replace(reads_any_field=True, time_steps=time_steps)

    def call_user_code(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of the user's function."""
        return function(*arguments)

    def _call_method(self, name: str, *arguments: Any) -> Any:
        """Return the result of a method of the user's driver, or of `Driver` if the user's driver does not have it."""
        method = getattr(self.implementation, name, None) or getattr(super(), name)
        return self.call_user_code(method, *arguments)

    def initial_memory(self, n: int) -> Memory:
        """Return the initial memory of the user's driver; raise `InputError` as `check_memory`."""
        return check_memory(self._call_method("initial_memory", n), n, f"{self.describe()}: initial_memory({n})")

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return the memory of the user's driver after a warm-up; `memory` if the driver has no method `recall`."""
        if not hasattr(self.implementation, "recall"):
            return memory
        answer = self._call_method("recall", memory, history)
        return check_memory(answer, len(history.speed), f"{self.describe()}: recall()")

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return accelerations, shape (n,), and memory; `InputError` if the code fails, or for other answers."""
        rows, label = np.size(state.speed), self.describe()
        if rows == 0:  # the user's code may fail without rows: an empty array has no minimum
            return np.zeros(0), memory
        answer = self._call_method("act", state, memory)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise InputError(f"{label}: act() returns {answer!r:.60}; allowed: (accelerations, memory)")
        acceleration, new_memory = answer
        array = to_answer_array(acceleration, rows, label)
        check_memory(new_memory, rows, f"{label}: act()")
        # Single precision is kept, because `check_driver` then allows larger differences between rows.
        has_single_precision = getattr(acceleration, "dtype", None) == np.float32
        return array.astype(np.float32) if has_single_precision else array, new_memory

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps of the user's driver; None if it has no method `time_gaps`."""
        answer = self._call_method("time_gaps", state, memory) if np.size(state.speed) else None
        return None if answer is None else to_answer_array(answer, len(state.speed), self.describe(), "time gap")

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the memory features of the user's driver; None if it has no method `memory_features`."""
        return self._call_method("memory_features", memory)


@dataclass(frozen=True)
class FileDriver(FileReference, UserDriver):
    """The driver `name` of a user's file: a function of the state, a class, or an instance of a class."""

    parameters: dict[str, Any] = field(default_factory=dict)
    time_step: float = 0.1
    implementation: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", resolve_code_path(str(self.path)))
        code = self.read_code()
        implementation = _make_implementation(self.load_object(code), self.time_step, str(self), self.parameters)
        object.__setattr__(self, "implementation", implementation)
        object.__setattr__(self, "sha256", code.sha256)

    def call_user_code(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of a function of the file; raise `InputError` with its last executed line if it fails."""
        return UserFunction(function, str(self), str(self.path))(*arguments)

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return the requirements of the user's driver, with the argument `time_step` if it has no such attribute."""
        requirements = super().requirements(road)
        if requirements.time_steps or not _takes_time_step(type(self.implementation)):
            return requirements
        return requirements._replace(time_steps=frozenset({self.parameters.get("time_step", self.time_step)}))

    def describe(self) -> str:
        """Return the names of file and driver, and the parameters."""
        return label_with_parameters(str(self), self.parameters)


@dataclass(frozen=True)
class _FunctionImplementation:
    """An object with the methods of a driver for a function `state -> acceleration`."""

    function: Callable[[LocalState], Array]

    def initial_memory(self, n: int) -> Memory:
        return {}

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        return self.function(state), memory


@dataclass(frozen=True, eq=False)
class PythonDriver(UserDriver):
    """A function or an object of this process as a driver, which other processes cannot build."""

    implementation: Any
    label: str

    def describe(self) -> str:
        """Return the name of the function or class."""
        return self.label


class DriverProtocol(Protocol):
    """The methods that a driver must have, as documented in `unjam.Driver`."""

    def initial_memory(self, n: int) -> Memory:
        """Return the memory of `n` CAVs before their first step."""
        ...

    def act(self, state: LocalState, memory: Memory) -> tuple[Any, Memory]:
        """Return accelerations, and the memory after this step."""
        ...


DriverLike = Driver | DriverProtocol | type[Driver] | type[DriverProtocol] | Callable[[LocalState], Any]
"""a driver, an object with its two required methods, a class of such objects, or a function of the state"""


def as_driver(driver: DriverLike, time_step: float = FileDriver.time_step) -> Driver:
    """Return a `DriverLike` with the control step `time_step` [s] as a `Driver`; raise `InputError` if it is none."""
    if isinstance(driver, str):
        raise invalid_value("driver", driver, f"an object, such as unjam.make_driver({driver!r}, {time_step})")
    if isinstance(driver, Driver):
        return driver
    label = object_label(driver)
    implementation = _make_implementation(driver, time_step, f"driver {label}")
    return implementation if isinstance(implementation, Driver) else PythonDriver(implementation, label)


def _make_implementation(candidate: Any, time_step: float, label: str, parameters: dict[str, Any] | None = None) -> Any:
    """Return an object with `act` and `initial_memory` for an object, a class with `parameters`, or a function."""
    if inspect.isclass(candidate):
        try:
            step_parameter = {"time_step": time_step} if _takes_time_step(candidate) else {}
            candidate = candidate(**step_parameter | (parameters or {}))
        except Exception as error:
            raise InputError(f"{label}: {type(error).__name__} when made: {error}") from error
    elif parameters:
        raise InputError(f"{label}: takes no parameters; only a class does")
    if callable(getattr(candidate, "act", None)):
        if not callable(getattr(candidate, "initial_memory", None)):
            raise InputError(f"{label}: has act() but no initial_memory(n)")
        return candidate
    if callable(candidate):
        return _FunctionImplementation(_as_numpy_function(candidate))
    raise InputError(f"{label}: is neither a function nor a class with act(state, memory)")


def _takes_time_step(driver_class: type[Any]) -> bool:
    return "time_step" in inspect.signature(driver_class).parameters
