"""How SUMO is reached: the only module that imports libsumo or traci; and records of what it answers."""

import importlib
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Any, Literal, NamedTuple

from unjam.errors import MissingPartError

Backend = Literal["libsumo", "traci", "gui"]
"""`libsumo`: in this process; `traci`: SUMO as a child process; `gui`: the same, with its window."""


class Neighbours(NamedTuple):
    """Who is ahead of a vehicle and behind it [m/s, m from bumper to bumper]; no name: nobody is ahead."""

    leader: str
    leader_speed: float
    leader_gap: float
    follower_speed: float
    follower_gap: float


class NetworkLane(NamedTuple):
    """A lane of a network that is no junction's: its edge, its length [m], what it allows [m/s]."""

    name: str
    edge: str
    length: float
    speed: float
    leads_to: tuple[str, ...]
    """lanes of the next edges"""


def close(sumo: Any) -> None:
    """End a simulation; one that is gone already is no error."""
    with suppress(Exception):
        sumo.close()


def function_of(sumo: Any, domain: str, name: str) -> Callable[..., Any]:
    """Return a function of libsumo or traci; of libsumo the compiled one, without its Python wrapper.

    The wrapper only passes its arguments on, and is a third of the cost of a call.
    """
    compiled = getattr(getattr(sumo, "libsumo", None), "_libsumo", None)
    wrapped = sumo.simulationStep if name == "step" else getattr(getattr(sumo, domain), name)
    return getattr(compiled, f"{domain}_{name}", wrapped)


def library(backend: Backend) -> ModuleType:
    """Return the library of a backend; raise `MissingPartError` where it is not installed."""
    name = "libsumo" if backend == "libsumo" else "traci"
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingPartError(
            f"{name} cannot be imported ({error}); install it: pip install {name}==1.28.0"
        ) from None
