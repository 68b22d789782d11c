"""What the engine knows of a sensor: where it stands in the system plane, how its plots get there, its clutter."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo
from trackmesh.services.estimation.convert import polar_to_plane
from trackmesh.services.estimation.plots import Plots, empty_plots, make_plots
from trackmesh.services.fusion.clutter import Clutter
from trackmesh.services.fusion.plane import place

FloatArray = npt.NDArray[np.float64]


class Sensor:
    """One sensor in the system plane.

    Attributes:
        index: its number within the engine.
        info: what it says of itself.
        site: (2,) east and north of it in the system plane.
        local_clutter, system_clutter: false plots, as its local tracks and the system tracks leave them.
    """

    def __init__(self, index: int, info: SensorInfo, origin: Geodetic | None, *, clutter_areas: bool = False) -> None:
        self.index = index
        self.info = info
        self.settle(origin)
        site = self.site if info.kind == "radar" else None
        self.local_clutter = Clutter(site, info.max_range_m, info.clutter_density, clutter_areas)
        self.system_clutter = Clutter(site, info.max_range_m, info.clutter_density, clutter_areas)

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

    def saw_nothing(self, share_of_look: float) -> None:
        """A batch without plots, that was this share of a whole look, came."""
        nothing = empty_plots((0,))
        for clutter in (self.local_clutter, self.system_clutter):
            clutter.add(nothing, np.zeros(0, np.bool_), share_of_look)

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
    return place(info.site, origin)
