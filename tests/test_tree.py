import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unjam.tree import leaves, map_leaves, pack, replace_leaves, unpack


class Pair(NamedTuple):
    low: np.ndarray
    high: float


@dataclass(frozen=True)
class Leaf:
    name: str
    pair: Pair
    memory: dict[str, Any] = field(default_factory=dict)
    ends: tuple[tuple[float, float], ...] = ()
    note: str | None = None


@dataclass(frozen=True)
class Record:
    leaves: tuple[Leaf, ...]
    counts: list[int]


def record() -> Record:
    inner = {"expert": {"window": np.arange(6.0).reshape(2, 3)}, "age": np.array(2.0)}
    first = Leaf("a", Pair(np.ones(3), math.nan), inner, ((0.0, 1.0), (2.0, 3.0)))
    return Record((first, Leaf("b", Pair(np.zeros((0, 2)), 1.0), note="x")), [1, 2])


def test_unpack_restores_what_pack_converted() -> None:
    facts, arrays = pack(record())
    paths = ("0.pair.low", "0.memory.expert.window", "0.memory.age", "1.pair.low")
    assert set(arrays) == {f"leaves.{path}" for path in paths}
    again = unpack(Record, facts, arrays)
    assert isinstance(again.leaves[0].pair, Pair)
    np.testing.assert_array_equal(again.leaves[0].memory["expert"]["window"], np.arange(6.0).reshape(2, 3))
    assert math.isnan(again.leaves[0].pair.high)
    assert again.leaves[0].ends == ((0.0, 1.0), (2.0, 3.0))
    assert (again.leaves[1].note, again.counts) == ("x", [1, 2])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda facts: facts.pop("counts"), "'counts' is missing"),
        (lambda facts: facts.update(more=1), "'more' is unknown"),
        (lambda facts: facts.update(counts="ab"), "not allowed"),
        (lambda facts: facts.update(counts=["ab"]), "allowed: int"),
        (lambda facts: facts["leaves"][0].update(name={"array": "leaves.0.pair.low"}), "no place"),
        (lambda facts: facts["leaves"][0]["pair"].update(low={"array": "elsewhere"}), "missing"),
        (lambda facts: facts["leaves"][0].update(ends=[[1.0]]), "1 values are not allowed; allowed: 2"),
        (lambda facts: facts.update(leaves=3), "not allowed"),
    ],
)
def test_unpack_refuses_other_records(change: Any, words: str) -> None:
    facts, arrays = pack(record())
    change(facts)
    with pytest.raises(ValueError, match=words):
        unpack(Record, facts, arrays)


TREES = st.recursive(
    st.lists(st.floats(-9, 9), max_size=3).map(np.array),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=6,
).map(lambda tree: tree if isinstance(tree, dict) else {"a": tree})


@given(TREES)
def test_replace_leaves_is_the_inverse_of_leaves(tree: dict[str, Any]) -> None:
    again = replace_leaves(tree, {path: 2.0 * leaf for path, leaf in leaves(tree)})
    twice = map_leaves(lambda leaf, same: leaf + same, tree, tree)
    for (path, found), (other, expected) in zip(leaves(again), leaves(twice), strict=True):
        assert path == other
        np.testing.assert_array_equal(found, expected)
