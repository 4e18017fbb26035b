"""The user's own drivers and functions: objects of this process, and names in Python files, `path.py:name`.

Such a file is executed as code: use only files that you trust.
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
"""held while a file runs: its modules then have their short names in the global `sys.modules`"""
_modules: dict[tuple[Path, str], ModuleType] = {}
"""modules that run once in a process, by path and hash of their code"""


def is_file_reference(text: str) -> bool:
    """Return whether `text` has the form `path.py:name`."""
    return ".py:" in text


def object_label(candidate: Any) -> str:
    """Return the name of a function or a class; for other objects that of their class."""
    return getattr(candidate, "__name__", type(candidate).__name__)


def object_reference(candidate: Any) -> str:
    """Return `path.py:name` for a function or a class of a Python file; empty if it has no such name."""
    module, name = sys.modules.get(getattr(candidate, "__module__", "")), getattr(candidate, "__qualname__", "")
    path = getattr(module, "__file__", None) or ""
    return f"{path}:{name}" if path.endswith(".py") and getattr(module, name, None) is candidate else ""


@dataclass(frozen=True, eq=False)
class UserFunction:
    """A function of the user; if it fails, one line says where."""

    function: Callable[..., Any]
    label: str
    """name in messages: its own name, or `path.py:name`"""
    file: str = ""
    """path of its code"""

    @classmethod
    def from_object(cls, candidate: Any, argument: str, reference: "FileReference | None" = None) -> "UserFunction":
        """Return a function of `argument`, of this process or a file; raise `InputError` if it is not a function."""
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
    """Return ` (line N)` with the last line of a file that was executed before an error; empty if none was."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == file]
    return f" (line {lines[-1]})" if lines else ""


