"""The check of a driver of one's own: does it keep the contract that all drivers keep?"""

from typing import Any

import numpy as np

from unjam.drivers.command import answer_as_array
from unjam.drivers.driver import Driver, Memory
from unjam.drivers.local_state import ADJACENT_POSITIONS, SECTIONS_AHEAD, LocalState
from unjam.drivers.user_driver import DriverLike, as_driver
from unjam.errors import InputError
from unjam.tree import leaves, map_leaves

MAX_ROW_DIFFERENCE = 1e-12


def check_driver(
    driver: DriverLike, rows: int = 8, steps: int = 50, seed: int = 0, optional_fields: bool = False
) -> None:
    """Check that a driver keeps the contract of `unjam.drivers.Driver`; raise where it does not.

    It drives `rows` vehicles for `steps` random steps, drawn from `seed`, and checks that accelerations are
    finite and of shape (rows,), that n rows at once equal n single calls to 1e-12, that the same call gives
    the same answer, and that neither the state nor the memory it was given is changed. With `told` it is told
    all that a road may tell, as motorways do: what is allowed, the way to the ramp, who drives beside it.

    Raises:
        InputError: one line that names what is wrong, and in which step.
    """
    driver = as_driver(driver)
    generator, optional_fields = np.random.default_rng(seed), optional_fields or bool(driver.required_fields)
    memory, *single = (driver.initial_memory(count) for count in (rows, *[1] * rows))
    if not isinstance(memory, dict):
        raise InputError(f"driver: initial_memory({rows}) answers {memory!r}; allowed: a dict of arrays")
    for step in range(steps):
        state = random_state(generator, rows, optional_fields)
        before, shown = map_leaves(np.array, memory), state.map(np.array)  # copies
        acceleration, after = _call_act(driver, state, memory, step)
        acceleration = check_acceleration(acceleration, rows, f"step {step}")
        if not _is_same_memory(memory, before):
            raise InputError(f"driver: step {step}: act() changed the memory that it was given")
        if not all(np.array_equal(one, other) for one, other in zip(state, shown, strict=True) if one is not None):
            raise InputError(f"driver: step {step}: act() changed the state that it was given")
        again, _ = _call_act(driver, state, before, step)
        if not np.array_equal(acceleration, again):
            raise InputError(f"driver: step {step}: the same state and memory gave another acceleration")
        for row in range(rows):
            one = state.select(slice(row, row + 1))
            answer, single[row] = _call_act(driver, one, single[row], step)
            alone, among = float(np.asarray(answer)[0]), float(acceleration[row])
            if not abs(alone - among) <= MAX_ROW_DIFFERENCE:
                words = f"row {row} gave {alone!r} alone and {among!r} among {rows} rows"
                raise InputError(f"driver: step {step}: {words}")
        memory = after


def _call_act(driver: Driver, state: LocalState, memory: Memory, step: int) -> tuple[Any, Memory]:
    """Return what a driver answers; raise `InputError` with the step where it fails."""
    try:
        return driver.act(state, memory)
    except InputError:
        raise
    except Exception as error:  # whatever the user's code raises is the user's to mend
        raise InputError(f"driver: step {step}: {type(error).__name__}: {error}") from error


def check_acceleration(acceleration: Any, rows: int, context: str) -> np.ndarray:
    """Return a driver's answer as an array; raise `InputError` unless it is finite and has `rows` rows."""
    array = answer_as_array(acceleration, rows, f"driver: {context}")
    if not np.isfinite(array).all():
        raise InputError(f"driver: {context}: acceleration is {array[~np.isfinite(array)][0]}; allowed: finite")
    return array


def random_state(generator: np.random.Generator, rows: int, optional_fields: bool = False) -> LocalState:
    """Return random surroundings, standing and close vehicles among them; `told`: of the road ahead too."""
    speeds = generator.uniform(0.0, 12.0, (3, rows)) * (generator.random((3, rows)) > 0.2)
    gaps = generator.uniform(0.5, 60.0, (2, rows))
    position = generator.uniform(0.0, 230.0, rows)
    near = speeds[0], speeds[1], gaps[0], speeds[2], gaps[1], position, np.full(rows, 230.0)
    if not optional_fields:
        return LocalState(*near)
    speeds = generator.uniform(0.0, 30.0, (2, rows, SECTIONS_AHEAD))
    allowed, to_merge = generator.uniform(20.0, 30.0, rows), generator.uniform(-500.0, 2000.0, rows)
    ahead = LocalState(*near, None, allowed, to_merge, *speeds)
    beside = generator.uniform(-5.0, 60.0, (rows, len(ADJACENT_POSITIONS)))
    return ahead._replace(
        adjacent_gaps=beside,
        adjacent_speeds=generator.uniform(0.0, 30.0, beside.shape),
        penetration_rate=generator.uniform(0.0, 0.3, rows),
        congestion=(generator.random((rows, SECTIONS_AHEAD)) < 0.3).astype(float),
    )


def _is_same_memory(memory: Memory, other: Memory) -> bool:
    found, before = dict(leaves(memory)), dict(leaves(other))
    return found.keys() == before.keys() and all(
        np.array_equal(np.asarray(found[path]), before[path], equal_nan=True) for path in found
    )
