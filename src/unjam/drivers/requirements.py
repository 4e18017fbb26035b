"""What a driver needs of a road, and what a road provides."""

from functools import reduce
from operator import or_
from typing import NamedTuple

from unjam.drivers.local_state import COMMON_FIELDS, LocalState

STEP_TOLERANCE = 1e-9
"""difference up to which control steps are equal [s]"""


class RoadInterface(NamedTuple):
    """What a road provides to drivers."""

    title: str
    is_closed: bool
    has_coordinate: bool
    """whether vehicles have a position along the road"""
    provided_fields: frozenset[str]
    """optional fields of a `LocalState`"""
    control_step: float
    """time between two commands [s]"""


class Requirements(NamedTuple):
    """What a driver needs of its world; `merge_requirements` adds those of several drivers."""

    required_fields: frozenset[str] = frozenset()
    """optional fields of `LocalState` without which it cannot drive"""
    used_fields: frozenset[str] = frozenset()
    """optional fields that it reads on roads that provide them"""
    reads_any_field: bool = False
    """whether it may read any field, because only the user's code determines which"""
    needs_loop: bool = False
    """whether it needs a closed road"""
    needs_coordinate: bool = False
    """whether it needs positions along the road"""
    time_steps: frozenset[float] = frozenset()
    """control steps that its formulas assume [s]; empty: any"""
    needs_arrays: bool = False
    """whether it needs arrays; otherwise it also takes a single CAV as plain floats (memory: `scalar_memory`) and
    returns a float, which is several times faster than arrays of one row"""
    needs_numpy: bool = False
    """whether its arrays must be those of NumPy; otherwise it also takes torch tensors, as in a learned model"""

    @property
    def input_fields(self) -> tuple[str, ...]:
        """The known fields of `LocalState` that it reads, in order."""
        names = {*COMMON_FIELDS, *self.required_fields, *self.used_fields}
        return tuple(name for name in LocalState._fields if name in names)

    @property
    def measured_fields(self) -> frozenset[str]:
        """The fields of `LocalState` that a road must measure if it can."""
        return frozenset(LocalState._fields if self.reads_any_field else self.input_fields)

    def unmet_reason(self, road: RoadInterface) -> str:
        """Return why a road does not meet these requirements; empty if it does."""
        if self.needs_loop and not road.is_closed:
            return "it needs a closed road"
        if missing := sorted(self.required_fields - road.provided_fields):
            return f"it needs {', '.join(missing)}"
        if self.needs_coordinate and not road.has_coordinate:
            return "it needs positions along the road"
        other_steps = self.other_time_steps(road.control_step)
        return (
            f"its time_step is {other_steps[0]:g} s; allowed: {road.control_step:g} s, the control step"
            if other_steps
            else ""
        )

    def other_time_steps(self, control_step: float) -> list[float]:
        """Return the control steps that its formulas assume and that differ from `control_step` [s], in order."""
        return [step for step in sorted(self.time_steps) if abs(step - control_step) > STEP_TOLERANCE]


NO_REQUIREMENTS = Requirements()


def merge_requirements(*parts: Requirements) -> Requirements:
    """Return what meets the requirements of all parts."""
    return Requirements(*(reduce(or_, values) for values in zip(NO_REQUIREMENTS, *parts, strict=True)))
