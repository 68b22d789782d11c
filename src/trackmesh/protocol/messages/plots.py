"""What sensors say: who they are, and their plots."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from trackmesh.protocol.arrays import ArrayField, Axis, FloatArray, IntArray
from trackmesh.protocol.messages.base import (
    BootId,
    Count,
    Id,
    Message,
    Seq,
    TopMessage,
)

MAX_PLOTS = 20_000

COLUMN_BOUNDS: dict[str, tuple[float, float]] = {
    "range_m": (0.0, 1e9),
    "azimuth_rad": (-math.pi, 2 * math.pi),
    "elevation_rad": (-math.pi / 2, math.pi / 2),
    "range_rate_mps": (-1e5, 1e5),
    "east_m": (-1e9, 1e9),
    "north_m": (-1e9, 1e9),
    "up_m": (-1e9, 1e9),
    "latitude_deg": (-90.0, 90.0),
    "longitude_deg": (-180.0, 180.0),
    "height_m": (-1e5, 1e9),
}
"""Inclusive bounds of each column a plot may have."""

LARGEST_SIGMA = {"azimuth_rad": math.pi, "elevation_rad": math.pi}
"""Standard deviations of angles are bounded: beyond half a turn nothing is measured, and formulas overflow."""

COLUMN_SETS: tuple[tuple[str, ...], ...] = (
    ("range_m", "azimuth_rad"),
    ("range_m", "azimuth_rad", "elevation_rad"),
    ("range_m", "azimuth_rad", "range_rate_mps"),
    ("range_m", "azimuth_rad", "elevation_rad", "range_rate_mps"),
    ("east_m", "north_m"),
    ("east_m", "north_m", "up_m"),
    ("latitude_deg", "longitude_deg"),
    ("latitude_deg", "longitude_deg", "height_m"),
)
"""The column sets a batch may have, in this order."""


Label = Annotated[str, Field(max_length=64)]
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Speed = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Sigma = Annotated[float, Field(ge=1e-9, le=1e9, allow_inf_nan=False)]


class Geodetic(Message):
    """A place on WGS84."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
    height_m: Annotated[float, Field(ge=-1e5, le=1e9, allow_inf_nan=False)] = 0.0


class SensorInfo(TopMessage):
    """Who a sensor is: where it stands, how often it looks, how well it measures.

    ``sigma`` and ``interference`` give the standard deviation of a column by its name (``{"range_m": 50}``); for
    geodetic columns in metres east and north. ``clutter_density`` is false plots a look and square metre.
    """

    most_bytes: ClassVar[int] = 4 * 2**20

    sensor_id: Id
    kind: Literal["radar", "position", "ranging"]
    site: Geodetic | None = None
    site_enu_m: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = None
    period_s: Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
    p_detect: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)]
    max_range_m: Annotated[float, Field(ge=1e-3, le=1e9, allow_inf_nan=False)]
    sigma: dict[str, Sigma]
    interference: dict[str, Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]] | None = None
    clutter_density: Annotated[float, Field(ge=1e-18, le=1e6, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.kind in ("radar", "ranging") and self.site is None and self.site_enu_m is None:
            raise PydanticCustomError("missing_field", "a {kind} needs site or site_enu_m", {"kind": self.kind})
        if self.site is not None and self.site_enu_m is not None:
            raise PydanticCustomError("invalid", "give site or site_enu_m, not both")
        for name in [*self.sigma, *(self.interference or {})]:
            if name not in COLUMN_BOUNDS:
                raise PydanticCustomError("invalid", "unknown column {name}", {"name": name})
        for name, most in LARGEST_SIGMA.items():
            if self.sigma.get(name, 0.0) > most:
                raise PydanticCustomError("out_of_bounds", "sigma of {name} is above half a turn", {"name": name})
        return self


class ScanPart(Message):
    """Which turn, and which slice of it, a batch is."""

    index: Count
    sector: Count
    sectors: Annotated[int, Field(ge=1, le=65536)]

    @model_validator(mode="after")
    def _within(self) -> Self:
        if self.sector >= self.sectors:
            raise PydanticCustomError("out_of_bounds", "sector must be below sectors")
        return self


class PlotBatch(TopMessage):
    """What a sensor sends at once: a whole turn, or a slice of it.

    ``values`` has one row a plot and one column a name in ``columns`` (one of ``COLUMN_SETS``); ``variances`` likewise,
    in the square of the column's unit (metres squared for geodetic columns), or None, then ``SensorInfo.sigma`` holds.
    ``seq`` grows by one a batch within one ``boot_id``. ``site`` or ``site_enu_m`` say where the sensor stood for this
    batch, where that is not what ``SensorInfo`` says; ``site_velocity_enu_mps`` how it moved then, in the axes of that
    place, east, north and up: range rates are those relative to it.
    """

    sensor_id: Id
    boot_id: BootId
    seq: Seq
    t_ns: Annotated[IntArray, ArrayField("<i8", ("n",), ge=0)]
    columns: Annotated[list[str], Axis("c"), Field(min_length=2, max_length=4)]
    values: Annotated[FloatArray, ArrayField("<f8", ("n", "c"))]
    variances: Annotated[FloatArray, ArrayField("<f8", ("n", "c"), ge=1e-18, le=1e18)] | None = None
    labels: Annotated[list[Label], Axis("n"), Field(max_length=MAX_PLOTS, fail_fast=True)] | None = None
    scan: ScanPart | None = None
    site: Geodetic | None = None
    site_enu_m: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = None
    site_velocity_enu_mps: Annotated[list[Speed], Field(min_length=3, max_length=3)] | None = None

    @model_validator(mode="after")
    def _one_site(self) -> Self:
        if self.site is not None and self.site_enu_m is not None:
            raise PydanticCustomError("invalid", "give site or site_enu_m, not both")
        if self.site_velocity_enu_mps is not None and self.site is None and self.site_enu_m is None:
            raise PydanticCustomError("missing_field", "site_velocity_enu_mps needs site or site_enu_m")
        return self

    @model_validator(mode="after")
    def _columns_in_bounds(self) -> Self:
        if tuple(self.columns) not in COLUMN_SETS:
            raise PydanticCustomError("invalid", "columns must be one of the sets of the protocol")
        n = len(self.t_ns)
        if n > MAX_PLOTS:
            raise PydanticCustomError("too_large", "{n} plots, at most {most} allowed", {"n": n, "most": MAX_PLOTS})
        if n:
            self._check_values()
            self._check_angles()
        return self

    def _check_values(self) -> None:
        low, high = self.values.min(axis=0).tolist(), self.values.max(axis=0).tolist()
        for i, name in enumerate(self.columns):
            ge, le = COLUMN_BOUNDS[name]
            if low[i] < ge or high[i] > le:
                raise PydanticCustomError(
                    "out_of_bounds", "{name} must lie in [{ge}, {le}]", {"name": name, "ge": ge, "le": le}
                )

    def _check_angles(self) -> None:
        if self.variances is None:
            return
        for name, most in LARGEST_SIGMA.items():
            if name in self.columns and self.variances[:, self.columns.index(name)].max() > most * most:
                raise PydanticCustomError("out_of_bounds", "a variance of {name} is above pi^2", {"name": name})


__all__ = [
    "COLUMN_BOUNDS",
    "COLUMN_SETS",
    "MAX_PLOTS",
    "Geodetic",
    "PlotBatch",
    "ScanPart",
    "SensorInfo",
]
