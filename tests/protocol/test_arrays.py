"""Arrays as fields: what the wire carries is what the reader holds, without a copy; everything else is refused."""

from __future__ import annotations

import math
import struct
from typing import Annotated, Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from pydantic import ValidationError

from trackmesh.protocol.arrays import AnyArray, ArrayField, Axis, FloatArray, IntArray
from trackmesh.protocol.messages.base import Message

DTYPES = ["<f8", "<f4", "<i8", "<u4", "|u1"]


class Pair(Message):
    """A table, a row a name, and perhaps weights."""

    names: Annotated[list[str], Axis("n")]
    table: Annotated[FloatArray, ArrayField("<f8", ("n", 2), ge=-1.0, le=1.0)]
    counts: Annotated[IntArray, ArrayField("<i8", ("n",))] | None = None


class Square(Message):
    """A square of any size."""

    m: Annotated[FloatArray, ArrayField("<f8", ("p", "p"))]


def wire(array: AnyArray, **change: Any) -> dict[str, Any]:
    plain = {"dtype": array.dtype.str, "shape": list(array.shape), "data": array.tobytes()}
    return plain | change


def reason(kind: type[Message], **fields: Any) -> str:
    with pytest.raises(ValidationError) as refused:
        kind.model_validate(fields, strict=True)
    return str(refused.value.errors()[0]["type"])


def elements(dtype: str) -> st.SearchStrategy[Any]:
    if np.dtype(dtype).kind == "f":
        return npst.from_dtype(np.dtype(dtype), allow_nan=False, allow_infinity=False)
    return npst.from_dtype(np.dtype(dtype))


@given(st.sampled_from(DTYPES).flatmap(lambda d: npst.arrays(d, npst.array_shapes(max_dims=3), elements=elements(d))))
def test_what_goes_in_comes_out(array: AnyArray) -> None:
    field = ArrayField(array.dtype.str, (None,) * array.ndim)
    for value in (wire(array), array.tolist(), array):
        read = field.validate(value)
        assert read.dtype == array.dtype
        assert np.array_equal(read, array)
        assert not read.flags.writeable


@given(npst.arrays("<f8", st.tuples(st.integers(1, 5), st.integers(1, 5)), elements=elements("<f8")))
def test_the_wire_is_little_endian_row_by_row(array: FloatArray) -> None:
    by_hand = struct.pack(f"<{array.size}d", *[x for row in array.tolist() for x in row])

    class One(Message):
        a: Annotated[FloatArray, ArrayField("<f8", (None, None))]

    for stored in (array, np.asfortranarray(array), array.astype(">f8")):
        assert One(a=stored).model_dump()["a"] == {"dtype": "<f8", "shape": list(array.shape), "data": by_hand}


def test_an_array_from_the_wire_is_the_received_bytes() -> None:
    unpacked = msgpack.unpackb(msgpack.packb(wire(np.arange(1000.0))))
    read = ArrayField("<f8", (None,)).validate(unpacked)
    held = np.frombuffer(unpacked["data"], "u1")
    assert read.ctypes.data == held.ctypes.data
    assert read.flags.aligned


def test_an_array_of_the_caller_is_copied_if_he_could_change_it() -> None:
    mine = np.zeros(3)
    read = ArrayField("<f8", (3,)).validate(mine)
    mine[0] = 1.0
    assert read[0] == 0.0


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"dtype": "<f4"}, "wrong_dtype"),
        ({"dtype": ">f8"}, "wrong_dtype"),
        ({"dtype": "float64"}, "wrong_dtype"),
        ({"dtype": "O"}, "wrong_dtype"),
        ({"dtype": None}, "wrong_dtype"),
        ({"dtype": [["<f8"]]}, "wrong_dtype"),
        ({"shape": [2]}, "wrong_length"),
        ({"shape": [2, 2, 1]}, "wrong_length"),
        ({"shape": [1, 4]}, "wrong_length"),
        ({"shape": [4, 1]}, "wrong_length"),
        ({"shape": [3, 2]}, "wrong_length"),
        ({"shape": [-2, -2]}, "wrong_length"),
        ({"shape": [True, 4]}, "wrong_length"),
        ({"shape": [2.0, 2.0]}, "wrong_length"),
        ({"shape": [2**40, 2**40]}, "wrong_length"),
        ({"shape": (2, 2)}, "wrong_length"),
        ({"shape": "22"}, "wrong_length"),
        ({"data": b"\0" * 31}, "wrong_length"),
        ({"data": b"\0" * 33}, "wrong_length"),
        ({"data": b""}, "wrong_length"),
        ({"data": "\0" * 32}, "wrong_type"),
        ({"data": [0.0] * 4}, "wrong_type"),
        ({"data": None}, "wrong_type"),
        ({"more": 1}, "wrong_type"),
    ],
)
def test_a_wrong_map_is_refused(change: dict[str, Any], why: str) -> None:
    assert reason(Pair, names=["a", "b"], table=wire(np.zeros((2, 2)), **change)) == why


@pytest.mark.parametrize("missing", ["dtype", "shape", "data"])
def test_a_map_without_a_part_is_refused(missing: str) -> None:
    table = wire(np.zeros((2, 2)))
    del table[missing]
    assert reason(Pair, names=["a", "b"], table=table) == "wrong_type"


@pytest.mark.parametrize("value", [None, 1, 1.5, True, "x", b"x", {}, {1: 2}, object()])
def test_what_is_no_array_is_refused(value: object) -> None:
    assert reason(Pair, names=["a"], table=value) == "wrong_type"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("form", [wire, np.ndarray.tolist, np.array])
