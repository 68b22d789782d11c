"""What the engine knows of a sensor: where it stands in the system plane, how its plots get there, its clutter."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo
from trackmesh.services.estimation.plots import Plots, empty_plots, make_plots
from trackmesh.services.estimation.uncertain import NoiseModel
from trackmesh.services.fusion import places
from trackmesh.services.fusion.accuracy import Accuracy
from trackmesh.services.fusion.clutter import Clutter
from trackmesh.services.fusion.places import NOWHERE, Place

FloatArray = npt.NDArray[np.float64]

_LEAST_HEIGHT_VARIANCE_M2 = 1e-6


class Sensor:
    """One sensor in the system plane.

    Attributes:
        index: its number within the engine.
        info: what it says of itself.
        site: (2,) east and north of it in the system plane: where it stood for its newest plots.
        local_clutter, system_clutter: false plots, as its local tracks and the system tracks leave them.
    """

    def __init__(
        self,
        index: int,
        info: SensorInfo,
        origin: Geodetic | None,
        *,
        clutter_areas: bool = False,
        noise_model: NoiseModel = "gaussian",
    ) -> None:
        self.index = index
        self.info = info
        self._accuracy = Accuracy(info, noise_model)
        self.site = np.zeros(2)
        self._stood_s = -np.inf
        self.settle(origin)
        site = self.site if info.kind == "radar" else None
        self.local_clutter = Clutter(site, info.max_range_m, info.clutter_density, clutter_areas)
        self.system_clutter = Clutter(site, info.max_range_m, info.clutter_density, clutter_areas)

    def take_over(self, old: Sensor) -> None:
        """Go on with what was learnt of the clutter, if the sensor looks as far as before and declares no other.

        Where it stood last is forgotten only if it announces another site.
        """
        if (old.info.site, old.info.site_enu_m) == (self.info.site, self.info.site_enu_m):
            self.site, self._stood_s = old.site, old._stood_s
        if _coverage(old.info) == _coverage(self.info):
            self.local_clutter, self.system_clutter = old.local_clutter, old.system_clutter
            self._clutter_follows()

    def settle(self, origin: Geodetic | None) -> None:
        """Place the sensor in the plane of this origin, which may be known only after the sensor."""
        self._origin = origin
        self._home = self._announced_place()
        if not np.isfinite(self._stood_s):
            self.site = self._home.site[:2]

    def _announced_place(self) -> Place:
        if self.info.site_enu_m is not None:
            return places.in_plane(self.info.site_enu_m)
        if self.info.site is None or self._origin is None:
            return NOWHERE
        return places.on_earth(self.info.site, self._origin)

    def stood(self, site_m: FloatArray, t_s: float) -> bool:
        """Take note of where it stood for plots of a time; whether it stands elsewhere now than it did.

        Of late plots, which say where it was, nothing is noted.
        """
        if t_s < self._stood_s:
            return False
        elsewhere = bool(site_m[0] != self.site[0] or site_m[1] != self.site[1])
        self.site, self._stood_s = site_m.copy(), t_s
        if elsewhere:
            self._clutter_follows()
        return elsewhere

    def where_it_stood(self) -> FloatArray:
        """(3,) its site for its newest plots and their time, to be known after a restart."""
        return np.array([*self.site, self._stood_s])

    def stands_again(self, stood: FloatArray) -> None:
        """Go on with what ``where_it_stood`` gave."""
        self.site, self._stood_s = stood[:2].copy(), float(stood[2])

    def _clutter_follows(self) -> None:
        for clutter in (self.local_clutter, self.system_clutter):
            clutter.follow(self.site)

    def saw_nothing(self, share_of_look: float) -> None:
        """A batch without plots, that was this share of a whole look, came."""
        nothing = empty_plots((0,))
        for clutter in (self.local_clutter, self.system_clutter):
            clutter.add(nothing, np.zeros(0, np.bool_), share_of_look)

    def plots(self, batch: PlotBatch, t_s: FloatArray) -> Plots:
        """The plots of a batch in the system plane, at times (n,) of the engine.

        Range rates and heights are taken where their variances are known.

        Raises:
            RefusedMessage: the batch cannot be placed: no variances, no site, no origin.
        """
        variances, place = self._accuracy.variances(batch), self._place(batch)
        z, R = self._placed(batch, variances, place)
        plots = make_plots(z, R, t_s, self.index)
        plots["site"] = place.site[:2]
        if batch.site_velocity_enu_mps is not None:
            plots["site_velocity"] = place.velocity[:2]
        if "range_rate_mps" in batch.columns:
            self._add_range_rates(plots, batch, variances, place)
        self._add_heights(plots, batch, variances, place)
        return plots

    def plane(self, batch: PlotBatch) -> tuple[FloatArray, FloatArray]:
        """Positions (n, 2) and covariances (n, 3) of a batch in the system plane.

        Raises:
            RefusedMessage: the batch cannot be placed: no variances, no site, no origin.
        """
        return self._placed(batch, self._accuracy.variances(batch), self._place(batch))

    def _place(self, batch: PlotBatch) -> Place:
        """Where the sensor stood for a batch: as that says, else as announced."""
        if batch.site_enu_m is not None:
            return places.in_plane(batch.site_enu_m, batch.site_velocity_enu_mps)
        if batch.site is None:
            return self._home
        if self._origin is None:
            raise RefusedMessage("no_origin", "A geodetic site needs an origin of the system plane.")
        return places.on_earth(batch.site, self._origin, batch.site_velocity_enu_mps)

    def _placed(self, batch: PlotBatch, variances: FloatArray, place: Place) -> tuple[FloatArray, FloatArray]:
        if batch.columns[0] == "range_m":
            if place is NOWHERE:
                raise RefusedMessage("no_site", f"Sensor {self.info.sensor_id} sends polar plots but has no site.")
            return places.polar_plots(place, batch.values, variances, _column(batch, "elevation_rad"))
        if batch.columns[0] == "east_m":
            z = np.ascontiguousarray(batch.values[:, :2])
        else:
            z = places.geodetic_plots(batch.values, self._origin)
        return z, np.stack([variances[:, 0], np.zeros(len(z)), variances[:, 1]], axis=1)

    def _add_range_rates(self, plots: Plots, batch: PlotBatch, variances: FloatArray, place: Place) -> None:
        column = batch.columns.index("range_rate_mps")
        plots["range_rate_mps"] = batch.values[:, column]
        plots["range_rate_variance"] = variances[:, column]
        elevation = _column(batch, "elevation_rad")
        if elevation is not None:
            plots["level"] = np.cos(elevation)
            # The filter knows of the plane only: what the sensor's own climb does is taken off here.
            plots["range_rate_mps"] += np.sin(elevation) * place.velocity[2]

    def _add_heights(self, plots: Plots, batch: PlotBatch, variances: FloatArray, place: Place) -> None:
        if len(batch.columns) == 2 or batch.columns[2] == "range_rate_mps":
            return
        if not np.isfinite(variances[:, 2]).all():
            return
        height, variance = batch.values[:, 2], variances[:, 2]
        if batch.columns[2] == "elevation_rad":
            range_m, azimuth, elevation = batch.values[:, :3].T
            variance = places.polar_height_variance(range_m, elevation, variances[:, 0], variance)
            height = places.height(plots["z"], places.polar_up(place, range_m, azimuth, elevation), self._origin)
        elif batch.columns[2] == "up_m":
            height = places.height(plots["z"], height, self._origin)
        plots["height_m"] = height
        plots["height_variance_m2"] = np.maximum(variance, _LEAST_HEIGHT_VARIANCE_M2)


def _coverage(info: SensorInfo) -> tuple[object, ...]:
    return info.kind, info.max_range_m, info.clutter_density


def _column(batch: PlotBatch, name: str) -> FloatArray | None:
    return batch.values[:, batch.columns.index(name)] if name in batch.columns else None
