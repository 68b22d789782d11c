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
from trackmesh.protocol.messages.tracks import symmetric

MAX_RANGES = 20_000

UNSURE, LOCATED, LOST, GONE = 0, 1, 2, 3
"""Values of ``TagFrame.status``."""


class RangeBatch(TopMessage):
    """Ranges, or signal strengths, measured in one network of readers.

    Number k is between tag ``tags[tag[k]]`` and reader ``readers[reader[k]]``; readers say where they stand by
    ``SensorInfo``. Either ``range_m`` is given, with ``variance_m2`` or without (then ``sigma`` of the reader holds),
    or ``rssi_dbm``.
    """

    network_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    tags: Annotated[list[Id], Field(max_length=MAX_RANGES, fail_fast=True)]
    readers: Annotated[list[Id], Field(max_length=MAX_RANGES, fail_fast=True)]
    tag: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    reader: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    range_m: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=-1e3, le=1e6)] | None = None
    variance_m2: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=1e-12, le=1e12)] | None = None
    rssi_dbm: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=-200, le=100)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n = len(self.t_ns)
        if n > MAX_RANGES:
            raise PydanticCustomError("too_large", "{n} ranges, at most {most} allowed", {"n": n, "most": MAX_RANGES})
        if n and (int(self.tag.max()) >= len(self.tags) or int(self.reader.max()) >= len(self.readers)):
            raise PydanticCustomError("out_of_bounds", "an index points beyond tags or readers")
        if (self.range_m is None) == (self.rssi_dbm is None):
            raise PydanticCustomError("missing_field", "give range_m or rssi_dbm, and not both")
        if self.rssi_dbm is not None and self.variance_m2 is not None:
            raise PydanticCustomError("invalid", "variance_m2 belongs to range_m")
        return self


class TagFrame(TopMessage):
    """One picture of the tags, predicted to ``t_ns``; ``state`` and ``covariance`` as in ``TrackFrame``.

    ``status`` is 0 unsure (at one of several places), 1 located, 2 lost (not heard for a while; the covariance grows),
    3 gone (told once). ``certainty`` is the weight of the place told among those that fit the ranges: 1, unless too few
    readers, or readers on one line, leave more than one. If there are two, ``other`` is the second one; if there are
    more, state and covariance are those of all together; else ``other`` is the position itself. ``quality`` is the
    share of late ranges that were not doubted. ``used`` has a row for each reader whose ranges a tag has used of late:
    the tag's row in this frame, and an index into ``readers``. ``range_bias_m`` and ``range_scale`` are what a tag's
    ranges have shown of a common error, where the service estimates it: range = (1 + scale) distance + bias.
    """

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    origin: Geodetic | None = None
    tag_id: Annotated[list[Id], Axis("n"), Field(fail_fast=True)]
    status: Annotated[UInt8Array, ArrayField("|u1", ("n",), le=3)]
    state: Annotated[FloatArray, ArrayField("<f8", ("n", 6))]
    covariance: Annotated[Float32Array, ArrayField("<f4", ("n", 21))]
    quality: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=0, le=1)]
    certainty: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=0, le=1)]
    other: Annotated[FloatArray, ArrayField("<f8", ("n", 2))]
    range_bias_m: Annotated[FloatArray, ArrayField("<f8", ("n",))] | None = None
    range_scale: Annotated[FloatArray, ArrayField("<f8", ("n",))] | None = None
    readers: Annotated[list[Id], Field(fail_fast=True)]
    used: Annotated[UInt32Array, ArrayField("<u4", ("m", 2))]
    updated_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]

    @model_validator(mode="after")
    def _points_within(self) -> Self:
        if len(self.used) and (self.used.max(axis=0) >= (len(self.tag_id), len(self.readers))).any():
            raise PydanticCustomError("out_of_bounds", "used points beyond the tags or the readers")
        return self

    def covariance_matrices(self) -> FloatArray:
        """Covariances as full symmetric matrices, shape (n, 6, 6)."""
        return symmetric(self.covariance)

    def readers_of(self, row: int) -> list[str]:
        """The readers whose ranges the tag in this row has used of late."""
        return [self.readers[k] for k in self.used[self.used[:, 0] == row, 1].tolist()]
