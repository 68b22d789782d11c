"""The picture: frames of tracks, questions about it, what neighbouring units tell each other."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

import numpy as np
import numpy.typing as npt
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
from trackmesh.protocol.messages.base import BootId, Count, Finite, Id, Message, NonNegative, Seq, TopMessage, UnixNs
from trackmesh.protocol.messages.plots import Geodetic

TENTATIVE, CONFIRMED, COASTING, ENDED = 0, 1, 2, 3
"""Values of ``TrackFrame.status``."""

UNKNOWN_HEIGHT_M2 = 1e18
"""``TrackFrame.height_variance_m2`` of a track whose height is not known, in a frame where that of others is."""

TrackId = Annotated[int, Field(ge=0, le=2**53)]

_UPPER = np.triu_indices(6)


def symmetric(upper: npt.NDArray[np.float32]) -> FloatArray:
    """Upper triangles (n, 21), row by row, as full matrices (n, 6, 6)."""
    full = np.zeros((len(upper), 6, 6))
    full[:, _UPPER[0], _UPPER[1]] = upper
    full[:, _UPPER[1], _UPPER[0]] = upper
    return full


class TrackFrame(TopMessage):
    """One atomic picture: the tracks that a unit owns, predicted to ``t_ns``.

    ``state`` is [east_m, north_m, veast, vnorth, aeast, anorth] in the system plane; a filter without acceleration pads
    it, and its covariance, with zeros. ``covariance`` is the upper triangle of the 6x6 matrix, row by row;
    ``covariance_matrices()`` gives it whole. ``status`` is 0 tentative, 1 confirmed, 2 coasting, 3 ended. ``members``
    holds, per sensor of ``sensors``, the id of the local track that took the same plots, or -1. ``manoeuvre_fit`` is
    the weight of the models of turns and speed changes against a generic filter, where a filter has both. A track
    missing from a frame has not ended: only status 3, or silence, ends it.

    ``height_m`` is above the ellipsoid, or above the plane where there is no ``origin``; both height fields are None
    where no track has one. Where some have, the others have the height 0 with the variance ``UNKNOWN_HEIGHT_M2``.
    """

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    origin: Geodetic | None = None
    track_id: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0, le=2**53)]
    epoch: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    status: Annotated[UInt8Array, ArrayField("|u1", ("n",), le=3)]
    state: Annotated[FloatArray, ArrayField("<f8", ("n", 6))]
    covariance: Annotated[Float32Array, ArrayField("<f4", ("n", 21))]
    height_m: Annotated[FloatArray, ArrayField("<f8", ("n",))] | None = None
    height_variance_m2: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=0)] | None = None
    model_probability: Annotated[FloatArray, ArrayField("<f8", ("n", "r"), ge=0, le=1)]
    models: Annotated[list[str], Axis("r"), Field(fail_fast=True)]
    manoeuvre_fit: Annotated[FloatArray, ArrayField("<f8", ("n",), ge=0, le=1)] | None = None
    sensors: Annotated[list[Id], Axis("s"), Field(fail_fast=True)]
    members: Annotated[IntArray, ArrayField("<i8", ("n", "s"), ge=-1)]
    updated_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    first_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]

    def covariance_matrices(self) -> FloatArray:
        """Covariances as full symmetric matrices, shape (n, 6, 6)."""
        return symmetric(self.covariance)

    def height_known(self) -> npt.NDArray[np.bool_]:
        """Which tracks (n,) have a height."""
        if self.height_m is None or self.height_variance_m2 is None:
            return np.zeros(len(self.track_id), np.bool_)
        return np.asarray(self.height_variance_m2 < UNKNOWN_HEIGHT_M2)


class RefinedFrame(TopMessage):
    """Where tracks were some plots ago, as it is known now: each at a time of its own, refined by ``lag`` later plots.

    Only tracks that took a plot since the last such message are in it. ``state`` and ``covariance`` as in
    ``TrackFrame``.
    """

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    lag: Annotated[int, Field(ge=1, le=4)]
    track_id: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0, le=2**53)]
    state_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    state: Annotated[FloatArray, ArrayField("<f8", ("n", 6))]
    covariance: Annotated[Float32Array, ArrayField("<f4", ("n", 21))]

    def covariance_matrices(self) -> FloatArray:
        """Covariances as full symmetric matrices, shape (n, 6, 6)."""
        return symmetric(self.covariance)


class TrackQuery(TopMessage):
    """Which tracks are wanted; every condition given must hold, none given means all confirmed and coasting tracks.

    ``bbox_enu_m`` is [east, north, east, north] of the south-west and north-east corners, ``bbox_deg`` [latitude,
    longitude, latitude, longitude] of the same; ``at_t_ns`` predicts the picture to that time, ``max_age_s`` leaves out
    tracks whose last plot is older.
    """

    most_bytes: ClassVar[int] = 4 * 2**20

    track_ids: Annotated[list[TrackId], Field(max_length=100_000, fail_fast=True)] | None = None
    bbox_enu_m: Annotated[list[Finite], Field(min_length=4, max_length=4)] | None = None
    bbox_deg: Annotated[list[Finite], Field(min_length=4, max_length=4)] | None = None
    status: Annotated[list[Annotated[int, Field(ge=0, le=3)]], Field(max_length=4)] | None = None
    max_age_s: NonNegative | None = None
    at_t_ns: UnixNs | None = None


class HistoryQuery(TrackQuery):
    """Which past tracks are wanted: a ``TrackQuery`` over a span of time."""

    from_t_ns: UnixNs
    to_t_ns: UnixNs

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.to_t_ns < self.from_t_ns:
            raise PydanticCustomError("invalid", "to_t_ns must not be before from_t_ns")
        return self


class UnitArea(Message):
    """What a unit of a realm with several looks after.

    Its area is the Voronoi cell of ``centre_enu_m`` among those of the units that are active, or the convex polygon
    ``polygon_enu_m``; ``width_m`` is how far beyond it plots are taken. ``state`` is ``joining`` while the unit learns
    its tracks, ``active`` once it owns its area, ``standby`` if it waits for the active unit of the same area to die.
    """

    unit_number: Annotated[int, Field(ge=0, le=4095)]
    started_t_ns: UnixNs
    origin: Geodetic | None = None
    centre_enu_m: Annotated[FloatArray, ArrayField("<f8", (2,), ge=-1e9, le=1e9)]
    polygon_enu_m: Annotated[FloatArray, ArrayField("<f8", ("k", 2), ge=-1e9, le=1e9)] | None = None
    width_m: Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
    state: Literal["joining", "active", "standby"]


class BandFrame(TopMessage):
    """What a unit tells its neighbours: its area, and its confirmed tracks near the border with their last plots' keys.

    A unit without others near tells its area alone. ``plot_keys`` are those of the last plots, the youngest last, -1
    where there are fewer.
    """

    most_bytes: ClassVar[int] = 16 * 2**20

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    area: UnitArea
    track_id: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0, le=2**53)]
    owner: Annotated[UInt8Array, ArrayField("|u1", ("n",), le=1)]
    epoch: Annotated[UInt32Array, ArrayField("<u4", ("n",))]
    first_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    updated_t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    plot_keys: Annotated[IntArray, ArrayField("<i8", ("n", 6), ge=-1)]
    state: Annotated[Float32Array, ArrayField("<f4", ("n", 4))]
    covariance: Annotated[Float32Array, ArrayField("<f4", ("n", 10))]


class SensorBias(Message):
    """One sensor's estimated bias: [range_m, azimuth_rad] of a radar, [east_m, north_m] of a position sensor.

    What it measures minus what is true. ``time_offset_s`` is what has to be added to its times (0 with the sigma 0
    where clocks are taken to be right). ``notes`` say which of it the data cannot tell, and why.
    """

    sensor_id: Id
    columns: Annotated[list[str], Field(min_length=2, max_length=2)]
    bias: Annotated[FloatArray, ArrayField("<f8", (2,))]
    covariance: Annotated[FloatArray, ArrayField("<f8", (2, 2))]
    locked: bool
    pairs: Count
    jumps: Count
    notes: Annotated[list[str], Field(max_length=16, fail_fast=True)] = []
    time_offset_s: Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)] = 0.0
    time_offset_sigma_s: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)] = 0.0


class Registration(TopMessage):
    """A unit's present estimate of the biases of its sensors."""

    unit_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: UnixNs
    sensors: Annotated[list[SensorBias], Field(fail_fast=True)]
