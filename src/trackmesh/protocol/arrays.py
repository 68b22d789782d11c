"""numpy arrays as validated pydantic fields.

A field is declared with its element type, its shape and its bounds::

    values: Annotated[FloatArray, ArrayField("<f8", ("n", "c"))]

In msgpack an array is ``{"dtype": "<f8", "shape": [n, c], "data": bin}`` (little-endian, C order); in JSON it is
a nested list. Floating-point arrays hold finite numbers only. A shape names its axes: a number is that length, a
name is bound by the whole message (``"n"`` has one length in all its fields, see ``messages/base.py``), None is free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
UInt32Array = npt.NDArray[np.uint32]
UInt8Array = npt.NDArray[np.uint8]
AnyArray = npt.NDArray[Any]

_KEYS = {"dtype", "shape", "data"}


@dataclass(frozen=True)
class ArrayField:
    """Annotation that validates and serialises one array.

    Attributes:
        dtype: numpy element type with byte order: ``<f8``, ``<f4``, ``<i8``, ``<u4`` or ``|u1``.
        shape: one entry an axis: a length, a name shared within the message, or None.
        ge, le: inclusive bounds of every element, or None.
    """

    dtype: str
    shape: tuple[int | str | None, ...]
    ge: float | None = None
    le: float | None = None

    also: ClassVar[tuple[type, ...]] = ()
    """Other types than numbers that a list may hold."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(
            self.validate,
            serialization=core_schema.plain_serializer_function_ser_schema(self.serialize, info_arg=True),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        item: dict[str, Any] = {"type": "number" if np.dtype(self.dtype).kind == "f" else "integer"}
        if self.ge is not None:
            item["minimum"] = self.ge
        if self.le is not None:
            item["maximum"] = self.le
        for length in reversed(self.shape):
            item = {"type": "array", "items": item}
            if isinstance(length, int):
                item |= {"minItems": length, "maxItems": length}
        axes = ", ".join("any" if a is None else str(a) for a in self.shape)
        return item | {"description": f"array of {self.dtype}, shape ({axes})", "dtype": self.dtype}

    def validate(self, value: Any) -> AnyArray:
        """Turn a wire map, a nested list or an array into a read-only array, or say why it is none."""
        array = self._parse(value)
        self._check_shape(array)
        self._check_values(array)
        if array.flags.writeable:
            array = array.copy() if isinstance(value, np.ndarray) else array
            array.flags.writeable = False
        return array

    def serialize(self, value: AnyArray, info: core_schema.SerializationInfo) -> Any:
        """Wire map for msgpack, nested list for JSON."""
        if info.mode == "json":
            return value.tolist()
        return {"dtype": self.dtype, "shape": list(value.shape), "data": value.tobytes()}

    def _parse(self, value: Any) -> AnyArray:
        if isinstance(value, dict):
            return self._from_wire(value)
        if isinstance(value, np.ndarray):
            return self._cast(value) if value.size else np.zeros(value.shape, self.dtype)
        if isinstance(value, list):
            return self._from_list(value)
        raise PydanticCustomError("wrong_type", "an array must be a map with dtype, shape and data, or a list")

    def _cast(self, array: AnyArray) -> AnyArray:
        want = np.dtype(self.dtype)
        if array.dtype == want and array.flags.c_contiguous:
            return array
        if array.dtype.kind not in "iuf" or (want.kind in "iu" and array.dtype.kind == "f"):
            raise self._wrong_dtype()
        if want.kind in "iu":
            info = np.iinfo(want)
            if int(array.min()) < info.min or int(array.max()) > info.max:
                raise self._no_fit()
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(array, dtype=want)

    def _from_list(self, value: list[Any]) -> AnyArray:
        # Judged before numpy sees it: numpy takes texts and booleans for numbers, and room for the longest text times
        # the number of elements.
        flat, shape = self._flatten(value)
        want = np.dtype(self.dtype)
        numbers = (int, np.integer) if want.kind in "iu" else (int, float, np.integer, np.floating)
        kinds = set(map(type, flat))
        if list in kinds:
            raise PydanticCustomError("wrong_length", "expected {want} axes, got more", {"want": len(self.shape)})
        if bool in kinds or not all(issubclass(kind, (*numbers, *self.also)) for kind in kinds):
            raise self._wrong_dtype()
        try:
            with np.errstate(over="ignore"):
                return np.array(flat, want).reshape(shape)
        except OverflowError:
            raise self._no_fit() from None

    def _flatten(self, value: list[Any]) -> tuple[Sequence[Any], list[int]]:
        """The elements in order, and the shape; [] stands for no rows, however long they would be."""
        rows: list[Any] = value
        shape = [len(value)]
        for axis in self.shape[1:]:
            if not all(isinstance(row, list | tuple | np.ndarray) for row in rows):
                raise PydanticCustomError("wrong_length", "expected {want} axes, got fewer", {"want": len(self.shape)})
            lengths = set(map(len, rows))
            if len(lengths) > 1:
                raise PydanticCustomError("wrong_length", "the rows of an array have unequal lengths")
            shape.append(lengths.pop() if lengths else axis if isinstance(axis, int) else 0)
            rows = list(chain.from_iterable(rows))
        return rows, shape

    def _wrong_dtype(self) -> PydanticCustomError:
        kind = "integer" if np.dtype(self.dtype).kind in "iu" else "real"
        return PydanticCustomError("wrong_dtype", "elements must be {want} numbers", {"want": kind})

    def _no_fit(self) -> PydanticCustomError:
        return PydanticCustomError("out_of_bounds", "elements do not fit {dtype}", {"dtype": self.dtype})

    def _from_wire(self, value: dict[Any, Any]) -> AnyArray:
        if value.keys() != _KEYS:
            raise PydanticCustomError("wrong_type", "an array map must have exactly dtype, shape and data")
        shape, data = value["shape"], value["data"]
        if value["dtype"] != self.dtype:
            raise PydanticCustomError("wrong_dtype", "dtype must be {dtype}", {"dtype": self.dtype})
        if not isinstance(data, bytes):
            raise PydanticCustomError("wrong_type", "data must be bytes")
        if (
            not isinstance(shape, list)
            or len(shape) != len(self.shape)
            or not all(type(s) is int and 0 <= s < 2**31 for s in shape)
        ):
            raise PydanticCustomError("wrong_length", "shape must be {k} lengths", {"k": len(self.shape)})
        if math.prod(shape) * np.dtype(self.dtype).itemsize != len(data):
            raise PydanticCustomError("wrong_length", "data holds {b} bytes, which is not its shape", {"b": len(data)})
        return np.frombuffer(data, self.dtype).reshape(shape)

    def _check_shape(self, array: AnyArray) -> None:
        if array.ndim != len(self.shape):
            raise PydanticCustomError(
                "wrong_length",
                "expected {want} axes, got {got}",
                {"want": len(self.shape), "got": array.ndim},
            )
        for want, got in zip(self.shape, array.shape, strict=True):
            if isinstance(want, int) and want != got:
                raise PydanticCustomError(
                    "wrong_length", "an axis must have length {want}, not {got}", {"want": want, "got": got}
                )

    def _check_values(self, array: AnyArray) -> None:
        if array.size == 0:
            return
        # NaN and infinity propagate through min and max, so finiteness and bounds cost one pass.
        low, high = array.min(), array.max()
        if array.dtype.kind == "f" and not (math.isfinite(low) and math.isfinite(high)):
            raise PydanticCustomError("not_finite", "an element is not a finite number")
        if (self.ge is not None and low < self.ge) or (self.le is not None and high > self.le):
            raise PydanticCustomError(
                "out_of_bounds", "elements must lie in [{ge}, {le}]", {"ge": str(self.ge), "le": str(self.le)}
            )


@dataclass(frozen=True)
class Axis:
    """Annotation of a list field whose length is one of the message's named axes (``columns`` is axis ``"c"``)."""

    name: str
