"""Thread safety of environments: one call at a time."""

from collections.abc import Callable
from functools import wraps
from threading import RLock
from typing import Concatenate, ParamSpec, Self, TypeVar

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")


class CopyableLock:
    """A reentrant lock; copies of its owner get their own."""

    def __init__(self) -> None:
        self.held = RLock()

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        return type(self), ()


def synchronized(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Return a method of an environment in which a second thread waits until the first has returned."""

    @wraps(method)
    def call(self: S, /, *arguments: P.args, **keywords: P.kwargs) -> T:
        with self._road.lock.held:  # pyright: ignore[reportAttributeAccessIssue]
            return method(self, *arguments, **keywords)

    return call
