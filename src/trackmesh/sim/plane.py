"""Places in the plane: geodetic coordinates and plots as east and north metres about an origin.

The plane is the tangent plane of the WGS84 ellipsoid at the origin; a radar's slant range is taken as its ground range.
"""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo

SEMI_MAJOR_M = 6378137.0
ECCENTRICITY_SQUARED = 6.69437999014e-3


def geodetic_to_enu(geodetic: FloatArray, origin: Geodetic) -> FloatArray:
    """East, north, up (n, 3) in metres of places (n, 3) [latitude_deg, longitude_deg, height_m]."""
    x, y, z = (_ecef_m(geodetic) - _ecef_m(_row(origin))).T
    phi, lam = np.deg2rad(origin.latitude_deg), np.deg2rad(origin.longitude_deg)
    outward = x * np.cos(lam) + y * np.sin(lam)
    east = -x * np.sin(lam) + y * np.cos(lam)
    north, up = z * np.cos(phi) - outward * np.sin(phi), outward * np.cos(phi) + z * np.sin(phi)
    return np.stack([east, north, up], axis=1)


def place_enu_m(place: Geodetic, origin: Geodetic) -> tuple[float, float, float]:
    """East, north, up (m) of one place."""
    east, north, up = geodetic_to_enu(_row(place), origin)[0].tolist()
    return east, north, up


def site_enu_m(info: SensorInfo, origin: Geodetic | None) -> tuple[float, float] | None:
    """East, north (m) of a sensor's site, or None where it has none.

    Raises:
        TrackmeshError: the site is geodetic and no origin is known.
    """
    if info.site_enu_m is not None:
        return info.site_enu_m[0], info.site_enu_m[1]
    if info.site is None:
        return None
    return place_enu_m(info.site, _needed(origin, info.sensor_id))[:2]


def plot_positions(batch: PlotBatch, info: SensorInfo, origin: Geodetic | None) -> FloatArray:
    """East, north (n, 2) in metres of the plots of a batch.

    Raises:
        TrackmeshError: they cannot be placed, for want of an origin or a site.
    """
    first, second = batch.values[:, :2].T
    if batch.columns[0] == "east_m":
        return np.asarray(batch.values[:, :2])
    if batch.columns[0] == "latitude_deg":
        height = batch.values[:, 2] if len(batch.columns) > 2 else np.zeros(len(first))
        places = np.stack([first, second, height], axis=1)
        return geodetic_to_enu(places, _needed(origin, batch.sensor_id))[:, :2]
    site = site_enu_m(info, origin)
    if site is None:
        raise TrackmeshError(f"The sensor {info.sensor_id!r} has no site, so its ranges have no place.")
    direction = np.stack([np.sin(second), np.cos(second)], axis=1)
    return np.asarray(np.array(site) + first[:, None] * direction, np.float64)


def _ecef_m(geodetic: FloatArray) -> FloatArray:
    phi, lam = np.deg2rad(geodetic[:, 0]), np.deg2rad(geodetic[:, 1])
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(phi)
    up = (normal * (1.0 - ECCENTRICITY_SQUARED) + geodetic[:, 2]) * np.sin(phi)
    return np.stack([across * np.cos(lam), across * np.sin(lam), up], axis=1)


def _row(place: Geodetic) -> FloatArray:
    return np.array([[place.latitude_deg, place.longitude_deg, place.height_m]])


def _needed(origin: Geodetic | None, sensor_id: str) -> Geodetic:
    if origin is None:
        raise TrackmeshError(f"The sensor {sensor_id!r} speaks of latitudes, and the recording holds no origin.")
    return origin
