"""Array functions for three kinds of numbers: NumPy arrays in workers, torch tensors in learned models, and floats.

Floats are for single vehicles: between two steps of SUMO, a NumPy call on one number takes about 3 us, because the
caches are cold, and a float operation 0.1 us. (`array_api_compat` supports arrays only, and a call takes 2 us.)
"""

import math
import sys
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = Any
"""a NumPy array, a torch tensor or a float; the type cannot be named here, because workers run without torch"""
Floats = NDArray[np.float64]


_FLOAT_NAMESPACE = SimpleNamespace(
    minimum=min,
    maximum=max,
    where=lambda condition, then, otherwise: then if condition else otherwise,
    **{name: getattr(math, name) for name in ("floor", "isnan", "cos", "exp", "sin")},
)


def namespace(array: Array) -> Any:
    """Return `numpy`, `torch`, or `_FLOAT_NAMESPACE` for floats; all have the functions of `_FLOAT_NAMESPACE`."""
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
        return np.maximum(array, low)  # on few rows in a third of the time of `clip`
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
    # Square roots of MKL, which torch calls, differ between processor models: see `unjam.kernels`.
    return array.rsqrt().reciprocal()


def as_indices(values: Array) -> Array:
    """Return whole numbers as integers, without gradients, for indexing."""
    return values.astype(np.int64) if isinstance(values, np.ndarray) else values.detach().long()


def copy_array(values: Array) -> Array:
    """Return a copy with the same order in memory, on which the speed of sums depends; gradients flow through it."""
    return values.copy("K") if isinstance(values, np.ndarray) else values.clone()


def replace_entries(values: Array, index: Any, source: Array, source_index: Any) -> Array:
    """Return a copy of an array with `source[source_index]` in place of the entries `values[index]`."""
    copied = copy_array(values)
    copied[index] = source[source_index]
    return copied


def replace_columns(values: Any, columns: Any, source: Any, source_columns: Any) -> Any:
    """Return arrays, also nested in tuples and lists, with `source_columns` of `source` in place of `columns`.

    Columns are entries along the last axis.
    """
    if isinstance(values, tuple | list):
        pairs = zip(values, source, strict=True)
        items = [replace_columns(item, columns, source_item, source_columns) for item, source_item in pairs]
        return type(values)(*items) if hasattr(values, "_fields") else type(values)(items)
    if not hasattr(values, "shape"):
        return values
    return replace_entries(values, np.s_[..., columns], source, np.s_[..., source_columns])


def replace_padded_rows(values: Any, rows: Any, source: Any, source_rows: Any, padding: Any) -> Any:
    """Return an array (..., n, m) with rows of `source` (..., k, l) in place of `rows`; `padding` fills short rows."""
    width = max(values.shape[-1], source.shape[-1])
    padded_values, padded_source = (
        np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, width - array.shape[-1])], constant_values=padding)
        for array in (values, source)
    )
    padded_values[..., rows, :] = padded_source[..., source_rows, :]
    return padded_values


def as_column(array: Array) -> Array:
    """Return an array of shape (n,) with shape (n, 1), or a float as a tuple."""
    return (array,) if type(array) is float else array[..., None]


def stack_columns(columns: tuple[Array, ...]) -> Array:
    """Return m arrays of shape (n,) as columns of one array (n, m); return a tuple of floats unchanged."""
    first = columns[0]
    if type(first) is float:
        return columns
    if isinstance(first, np.ndarray):
        return np.array(columns).T  # a fifth of the time of np.stack on few rows
    return sys.modules["torch"].stack(columns, -1)


def join_columns(blocks: list[Array]) -> Array:
    """Concatenate blocks of shape (n, m) along their columns, or tuples of floats to one tuple."""
    first = blocks[0]
    if len(blocks) == 1:
        return first
    return sum(blocks, ()) if isinstance(first, tuple) else namespace(first).concatenate(blocks, -1)
