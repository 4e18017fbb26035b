import json
import struct
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from unjam.tree import Arrays
from unjam.worlds.messages import read_message, write_message

NAMES = st.text(min_size=1, max_size=8)
FACTS = st.dictionaries(
    NAMES,
    st.recursive(
        st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
        max_leaves=6,
    ),
    max_size=4,
)
ARRAYS = st.dictionaries(
    st.from_regex(r"[a-z0-9._]{1,12}", fullmatch=True),
    hnp.arrays(
        st.sampled_from([np.float64, np.float32, np.int64, np.bool_]),
        hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
    ),
    max_size=4,
)


class Trickle(BytesIO):
    """A pipe that hands out one byte at a time."""

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(1)

    def readinto(self, buffer: Any, /) -> int:
        return super().readinto(memoryview(buffer)[:1])


def frame(facts: dict[str, Any], arrays: Arrays | None = None) -> bytes:
    """What is written, arrays and all: none is left."""
    pipe, left = BytesIO(), dict(arrays or {})
    write_message(pipe, facts, left)
    assert not left
    return pipe.getvalue()


def assert_same(found: Arrays, expected: Arrays) -> None:
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


@pytest.mark.long
@given(FACTS, ARRAYS)
def test_a_message_arrives_as_it_was_sent(facts: dict[str, Any], arrays: Arrays) -> None:
    found, found_arrays = read_message(BytesIO(frame(facts, arrays)))
    assert found == facts
    assert_same(found_arrays, arrays)


def test_empty_arrays_keep_their_shape() -> None:
    arrays: Arrays = {"none": np.zeros((0, 3)), "rows": np.zeros((2, 0)), "flat": np.zeros(0, np.float32)}
    assert_same(read_message(BytesIO(frame({}, arrays)))[1], arrays)


def test_views_arrive_as_their_elements() -> None:
    whole = np.arange(12.0).reshape(3, 4)
    arrays: Arrays = {"columns": whole.T, "every_other": whole[:, ::2], "backwards": whole[::-1]}
    assert_same(read_message(BytesIO(frame({}, arrays)))[1], arrays)


@pytest.mark.parametrize("arrays", [None, {}])
def test_a_message_without_arrays_arrives_without_arrays(arrays: Arrays | None) -> None:
    assert read_message(BytesIO(frame({"progress": 500}, arrays))) == ({"progress": 500}, {})


def test_messages_are_read_one_after_the_other_from_partial_reads() -> None:
    sent = [({"index": index}, {"row": np.full(3, float(index))}) for index in range(3)]
    pipe = Trickle(b"".join(frame(*message) for message in sent))
    for facts, arrays in sent:
        found, found_arrays = read_message(pipe)
        assert found == facts
        assert_same(found_arrays, arrays)
    with pytest.raises(EOFError):
        read_message(pipe)


def test_an_incomplete_frame_is_the_end_of_file() -> None:
    whole = frame({"seed": [1, 2]}, {"speeds": np.ones((2, 3))})
    for length in range(len(whole)):
        with pytest.raises(EOFError, match="closed the pipe"):
            read_message(BytesIO(whole[:length]))


def test_a_message_arrives_as_soon_as_it_is_written() -> None:
    flushed = []

    class Pipe(BytesIO):
        def flush(self) -> None:
            flushed.append(len(self.getvalue()))

    write_message(Pipe(), {"progress": 1})
    assert flushed == [len(frame({"progress": 1}))]


def test_objects_that_need_pickling_are_refused() -> None:
    with pytest.raises(Exception, match="object"):
        frame({}, {"driver": np.array([object()])})


def test_a_frame_is_two_lengths_then_json_then_arrays() -> None:
    whole = frame({"a": 1}, {"b": np.ones(1)})
    text, about = struct.unpack(">QQ", whole[:16])
    assert json.loads(whole[16 : 16 + text]) == {"a": 1}
    assert json.loads(whole[16 + text : 16 + text + about]) == [["b", "<f8", [1]]]
    assert whole[16 + text + about :] == np.ones(1).tobytes()


def test_arrays_of_other_kinds_than_numbers_are_refused() -> None:
    about = json.dumps([["b", "|O", [1]]]).encode()
    with pytest.raises(ValueError, match="not allowed"):
        read_message(BytesIO(struct.pack(">QQ", 2, len(about)) + b"{}" + about + bytes(8)))
