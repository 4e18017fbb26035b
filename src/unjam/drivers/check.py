"""The check of a user's own driver against the contract of all drivers."""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from unjam.drivers.command import to_answer_array
from unjam.drivers.driver import Driver, Memory, check_memory
from unjam.drivers.local_state import COMMON_FIELDS, FIELD_SIZES, SECTIONS_AHEAD, LocalState, state_of_ones
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError
from unjam.tree import leaves, map_leaves

MAX_ROW_DIFFERENCE, MAX_SINGLE_PRECISION_DIFFERENCE = 1e-12, 1e-5
"""largest differences between the accelerations of n rows at once and of n single rows [m/s2]"""
PROBE_ROWS, MAX_PROBE_DIFFERENCE = 4, 1e-4
"""number of rows in `check_row_independence`, and allowed difference of their results, relative to the largest one"""


def check_driver(
    driver: DriverLike, rows: int = 8, steps: int = 50, seed: int = 0, optional_fields: bool = False
) -> None:
    """Check that a driver fulfills the contract of `unjam.Driver`; an `InputError` names the violation and its step.

    The driver is called for `rows` vehicles in `steps` random states, drawn from `seed`. Accelerations must be finite
    and of shape (rows,), n rows at once must equal n single calls to 1e-12 (to 1e-5 in single precision), the same call
    must give the same answer, and neither state nor memory may be changed. With `optional_fields` the states also have
    the fields of motorways.
    """
    driver = as_driver(driver)
    reads_optional_fields = set(driver.requirements().input_fields) > set(COMMON_FIELDS)
    generator, optional_fields = np.random.default_rng(seed), optional_fields or reads_optional_fields
    memory, *row_memories = (driver.initial_memory(count) for count in (rows, *[1] * rows))
    check_memory(memory, rows, f"driver: initial_memory({rows})")
    for step in range(steps):
        state = random_state(generator, rows, optional_fields)
        memory_copy, state_copy = map_leaves(np.array, memory), state.map(np.array)
        acceleration, new_memory = _call_act(driver, state, memory, step)
        acceleration = check_acceleration(acceleration, rows, f"step {step}")
        for name, values, copy in (("memory", memory, memory_copy), ("state", state._asdict(), state_copy._asdict())):
            if not _is_same_tree(values, copy):
                raise InputError(f"driver: step {step}: act() changed the {name} that it was given")
        repeated, _ = _call_act(driver, state, memory_copy, step)
        if not np.array_equal(acceleration, repeated):
            raise InputError(f"driver: step {step}: the same state and memory gave another acceleration")
        decision = driver.decide(state, memory)
        components = decision.command.acceleration, decision.residual
        has_single_precision = any(str(getattr(array, "dtype", "")).endswith("float32") for array in components)
        tolerance = MAX_SINGLE_PRECISION_DIFFERENCE if has_single_precision else MAX_ROW_DIFFERENCE
        for row in range(rows):
            row_state = state.select(slice(row, row + 1))
            row_acceleration, row_memories[row] = _call_act(driver, row_state, row_memories[row], step)
            alone, together = float(np.asarray(row_acceleration)[0]), float(acceleration[row])
            if not abs(alone - together) <= tolerance:
                difference = f"row {row} gave {alone!r} alone and {together!r} among {rows} rows"
                raise InputError(f"driver: step {step}: {difference}")
        memory = new_memory


def check_row_independence(compute: Callable[[slice], Any], label: str, unit: str = "CAVs") -> None:
    """Raise `InputError` if `compute` returns other values for several rows at once than for each row."""
    together = np.asarray(compute(slice(PROBE_ROWS)))
    alone = np.concatenate([compute(slice(row, row + 1)) for row in range(PROBE_ROWS)])
    tolerance = MAX_PROBE_DIFFERENCE * max(1.0, float(np.abs(np.nan_to_num(alone)).max(initial=0.0)))
    if together.shape != alone.shape or not np.allclose(together, alone, rtol=0.0, atol=tolerance, equal_nan=True):
        raise InputError(f"{label}: {unit} influence each other; allowed: rows that are computed independently")


def probe_state(fields: Collection[str] = LocalState._fields) -> LocalState:
    """Return a random state for `check_row_independence`, with the given optional fields; some of them are ones."""
    state = random_state(np.random.default_rng(0), PROBE_ROWS, optional_fields=True)
    random_fields = {name: values for name, values in state._asdict().items() if values is not None}
    unused_fields = {name: None for name in LocalState._fields if name not in (*COMMON_FIELDS, *fields)}
    return state_of_ones(LocalState._fields, np.ones, PROBE_ROWS)._replace(**random_fields | unused_fields)


def _call_act(driver: Driver, state: LocalState, memory: Memory, step: int) -> tuple[Any, Memory]:
    try:
        return driver.act(state, memory)
    except InputError as error:
        raise InputError(f"driver: step {step}: {error}") from error
    except Exception as error:  # the user's code may raise any error
        raise InputError(f"driver: step {step}: {type(error).__name__}: {error}") from error


def check_acceleration(acceleration: Any, rows: int, context: str) -> np.ndarray:
    """Return the answer of a driver as an array; raise `InputError` unless it is finite and has `rows` rows."""
    array = to_answer_array(acceleration, rows, f"driver: {context}")
    if not np.isfinite(array).all():
        raise InputError(f"driver: {context}: acceleration is {array[~np.isfinite(array)][0]}; allowed: finite")
    return array


def random_state(generator: np.random.Generator, rows: int, optional_fields: bool = False) -> LocalState:
    """Return a random state with stopped and close vehicles; `optional_fields` adds the fields of motorways."""
    speeds = generator.uniform(0.0, 12.0, (3, rows)) * (generator.random((3, rows)) > 0.2)
    gaps = generator.uniform(0.5, 60.0, (2, rows))
    position = generator.uniform(0.0, 230.0, rows)
    state = LocalState(speeds[0], speeds[1], gaps[0], speeds[2], gaps[1], position, np.full(rows, 230.0))
    if not optional_fields:
        return state
    ranges = {"lane_speeds": (0.0, 30.0), "road_speeds": (0.0, 30.0), "allowed_speed": (20.0, 30.0)}
    ranges |= {"distance_to_merge": (-500.0, 2000.0), "adjacent_gaps": (-5.0, 60.0), "adjacent_speeds": (0.0, 30.0)}
    fields = dict[str, np.ndarray]()
    for name, (low, high) in {**ranges, "penetration_rate": (0.0, 0.3)}.items():
        fields[name] = generator.uniform(low, high, (rows, FIELD_SIZES[name]) if name in FIELD_SIZES else rows)
    return state._replace(**fields, congestion=(generator.random((rows, SECTIONS_AHEAD)) < 0.3).astype(float))


def _is_same_tree(tree: Any, copy: Any) -> bool:
    arrays, copies = ({path: array for path, array in leaves(part) if array is not None} for part in (tree, copy))
    are_equal = (np.array_equal(np.asarray(arrays[path]), copies[path], equal_nan=True) for path in arrays)
    return arrays.keys() == copies.keys() and all(are_equal)
