"""One formula for three kinds of numbers: NumPy arrays in workers, torch tensors in learned models, Python floats.

Floats are for single vehicles: between two steps of SUMO the processor's caches are cold, and a NumPy call on one
number then takes some 3 us against 0.1 us. (`array_api_compat` supports arrays only, and each call takes 2 us.)
"""

import math
import sys
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = Any
"""A NumPy array, a torch tensor or a float; workers run without torch, so it cannot be named here."""
Floats = NDArray[np.float64]


_FLOAT_NAMESPACE = SimpleNamespace(
    minimum=min,
    maximum=max,
    where=lambda condition, then, otherwise: then if condition else otherwise,
    **{name: getattr(math, name) for name in ("floor", "isnan", "cos", "exp", "sin")},
)


def namespace(array: Array) -> Any:
    """Return `numpy`, `torch` or a namespace for floats, with `where` and the functions of `_FLOAT_NAMESPACE`."""
    if type(array) is float:
        return _FLOAT_NAMESPACE
    if isinstance(array, (np.ndarray, np.generic)):
        return np
    return sys.modules["torch"]


def clip(array: Array, low: float, high: float) -> Array:
    """Return `array` with its entries limited to [low, high]; NaN stays NaN."""
    if type(array) is float:
        return low if array < low else high if array > high else array
    return array.clip(low, high)


def clamp_min(array: Array, low: Array) -> Array:
    """Return the larger of each entry and `low`; NaN stays NaN."""
    if type(array) is float:
        return low if array < low else array
    if isinstance(array, (np.ndarray, np.generic)):
        return np.maximum(array, low)  # what `clip` does in the end, in a third of the time on few rows
    return array.clip(low, None)


def clamp_max(array: Array, high: Array) -> Array:
    """Return the smaller of each entry and `high`; NaN stays NaN."""
    if type(array) is float:
        return high if array > high else array
    if isinstance(array, (np.ndarray, np.generic)):
        return np.minimum(array, high)
    return array.clip(None, high)


def square_root(array: Array) -> Array:
    """Return the square root of each entry."""
    if type(array) is float:
        return math.sqrt(array)
    if isinstance(array, (np.ndarray, np.generic)):
        return np.sqrt(array)
    # torch takes square roots from MKL, which differ between processor models: see `unjam.kernels`.
    return array.rsqrt().reciprocal()


def as_indices(values: Array) -> Array:
    """Return whole numbers as indices of arrays, through which no gradient flows."""
    return values.astype(np.int64) if isinstance(values, np.ndarray) else values.detach().long()


def copy_array(values: Array) -> Array:
    """Return a copy with the same order in memory, in which sums are fast, through which gradients flow."""
    return values.copy("K") if isinstance(values, np.ndarray) else values.clone()


def replace_entries(values: Array, index: Any, source: Array, source_index: Any) -> Array:
    """Return a copy of an array with `source[source_index]` in place of the entries `values[index]`."""
    copied = copy_array(values)
    copied[index] = source[source_index]
    return copied


def replace_columns(values: Any, columns: Any, source: Any, source_columns: Any) -> Any:
    """Return arrays, also in tuples and lists, with columns of `source` in place of some along the last axis."""
    if isinstance(values, tuple | list):
        pairs = zip(values, source, strict=True)
        parts = [replace_columns(target, columns, other, source_columns) for target, other in pairs]
        return type(values)(*parts) if hasattr(values, "_fields") else type(values)(parts)
    if not hasattr(values, "shape"):
        return values
    return replace_entries(values, np.s_[..., columns], source, np.s_[..., source_columns])


def replace_padded_rows(values: Any, rows: Any, source: Any, source_rows: Any, padding: Any) -> Any:
    """Return an array (..., n, m) with rows of `source` (..., k, l) in place of some; the shorter gets `padding`."""
    width = max(values.shape[-1], source.shape[-1])
    found, other = (
        np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, width - array.shape[-1])], constant_values=padding)
        for array in (values, source)
    )
    found[..., rows, :] = other[..., source_rows, :]
    return found


def as_column(array: Array) -> Array:
    """Return an array of shape (n,) as (n, 1); a float as a tuple of one."""
    return (array,) if type(array) is float else array[..., None]


def stack_columns(columns: tuple[Array, ...]) -> Array:
    """Return arrays of shape (n,) as the columns of (n, m); floats stay a tuple of floats."""
    first = columns[0]
    if type(first) is float:
        return columns
    if isinstance(first, np.ndarray):
        return np.array(columns).T  # a fifth of the time of np.stack on few rows
    return sys.modules["torch"].stack(columns, -1)


def join_columns(blocks: list[Array]) -> Array:
    """Return blocks of shape (n, m) concatenated along the columns; tuples of floats as one tuple."""
    first = blocks[0]
    if len(blocks) == 1:
        return first
    return sum(blocks, ()) if isinstance(first, tuple) else namespace(first).concatenate(blocks, -1)