def test_a_number_that_is_none_is_refused_wherever_it_stands(bad: float, form: Any) -> None:
    for place in np.ndindex(3, 2):
        table = np.zeros((3, 2))
        table[place] = bad
        assert reason(Pair, names=list("abc"), table=form(table)) == "not_finite"


@given(st.floats(-2.0, 2.0), st.integers(0, 2), st.integers(0, 1))
def test_bounds_are_inclusive_and_hold_for_every_element(value: float, i: int, j: int) -> None:
    table = np.zeros((3, 2))
    table[i, j] = value
    if -1.0 <= value <= 1.0:
        Pair(names=list("abc"), table=table)
    else:
        assert reason(Pair, names=list("abc"), table=wire(table)) == "out_of_bounds"


@pytest.mark.parametrize(
    ("dtype", "value", "why"),
    [
        ("<i8", [1.0], "wrong_dtype"),
        ("<i8", [True], "wrong_dtype"),
        ("<i8", [True, 2], "wrong_dtype"),
        ("<i8", ["1"], "wrong_dtype"),
        ("<i8", [b"1"], "wrong_dtype"),
        ("<i8", [None], "wrong_dtype"),
        ("<i8", [{}], "wrong_dtype"),
        ("<i8", [2**63], "out_of_bounds"),
        ("<i8", [-(2**63) - 1], "out_of_bounds"),
        ("<i8", [2**63, -1], "out_of_bounds"),
        ("<i8", [10**400], "out_of_bounds"),
        ("<u4", [-1], "out_of_bounds"),
        ("<u4", [2**32], "out_of_bounds"),
        ("|u1", [256], "out_of_bounds"),
        ("<f8", [True, 1.0], "wrong_dtype"),
        ("<f8", ["1.5"], "wrong_dtype"),
        ("<f8", [1j], "wrong_dtype"),
        ("<f8", [10**400], "out_of_bounds"),
        ("<f4", [1e300], "not_finite"),
        ("<f8", [[1.0]], "wrong_length"),
        ("<f8", [1.0, [1.0]], "wrong_length"),
        ("<f8", [[]], "wrong_length"),
    ],
)
def test_a_list_of_anything_else_is_refused(dtype: str, value: list[Any], why: str) -> None:
    class One(Message):
        a: Annotated[AnyArray, ArrayField(dtype, (None,))]

    assert reason(One, a=value) == why


def test_whole_numbers_are_real_numbers() -> None:
    assert ArrayField("<f8", (None,)).validate([1, 2.5, 10**30]).tolist() == [1.0, 2.5, 1e30]


def test_an_array_of_another_kind_is_cast_only_without_loss_of_kind() -> None:
    assert ArrayField("<i8", (2,)).validate(np.array([1, 2], np.uint8)).dtype == np.int64
    assert ArrayField("<f4", (2,)).validate(np.array([1.0, 2.0])).dtype == np.float32
    for dtype, array in (("<i8", np.array([1.0])), ("|u1", np.array([300])), ("<f8", np.array(["1"]))):
        with pytest.raises(ValueError, match="elements"):
            ArrayField(dtype, (1,)).validate(array)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ([[0.0, 0.0], [0.0]], "wrong_length"),
        ([[0.0, 0.0], 0.0], "wrong_length"),
        ([0.0, 0.0], "wrong_length"),
        ([[[0.0, 0.0]], [[0.0, 0.0]]], "wrong_length"),
        ([[[[[[]]]]]], "wrong_length"),
        ([["a" * 10**6, ""]] * 1000, "wrong_dtype"),
    ],
)
def test_a_ragged_list_or_one_of_other_depth_is_refused(table: list[Any], why: str) -> None:
    assert reason(Pair, names=["a", "b"], table=table) == why


def test_axes_of_one_name_are_equally_long() -> None:
    rows = np.zeros((2, 2))
    assert reason(Pair, names=["a"], table=wire(rows)) == "wrong_length"
    assert reason(Pair, names=["a", "b"], table=wire(rows), counts=[1]) == "wrong_length"
    assert reason(Square, m=wire(np.zeros((2, 3)))) == "wrong_length"
    Pair(names=["a", "b"], table=rows, counts=np.array([1, 2]))


def test_no_rows_is_a_list_without_anything_or_a_map_with_their_length() -> None:
    empties: list[Any] = [[], wire(np.zeros((0, 2))), np.zeros((0, 2))]
    for empty in empties:
        assert Pair(names=[], table=empty, counts=[]).table.shape == (0, 2)
    assert Square(m=[]).m.shape == (0, 0)
    assert reason(Square, m=wire(np.zeros((0, 3)))) == "wrong_length"
    assert reason(Pair, names=[], table=wire(np.zeros((0, 3)))) == "wrong_length"
    assert reason(Pair, names=[], table=[[], []]) == "wrong_length"


def test_nothing_is_not_a_matrix_of_zeros() -> None:
    class Fixed(Message):
        m: Annotated[FloatArray, ArrayField("<f8", (2, 2))]

    assert reason(Fixed, m=[]) == "wrong_length"


def test_the_json_schema_says_what_an_array_is() -> None:
    schema = Pair.model_json_schema()["properties"]["table"]
    assert (schema["type"], schema["dtype"]) == ("array", "<f8")
    assert schema["items"]["minItems"] == schema["items"]["maxItems"] == 2
    assert schema["items"]["items"] == {"type": "number", "minimum": -1.0, "maximum": 1.0}
