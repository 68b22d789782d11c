"""RFID/UWB: ranges between tags and readers, and the tags located from them."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from trackmesh.protocol.arrays import (
    ArrayField,
    Axis,
    Float32Array,
    FloatArray,
    IntArray,
    UInt8Array,
    UInt32Array,
)
from trackmesh.protocol.messages.base import BootId, Id, Seq, TopMessage, UnixNs
from trackmesh.protocol.messages.plots import Geodetic

MAX_RANGES = 20_000


class RangeBatch(TopMessage):
    """Ranges measured in one network of readers.

    Range k is between tag ``tags[tag[k]]`` and reader ``readers[reader[k]]``; readers say where they stand by
    ``SensorInfo``.
    """

    network_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    tags: Annotated[list[Id], Field(max_length=MAX_RANGES, fail_fast=True)]
    readers: Annotated[list[Id], Field(max_length=MAX_RANGES, fail_fast=True)]
    tag: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    reader: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    range_m: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=-1e3, le=1e6)]
    variance_m2: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=1e-12, le=1e12)] | None = None

    @model_validator(mode="after")
    def _indices(self) -> Self:
        n = len(self.t_ns)
        if n > MAX_RANGES:
            raise PydanticCustomError("too_large", "{n} ranges, at most {most} allowed", {"n": n, "most": MAX_RANGES})
        if n and (int(self.tag.max()) >= len(self.tags) or int(self.reader.max()) >= len(self.readers)):
            raise PydanticCustomError("out_of_bounds", "an index points beyond tags or readers")
        return self


class TagFrame(TopMessage):
    """One picture of the tags; state and covariance as in ``TrackFrame``."""

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    origin: Geodetic | None = None
    tag_id: Annotated[list[Id], Axis("n"), Field(fail_fast=True)]
    status: Annotated[UInt8Array, ArrayField("|u1", ("n",), le=3)]
    state: Annotated[FloatArray, ArrayField("<f8", ("n", 6))]
    covariance: Annotated[Float32Array, ArrayField("<f4", ("n", 21))]
    updated_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
