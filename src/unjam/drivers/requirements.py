"""Requirements of drivers, and what roads provide."""

from functools import reduce
from operator import or_
from typing import NamedTuple

from unjam.drivers.local_state import COMMON_FIELDS, LocalState

STEP_TOLERANCE = 1e-9
"""difference up to which control steps count as equal [s]"""


class RoadInterface(NamedTuple):
    """What a road provides to drivers."""

    title: str
    is_closed: bool
    has_route_position: bool
    """whether vehicles have a position along the road"""
    provided_fields: frozenset[str]
    """optional fields of a `LocalState`"""
    control_step: float
    """time between two commands [s]"""


class Requirements(NamedTuple):
    """Requirements of a driver; `merge_requirements` combines the requirements of several drivers."""

    required_fields: frozenset[str] = frozenset()
    """optional fields of `LocalState` without which it cannot drive"""
    used_fields: frozenset[str] = frozenset()
    """optional fields that it reads on roads that provide them"""
    reads_any_field: bool = False
    """whether it may read any field: the user's code determines the fields"""
    needs_loop: bool = False
    """whether it needs a closed road"""
    needs_coordinate: bool = False
    """whether it needs positions along the road"""
    time_steps: frozenset[float] = frozenset()
    """control steps that its formulas assume [s]; empty: any"""
    needs_arrays: bool = False
    """whether it needs arrays; otherwise it also takes plain floats for a single CAV (memory: `scalar_memory`) and
    returns a float, which is several times faster than arrays of one row"""
    needs_numpy: bool = False
    """whether its arrays must be NumPy arrays; otherwise it also takes torch tensors, as in a learned model"""

    @property
    def input_fields(self) -> tuple[str, ...]:
        """Fields of `LocalState` that the driver reads, in order, without those that only the user's code knows."""
        names = {*COMMON_FIELDS, *self.required_fields, *self.used_fields}
        return tuple(name for name in LocalState._fields if name in names)

    @property
    def measured_fields(self) -> frozenset[str]:
        """Fields of `LocalState` that a road must measure if it provides them."""
        return frozenset(LocalState._fields if self.reads_any_field else self.input_fields)

    def unmet_reason(self, road: RoadInterface) -> str:
        """Return why a road does not meet these requirements; empty if it does."""
        if self.needs_loop and not road.is_closed:
            return "it needs a closed road"
        if missing := sorted(self.required_fields - road.provided_fields):
            return f"it needs {', '.join(missing)}"
        if self.needs_coordinate and not road.has_route_position:
            return "it needs positions along the road"
        if other_steps := self.other_time_steps(road.control_step):
            return f"its time_step is {other_steps[0]:g} s; allowed: {road.control_step:g} s, the control step"
        return ""

    def other_time_steps(self, control_step: float) -> list[float]:
        """Return the assumed control steps that differ from `control_step` [s], in ascending order."""
        return [step for step in sorted(self.time_steps) if abs(step - control_step) > STEP_TOLERANCE]


NO_REQUIREMENTS = Requirements()


def merge_requirements(*requirements: Requirements) -> Requirements:
    """Return requirements that contain all of the given ones."""
    return Requirements(*(reduce(or_, values) for values in zip(NO_REQUIREMENTS, *requirements, strict=True)))
