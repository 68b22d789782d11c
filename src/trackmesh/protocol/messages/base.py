"""What all messages share: strictness, the schema id, equal lengths of axes with one name."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from trackmesh.protocol.arrays import ArrayField, Axis

ID_PATTERN = r"^[a-z0-9][a-z0-9_-]{0,63}$"
ID_RE = re.compile(ID_PATTERN)

Id = Annotated[str, Field(pattern=ID_PATTERN)]
"""Name of a sensor, unit or realm: one chunk of a key."""

BootId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
"""Drawn anew at each start of a process: tells a restart from a gap."""

UnixNs = Annotated[int, Field(ge=0, le=2**63 - 1)]
"""UTC nanoseconds since 1970-01-01."""

Seq = Annotated[int, Field(ge=0, le=2**63 - 1)]
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


def _named_axes(cls: type[BaseModel]) -> Iterator[tuple[str, tuple[int | str | None, ...]]]:
    for name, info in cls.model_fields.items():
        for mark in _metadata(info.metadata, info.annotation):
            if isinstance(mark, ArrayField):
                yield name, mark.shape
            elif isinstance(mark, Axis):
                yield name, (mark.name,)


def _metadata(metadata: list[Any], annotation: Any) -> list[Any]:
    # Optional fields (X | None) hide their metadata one level deeper.
    found = list(metadata)
    for arg in getattr(annotation, "__args__", ()):
        found += getattr(arg, "__metadata__", ())
    return found


class Message(BaseModel):
    """Base of every message: frozen, no unknown fields, axes of one name equally long."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    _axes: ClassVar[tuple[tuple[str, tuple[int | str | None, ...]], ...]] = ()

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        cls._axes = tuple(_named_axes(cls))

    @model_validator(mode="after")
    def _equal_axes(self) -> Self:
        length: dict[str, int] = {}
        empty = 0
        for field, axes in self._axes:
            value = getattr(self, field)
            if value is None:
                continue
            shape = value.shape if isinstance(value, np.ndarray) else (len(value),)
            for axis, got in zip(axes, shape, strict=True):
                if isinstance(axis, str) and length.setdefault(axis, got) != got:
                    raise _unequal(field, axis, got, length[axis])
                if got == 0:
                    # What has no rows came from JSON as []: its other axes are unknown.
                    empty += len(shape) > 1
                    break
        if empty:
            self._complete_empty(length)
        return self

    def _complete_empty(self, length: dict[str, int]) -> None:
        """Give arrays without rows the other axes that the message gives them."""
        for field, axes in self._axes:
            value = getattr(self, field)
            if not isinstance(value, np.ndarray) or value.size:
                continue
            whole = tuple(length.get(a, n) if isinstance(a, str) else n for a, n in zip(axes, value.shape, strict=True))
            for axis, got, want in zip(axes, value.shape, whole, strict=True):
                if got not in (0, want):
                    raise _unequal(field, str(axis), got, want)
            self._make_empty(field, whole)

    def _make_empty(self, field: str, shape: tuple[int, ...]) -> None:
        array = np.zeros(shape, getattr(self, field).dtype)
        array.flags.writeable = False
        # The message is frozen for others only.
        self.__dict__[field] = array

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return all(_equal(getattr(self, f), getattr(other, f)) for f in type(self).model_fields)

    __hash__ = None  # type: ignore[assignment]


class TopMessage(Message):
    """A message that travels by itself: it has a schema id and a version."""

    most_bytes: ClassVar[int] = 64 * 2**20
    """Larger ones are refused unread."""

    schema_version: Annotated[int, Field(ge=1, le=1)] = 1

    @classmethod
    def schema_id(cls) -> str:
        """The schema's name as it stands in the encoding: ``trackmesh.PlotBatch.v1``."""
        return f"trackmesh.{cls.__name__}.v1"


def _unequal(field: str, axis: str, got: int, want: int) -> PydanticCustomError:
    return PydanticCustomError(
        "wrong_length",
        "{field} has {got} along its axis {axis}, where {want} are needed",
        {"field": field, "axis": axis, "got": got, "want": want},
    )


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and np.array_equal(a, b, equal_nan=True)
    return bool(a == b)
