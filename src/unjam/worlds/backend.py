"""Backends: simulators that make worlds of scenarios. the package has SUMO and the batch, and users can add others."""

from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, fields
from typing import Protocol, cast

from unjam.drivers.user_driver import FileReference, is_file_reference
from unjam.errors import InputError, unknown_name
from unjam.parameters import is_packaged, replaced_member
from unjam.scenarios.scenario import Scenario
from unjam.worlds.checked_world import CheckedWorld, backend_label, call_backend
from unjam.worlds.road_world import RoadWorld

BACKEND_NAMES = ("sumo", "sumo-gui", "batch")
TEXT_MEMBERS = frozenset({"title", "reward", "description", "limit_description", "notes"})
"""members of a scenario's class that no simulator reads"""


@dataclass(frozen=True)
class WorldOptions:
    """Requests of a driver and of the user of an episode to a world; a backend may ignore those it does not support."""

    measured_fields: Collection[str] = ()
    """names of the optional fields of `LocalState` that the driver reads, such as `lane_speeds`; a world may leave the
    others None, because measuring them takes time"""
    record_details: bool = False
    """whether fuel and, on roads with ends, positions (x, y) are recorded"""
    accepts_floats: bool = False
    """whether a world with a single CAV may give states as floats instead of arrays of shape (1,), which is faster;
    its `is_scalar` is then True"""
    stop_at_contact: bool = True
    """whether contact of a CAV ends an episode on a user's network; on built-in roads it always does"""


DEFAULT_OPTIONS = WorldOptions()


class Backend(Protocol):
    """A simulator that applies or refuses each setting of a scenario, and each member that a user's class replaces.

    A backend with resources to release must be a context manager, too.
    """

    def supports(self, scenario: Scenario) -> str:
        """Return why the backend cannot simulate a scenario; empty if it can. `unread_reason` finds unread settings."""
        ...

    def open(
        self, scenario: Scenario, seed: tuple[int, ...], options: WorldOptions
    ) -> AbstractContextManager[RoadWorld]:
        """Return the context in which the world of one episode exists; all its random numbers come from the seed."""
        ...


BackendLike = str | Backend | type[Backend]
"""a backend, its class, or a name: `sumo`, `sumo-gui` with SUMO's window, `batch`, or `path.py:name` of one of these"""


@contextmanager
def open_backend(backend: BackendLike) -> Iterator[Backend]:
    """Yield a backend; a given object stays open, a backend made from a name or a class is closed at the end."""
    if not isinstance(backend, str | type):
        yield check_backend(backend, type(backend).__name__)
        return
    new_backend = _make_backend(backend)
    with new_backend if isinstance(new_backend, AbstractContextManager) else nullcontext(new_backend):
        yield new_backend


def _make_backend(backend: str | type[Backend]) -> Backend:
    name = backend if isinstance(backend, str) else backend.__name__
    if isinstance(backend, type) or is_file_reference(name):
        source = backend if isinstance(backend, type) else FileReference.parse(name).load_object()
        return check_backend(call_backend(name, source) if isinstance(source, type) else source, name)
    if check_backend_name(name) == "batch":
        from unjam.worlds.batch.backend import BatchBackend

        return BatchBackend()
    from unjam.worlds.sumo.backend import SumoBackend

    return SumoBackend(transport="gui" if name == "sumo-gui" else None)


def check_backend_name(name: str) -> str:
    """Return the name of a backend; raise `InputError` for an unknown name. No file is read."""
    if name not in BACKEND_NAMES and not is_file_reference(name):
        raise unknown_name("backend", name, [*BACKEND_NAMES, "path.py:name"])
    return name


def check_backend(backend: Backend, label: str) -> Backend:
    """Return a backend; raise `InputError` if a method of the protocol is missing."""
    missing = [method for method in ("supports", "open") if not callable(getattr(backend, method, None))]
    if missing:
        raise InputError(f"backend: {label} has no {' and no '.join(f'{method}()' for method in missing)}")
    return backend


@contextmanager
def open_world(
    backend: Backend, scenario: Scenario, seed: tuple[int, ...], options: WorldOptions
) -> Iterator[RoadWorld]:
    """Yield the world of an episode; the world of a user's backend raises `InputError` for invalid values."""
    if is_packaged(type(backend)):  # tested; checks would slow them down
        with backend.open(scenario, seed, options) as world:
            yield world
        return
    label = backend_label(backend)
    context = call_backend(label, backend.open, scenario, seed, options)
    if not isinstance(context, AbstractContextManager):
        allowed = "a context manager, as of contextlib.contextmanager"
        raise InputError(f"backend: {label}: open() returns {type(context).__name__}; allowed: {allowed}")
    with ExitStack() as stack:
        world = call_backend(label, stack.enter_context, context)
        yield cast(RoadWorld, CheckedWorld(world, label, scenario))


def backend_notes(backend: BackendLike, scenario: Scenario) -> list[str]:
    """Return a note on the simulator of a scenario, and how its results compare with SUMO's; no note for SUMO."""
    label = backend_label(backend)
    if label in ("sumo", "sumo-gui"):
        return []
    if label != "batch":
        return [f"simulated by the backend {label}, not by SUMO"]
    from unjam.worlds.batch.support import unsupported_reason

    extent = "in distribution, not in each episode" if unsupported_reason(scenario) else "except for rounding"
    return [f"simulated by the backend batch: equal to SUMO {extent}"]


def unread_reason(scenario: Scenario, kind: type[Scenario], names: Collection[str]) -> str:
    """Return why a backend that reads only the members `names` of a class `kind` cannot simulate a scenario.

    Empty if it can. A `SimulatedRoad` reads `simulation_step`, `horizon`, `action_limit`, `safety`, `actuator` and
    `sensors`, and calls `draw`, which reads the settings of the road and `population`.
    """
    if not isinstance(scenario, kind):
        return f"{scenario.title} is not a {kind.title}"
    if member := replaced_member(type(scenario), kind, TEXT_MEMBERS | set(names)):
        allowed = "classes with other values of settings alone, or backend=sumo"
        return f"{type(scenario).__name__}.{member} is not allowed: the backend does not read it; allowed: {allowed}"
    defaults = kind()
    for name in [field.name for field in fields(kind) if field.name not in names]:
        value, default = getattr(scenario, name), getattr(defaults, name)
        if value != default:
            return f"{name}: {value!r} is not allowed: the backend does not read it; allowed: {default!r}"
    return ""


def check_support(backend: Backend, *scenarios: Scenario) -> None:
    """Raise `InputError` with the reason of a backend that cannot simulate one of the scenarios."""
    label = backend_label(backend)
    for scenario in scenarios:
        reason = call_backend(label, backend.supports, scenario)
        if not isinstance(reason, str):
            allowed = "a reason as text, or '' if the scenario is supported"
            raise InputError(f"backend: {label}: supports() returns {reason!r}; allowed: {allowed}")
        if reason:
            raise InputError(f"scenario: {reason}")