def _as_numpy_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of arrays; a `torch.nn.Module` gets tensors of its own type and device, with gradients."""
    torch: Any = sys.modules.get("torch")  # it is imported where its modules exist; workers run without it
    module: Any = function
    if torch is None or not isinstance(module, torch.nn.Module):
        return function

    def call(rows: Any) -> Any:
        first = rows[0]
        is_tensor = isinstance(first, torch.Tensor)
        like = next(module.parameters(), first if is_tensor else torch.zeros((), dtype=torch.float32, device="cpu"))

        def as_own(values: Any) -> Any:
            tensor = values if isinstance(values, torch.Tensor) else torch.tensor(values, device="cpu")
            return tensor.to(like) if tensor.is_floating_point() else tensor.to(like.device)

        is_record = hasattr(rows, "_fields")
        own = type(rows)(*(None if row is None else as_own(row) for row in rows)) if is_record else as_own(rows)
        if is_tensor:
            return map_leaves(lambda tensor: tensor.to(first), module(own))
        with torch.no_grad():
            return map_leaves(lambda tensor: tensor.cpu().numpy(), module(own))

    return call


@dataclass(frozen=True)
class FileReference:
    """A name in a Python file."""

    path: Path
    """resolved"""
    name: str
    sha256: str = field(default="", kw_only=True, repr=False, compare=False)
    """hash of the code; if given, the file must have it"""

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
        """Return the code of the file; `InputError` if it is missing, unreadable or not Python, or has another hash."""
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
        """Run the file, from `code` if given, and return the object with the name; raise `InputError` as both parts."""
        return self.find_object(self.run_file(code or self.read_code()))

    def load_object_once(self) -> tuple[Any, "FileReference"]:
        """Return as `load_object`, and the reference with its hash; the same code runs once in a process."""
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
        except (Exception, SystemExit) as error:  # any error of the user's code is the user's to fix
            reason = "" if isinstance(error, InputError) else f"{type(error).__name__} when loading it: "
            raise InputError(f"{self.path.name}: {reason}{error}") from error

    def find_object(self, module: ModuleType) -> Any:
        """Return the object of a module with the name; raise `InputError` if it has none."""
        if not hasattr(module, self.name):
            public = ", ".join(key for key in vars(module) if not key.startswith("_")) or "nothing"
            raise InputError(f"{self.path.name}: has no {self.name!r}; it has: {public}")
        return getattr(module, self.name)


def code_hashes(names: Iterable[str]) -> dict[str, str]:
    """Return the hash of the code of each of the `names` that is `path.py:name`, by path."""
    codes = (FileReference.parse(name).read_code() for name in names if is_file_reference(name))
    return {str(code.path): code.sha256 for code in codes}


class UserDriver(Driver):
    """A user's own driver: `implementation` is any object with `act` and `initial_memory`."""

    implementation: Any

    def requirements(self, road: RoadInterface | None = None) -> Requirements:
        """Return that it may read any field, and the attribute `time_step` of the user's driver."""
        if isinstance(self.implementation, Driver):
            steps = self.implementation.requirements(road).time_steps
        else:
            declared_step = getattr(self.implementation, "time_step", None)
            steps = frozenset({float(declared_step)} if isinstance(declared_step, int | float) else ())
        return self.class_requirements._replace(reads_any_field=True, time_steps=steps)

    def call_user_code(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the result of the user's function."""
        return function(*arguments)

    def _call_method(self, name: str, *arguments: Any) -> Any:
        """Return the result of a method of the user's driver; that of `Driver` if it has no such method."""
        method = getattr(self.implementation, name, None) or getattr(super(), name)
        return self.call_user_code(method, *arguments)

    def initial_memory(self, n: int) -> Memory:
        """Return the initial memory of the user's driver; raise `InputError` if it is none."""
        return check_memory(self._call_method("initial_memory", n), n, f"{self.describe()}: initial_memory({n})")

    def recall(self, memory: Memory, history: LocalState) -> Memory:
        """Return the memory of the user's driver after the warm-up, if it has `recall`."""
        if not hasattr(self.implementation, "recall"):
            return memory
        answer = self._call_method("recall", memory, history)
        return check_memory(answer, len(history.speed), f"{self.describe()}: recall()")

    def act(self, state: LocalState, memory: Memory) -> tuple[Array, Memory]:
        """Return the user's acceleration and memory; raise `InputError` if the user's code fails, or one is invalid."""
        rows, label = np.size(state.speed), self.describe()
        if rows == 0:  # the user's code may need a row: the minimum of an empty array is an error
            return np.zeros(0), memory
        answer = self._call_method("act", state, memory)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise InputError(f"{label}: act() returns {answer!r:.60}; allowed: (accelerations, memory)")
        numbers, new_memory = to_answer_array(answer[0], rows, label), check_memory(answer[1], rows, f"{label}: act()")
        is_single = getattr(answer[0], "dtype", None) == np.float32  # stays so: rows may differ by its rounding
        return numbers.astype(np.float32) if is_single else numbers, new_memory

    def time_gaps(self, state: LocalState, memory: Memory) -> Array | None:
        """Return the time gaps of the user's driver, if it has `time_gaps`."""
        answer, rows = self._call_method("time_gaps", state, memory) if np.size(state.speed) else None, len(state.speed)
        return None if answer is None else to_answer_array(answer, rows, self.describe(), "time gap")

    def memory_features(self, memory: Memory) -> Array | None:
        """Return the memory features of the user's driver, if it has `memory_features`."""
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
        """Return those of the user's driver; a class without `time_step` assumes the argument that it received."""
        requirements = super().requirements(road)
        if requirements.time_steps or not _takes_time_step(type(self.implementation)):
            return requirements
        return requirements._replace(time_steps=frozenset({self.parameters.get("time_step", self.time_step)}))

    def describe(self) -> str:
        """Return the names of file and driver, and the given parameters."""
        return label_with_parameters(str(self), self.parameters)


@dataclass(frozen=True)
class _FunctionImplementation:
    """A plain function `state -> acceleration` with the methods of a driver."""

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
        """Return the name of the function or the class."""
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
    """Return any `DriverLike` as a `Driver`; raise `InputError` if it is none. `time_step` is its control step [s]."""
    if isinstance(driver, str):
        raise invalid_value("driver", driver, f"an object, such as unjam.make_driver({driver!r}, {time_step})")
    name = object_label(driver)
    made = driver if isinstance(driver, Driver) else _make_implementation(driver, time_step, f"driver {name}")
    return made if isinstance(made, Driver) else PythonDriver(made, name)


def _make_implementation(candidate: Any, time_step: float, label: str, parameters: dict[str, Any] | None = None) -> Any:
    """Return an object with `act` and `initial_memory` from one, from a class with `parameters`, or from a function."""
    if inspect.isclass(candidate):
        try:
            steps = {"time_step": time_step} if _takes_time_step(candidate) else {}
            candidate = candidate(**steps | (parameters or {}))
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


def _takes_time_step(kind: type[Any]) -> bool:
    return "time_step" in inspect.signature(kind).parameters
