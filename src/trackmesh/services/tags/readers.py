"""The readers of an engine: where they stand in its plane, how well they measure; they may come, move and go."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.messages import Geodetic, SensorInfo

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Readers:
    """Rows of readers. One that moves gets a new row: what it measured before, it measured from where it stood.

    Args:
        origin: of the plane; None: that of the first geodetic site, which is there then.
        tag_height_m: height of the tags above the plane; None: ranges are taken along the plane.
        sigma_m: noise of readers that tell none.
    """

    def __init__(self, origin: Geodetic | None, tag_height_m: float | None, sigma_m: float) -> None:
        self.origin = origin
        self.infos: dict[str, SensorInfo] = {}
        self.row: dict[str, int] = {}
        self.names: list[str] = []
        self.place = np.empty((0, 3))
        self.variance = np.empty(0)
        self.reach_m = np.empty(0)
        self._tag_height_m = tag_height_m
        self._sigma_m = sigma_m

    def add(self, info: SensorInfo) -> bool:
        """Take note of a reader, new or changed; whether anything did change."""
        if self.infos.get(info.sensor_id) == info:
            return False
        if self.origin is None and info.site is not None:
            self.origin = info.site
        self.infos[info.sensor_id] = info
        self.row[info.sensor_id] = len(self.names)
        self.names.append(info.sensor_id)
        sigma = info.sigma.get("range_m", self._sigma_m)
        self.place = np.vstack([self.place, self._place(info)])
        self.variance = np.append(self.variance, sigma * sigma)
        self.reach_m = np.append(self.reach_m, info.max_range_m)
        return True

    def drop(self, reader_id: str) -> bool:
        """Forget a reader; whether it was known."""
        self.row.pop(reader_id, None)
        return self.infos.pop(reader_id, None) is not None

    def rows(self, names: Iterable[str]) -> IntArray:
        """Rows of readers by name, -1 for those that are not known."""
        return np.array([self.row.get(name, -1) for name in names], np.int64)

    def _place(self, info: SensorInfo) -> FloatArray:
        """East, north and height above the tags."""
        if info.site_enu_m is not None:
            east, north, up = info.site_enu_m
        else:
            assert info.site is not None and self.origin is not None
            s, o = info.site, self.origin
            found = pymap3d.geodetic2enu(
                s.latitude_deg, s.longitude_deg, s.height_m, o.latitude_deg, o.longitude_deg, o.height_m
            )
            east, north, up = (float(value) for value in found)
        return np.array([east, north, 0.0 if self._tag_height_m is None else up - self._tag_height_m])
