"""What the engine knows of a sensor: where it stands in the system plane, how its plots get there, its clutter."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo
from trackmesh.services.estimation.convert import polar_to_plane
from trackmesh.services.estimation.plots import Plots, make_plots

FloatArray = npt.NDArray[np.float64]

_LOOKS_REMEMBERED = 5.0


class ClutterDensity:
    """False plots a look and square metre: an exponential mean over the last looks.

    Counted are the plots that no confirmed track took; at a cold start these are all, so that nothing is confirmed too
    easily.
    """

    def __init__(self, area_m2: float, declared: float | None) -> None:
        self._area_m2 = area_m2
        self._floor = 0.5 / area_m2
        self._plots = (declared or 0.0) * area_m2
        self._area_seen_m2 = area_m2 if declared else 0.0

    def add(self, plots: int, share_of_look: float) -> None:
        """Count the unexplained plots of a batch that was this share of a whole look."""
        keep = np.exp(-share_of_look / _LOOKS_REMEMBERED)
        self._plots = self._plots * keep + plots
        self._area_seen_m2 = self._area_seen_m2 * keep + share_of_look * self._area_m2

    def value(self, plots_now: int, share_of_look: float) -> float:
        """The present estimate, 1/m^2; before any batch was counted, that of the batch at hand."""
        if self._area_seen_m2 == 0.0:
            return max(plots_now / (share_of_look * self._area_m2), self._floor)
        return max(self._plots / self._area_seen_m2, self._floor)


class Sensor:
    """One sensor in the system plane.

    Attributes:
        index: its number within the engine.
        info: what it says of itself.
        site: (2,) east and north of it in the system plane.
    """

    def __init__(self, index: int, info: SensorInfo, origin: Geodetic | None) -> None:
        self.index = index
        self.info = info
        self.settle(origin)
        area = np.pi * info.max_range_m**2
        self.local_clutter = ClutterDensity(area, info.clutter_density)
        self.system_clutter = ClutterDensity(area, info.clutter_density)

    def settle(self, origin: Geodetic | None) -> None:
        """Place the sensor in the plane of this origin, which may be known only after the sensor."""
        self.site, self._turn = _place(self.info, origin)
        self._origin = origin

    def plots(self, batch: PlotBatch, t_s: FloatArray) -> Plots:
        """The plots of a batch in the system plane, at times (n,) of the engine.

        A range rate is taken where its variance is known.

        Raises:
            RefusedMessage: the batch cannot be placed: no variances, no site, no origin.
        """
        z, R = self.plane(batch)
        plots = make_plots(z, R, t_s, self.index)
        if "range_rate_mps" in batch.columns:
            column = batch.columns.index("range_rate_mps")
            plots["range_rate_mps"] = batch.values[:, column]
            plots["range_rate_variance"] = self._range_rate_variance(batch, column)
            plots["site"] = self.site
            if "elevation_rad" in batch.columns:
                plots["level"] = np.cos(batch.values[:, batch.columns.index("elevation_rad")])
        return plots

    def _range_rate_variance(self, batch: PlotBatch, column: int) -> FloatArray | float:
        if batch.variances is not None:
            return batch.variances[:, column]
        return float(self.info.sigma.get("range_rate_mps", np.inf)) ** 2

    def plane(self, batch: PlotBatch) -> tuple[FloatArray, FloatArray]:
        """Positions (n, 2) and covariances (n, 3) of a batch in the system plane.

        Raises:
            RefusedMessage: the batch cannot be placed: no variances, no site, no origin.
        """
        variances = self._variances(batch)
        first = batch.columns[0]
        if first == "range_m":
            return self._polar(batch, variances)
        z = np.ascontiguousarray(batch.values[:, :2]) if first == "east_m" else self._geodetic(batch)
        return z, np.stack([variances[:, 0], np.zeros(len(z)), variances[:, 1]], axis=1)

    def _variances(self, batch: PlotBatch) -> FloatArray:
        if batch.variances is not None:
            return batch.variances
        # Variances go east, north; of geodetic columns the second, longitude, is east.
        names = batch.columns[:2] if batch.columns[0] != "latitude_deg" else ["longitude_deg", "latitude_deg"]
        for name in names:
            if name not in self.info.sigma:
                raise RefusedMessage(
                    "no_variance", f"Sensor {self.info.sensor_id} gives neither variances nor sigma of {name}."
                )
        out = np.empty((len(batch.values), 2))
        out[:, 0], out[:, 1] = (self.info.sigma[name] ** 2 for name in names)
        return out

    def _polar(self, batch: PlotBatch, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self.info.site is None and self.info.site_enu_m is None:
            raise RefusedMessage("no_site", f"Sensor {self.info.sensor_id} sends polar plots but has no site.")
        elevation = batch.values[:, 2] if "elevation_rad" in batch.columns else None
        z, R = polar_to_plane(batch.values[:, 0], batch.values[:, 1], elevation, variances[:, 0], variances[:, 1])
        if self._turn is None:
            return z + self.site, R
        level, tilt = self._turn[:, :2], self._turn[:, 2]
        z = z @ level.T + self.site
        if elevation is not None:
            z += np.outer(batch.values[:, 0] * np.sin(elevation), tilt)
        full = np.stack([R[:, 0], R[:, 1], R[:, 1], R[:, 2]], axis=1).reshape(-1, 2, 2)
        full = level @ full @ level.T
        return z, np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=1)

    def _geodetic(self, batch: PlotBatch) -> FloatArray:
        if self._origin is None:
            raise RefusedMessage("no_origin", "Geodetic plots need an origin of the system plane.")
        o = self._origin
        height = batch.values[:, 2] if batch.values.shape[1] > 2 else np.zeros(len(batch.values))
        east, north, _ = pymap3d.geodetic2enu(
            batch.values[:, 0], batch.values[:, 1], height, o.latitude_deg, o.longitude_deg, o.height_m
        )
        return np.stack([east, north], axis=1)


def _place(info: SensorInfo, origin: Geodetic | None) -> tuple[FloatArray, FloatArray | None]:
    """The site in the system plane, and the (2, 3) turn from the site's own east, north and up to its."""
    if info.site_enu_m is not None:
        return np.array(info.site_enu_m[:2], float), None
    if info.site is None or origin is None:
        return np.zeros(2), None
    s, o = info.site, origin
    east, north, _ = pymap3d.geodetic2enu(
        s.latitude_deg, s.longitude_deg, s.height_m, o.latitude_deg, o.longitude_deg, o.height_m
    )
    turn = np.empty((2, 3))
    for k, step in enumerate(np.eye(3).tolist()):
        u, v, w = pymap3d.enu2uvw(*step, s.latitude_deg, s.longitude_deg)
        east_k, north_k, _ = _uvw2enu(float(u), float(v), float(w), o)
        turn[:, k] = east_k, north_k
    return np.array([float(east), float(north)]), turn


def _uvw2enu(u: float, v: float, w: float, o: Geodetic) -> tuple[float, float, float]:
    lat, lon = np.deg2rad(o.latitude_deg), np.deg2rad(o.longitude_deg)
    along = np.cos(lon) * u + np.sin(lon) * v
    return (
        float(-np.sin(lon) * u + np.cos(lon) * v),
        float(-np.sin(lat) * along + np.cos(lat) * w),
        float(np.cos(lat) * along + np.sin(lat) * w),
    )
