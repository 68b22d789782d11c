"""What a unit can be told of its area, and how wide the band must be in which neighbours track the same targets."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from trackmesh.protocol.messages import Geodetic
from trackmesh.protocol.messages.base import Finite, Positive
from trackmesh.services.fusion.partition.areas import Place, convex
from trackmesh.services.fusion.plane import place

Pair = Annotated[list[Finite], Field(min_length=2, max_length=2)]

_GATE_SIGMAS = 4.5
_LEAST_HANDOVERS = 3.0
_GRACE_CYCLES = 2


class PartitionSettings(BaseModel):
    """The area of one of several units, all of which share one system plane."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    centre_enu_m: Pair | None = Field(None, description="[east, north] of this unit's Voronoi cell")
    centre_deg: Pair | None = Field(None, description="the same as [latitude, longitude]; needs origin")
    polygon_enu_m: Annotated[list[Pair], Field(min_length=3, max_length=64)] | None = Field(
        None, description="corners of a convex area instead"
    )
    polygon_deg: Annotated[list[Pair], Field(min_length=3, max_length=64)] | None = Field(
        None, description="the same as [latitude, longitude]; needs origin"
    )
    standby: bool = Field(False, description="wait for the active unit of the same area to die, and go on for it")
    handover_m: Positive = Field(
        1000.0, description="a track is taken over so deep inside the area: 5 sigma of a position at least"
    )
    speed_max_mps: Positive = Field(250.0, description="fastest target")
    confirm_s: Positive = Field(15.0, description="how long a new track takes to be confirmed")
    sigma_m: Positive = Field(150.0, description="error of a plot far from its sensor, one sigma")
    reach_m: Positive = Field(80_000.0, description="range at which azimuth biases are reckoned")
    width_m: Positive | None = Field(
        None, description="how far beyond the area plots are taken; default: computed from the settings above"
    )

    @model_validator(mode="after")
    def _one_area(self) -> Self:
        given = [self.centre_enu_m, self.centre_deg, self.polygon_enu_m, self.polygon_deg]
        if sum(one is not None for one in given) != 1:
            raise ValueError("a unit has one of centre_enu_m, centre_deg, polygon_enu_m and polygon_deg")
        if self.polygon_enu_m is not None:
            convex(np.array(self.polygon_enu_m))
        if self.width_m is not None and self.width_m < _LEAST_HANDOVERS * self.handover_m:
            raise ValueError(
                f"a band {self.width_m:g} m wide is too narrow for handovers {self.handover_m:g} m deep: "
                f"width_m must be {_LEAST_HANDOVERS * self.handover_m:g} m at least"
            )
        return self

    @property
    def geographic(self) -> bool:
        """Whether an origin is needed."""
        return self.centre_deg is not None or self.polygon_deg is not None

    def place(self, origin: Geodetic | None) -> Place:
        """The area in the plane of ``origin``.

        Raises:
            ValueError: it is geographic and there is no origin, or its polygon is not convex.
        """
        corners = None if self.polygon_enu_m is None else np.array(self.polygon_enu_m, float)
        if self.polygon_deg is not None:
            corners = np.array([_in_plane(one, origin) for one in self.polygon_deg])
        if corners is not None:
            convex(corners)
            return Place(corners.mean(axis=0), corners)
        if self.centre_deg is not None:
            return Place(_in_plane(self.centre_deg, origin))
        return Place(np.array(self.centre_enu_m, float))

    def width(self, cycle_s: float, bias_range_m: float, bias_azimuth_rad: float) -> float:
        """How far beyond its area a unit must take plots.

        W = H + v_max (T_confirm + 2 cycles) + 4.5 sigma + bias: when a target is H inside, the track of whoever takes
        it over has long been confirmed and has changed its id for the owner's, whatever the bias.
        """
        if self.width_m is not None:
            return self.width_m
        flown_m = self.speed_max_mps * (self.confirm_s + _GRACE_CYCLES * cycle_s)
        bias_m = bias_range_m + bias_azimuth_rad * self.reach_m
        width_m = self.handover_m + flown_m + _GATE_SIGMAS * self.sigma_m + bias_m
        return max(width_m, _LEAST_HANDOVERS * self.handover_m)


def _in_plane(pair: Pair, origin: Geodetic | None) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if origin is None:
        raise ValueError("an area in degrees needs the setting origin")
    where, _ = place(Geodetic(latitude_deg=pair[0], longitude_deg=pair[1], height_m=0.0), origin)
    return np.asarray(where, np.float64)
