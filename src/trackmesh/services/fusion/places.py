"""Where a sensor stands in the system plane, and how what it sees gets there.

The system plane is the tangent plane of WGS84 at the origin. What a geodetic site calls east, north and up is turned
against it; a site that is given in the plane shares its axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic
from trackmesh.services.estimation.convert import polar_to_plane
from trackmesh.services.fusion.plane import place_in_space

FloatArray = npt.NDArray[np.float64]

EARTH_RADIUS_M = 6_371_000.0


class Place(NamedTuple):
    """Where a sensor stands.

    Attributes:
        site: (3,) east, north and up of it in the system plane.
        turn: (3, 3) from its own east, north and up to those of the plane; None where they are the same.
        velocity: (3,) its own motion, in the axes of the plane.
    """

    site: FloatArray
    turn: FloatArray | None
    velocity: FloatArray


NOWHERE = Place(np.zeros(3), None, np.zeros(3))
"""Of a sensor that says nothing of its place."""


def in_plane(site_enu_m: Sequence[float], velocity_enu_mps: Sequence[float] | None = None) -> Place:
    """The place of a site that is given in the plane."""
    return Place(np.array(site_enu_m, float), None, np.array(velocity_enu_mps or (0.0, 0.0, 0.0), float))


def on_earth(site: Geodetic, origin: Geodetic, velocity_enu_mps: Sequence[float] | None = None) -> Place:
    """The place of a geodetic site; its velocity is along its own east, north and up."""
    where, turn = place_in_space(site, origin)
    velocity = turn @ np.array(velocity_enu_mps) if velocity_enu_mps else np.zeros(3)
    return Place(where, turn, velocity)


# --- polar plots ---


def polar_plots(
    place: Place, values: FloatArray, variances: FloatArray, elevation_rad: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Positions (n, 2) and covariances (n, 3) in the plane of polar plots.

    Args:
        place: of the sensor.
        values, variances: (n, >= 2), of which the first are those of range and azimuth, and the third of the elevation
            if there is one.
        elevation_rad: (n,), or None for level.
    """
    along = variances[:, 0] if elevation_rad is None else _ground_variance(values[:, 0], elevation_rad, variances)
    z, R = polar_to_plane(values[:, 0], values[:, 1], elevation_rad, along, variances[:, 1])
    if place.turn is None:
        return z + place.site[:2], R
    level, tilt = place.turn[:2, :2], place.turn[:2, 2]
    z = z @ level.T + place.site[:2]
    if elevation_rad is not None:
        z += np.outer(values[:, 0] * np.sin(elevation_rad), tilt)
    full = np.stack([R[:, 0], R[:, 1], R[:, 1], R[:, 2]], axis=1).reshape(-1, 2, 2)
    full = level @ full @ level.T
    return z, np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=1)


def _ground_variance(range_m: FloatArray, elevation_rad: FloatArray, variances: FloatArray) -> FloatArray:
    """Variance (n,) of r cos(el): cos^2 s_r^2 + r^2 sin^2 s_el^2; that of the range where s_el is not known."""
    if not np.isfinite(variances[:, 2]).all():
        return variances[:, 0]
    cos, across = np.cos(elevation_rad), range_m * np.sin(elevation_rad)
    return np.asarray(cos * cos * variances[:, 0] + across * across * variances[:, 2])


def polar_up(place: Place, range_m: FloatArray, azimuth_rad: FloatArray, elevation_rad: FloatArray) -> FloatArray:
    """How far (n,) above the system plane polar plots lie."""
    up, ground = range_m * np.sin(elevation_rad), range_m * np.cos(elevation_rad)
    if place.turn is None:
        return np.asarray(place.site[2] + up)
    own = np.stack([ground * np.sin(azimuth_rad), ground * np.cos(azimuth_rad), up])
    return np.asarray(place.site[2] + place.turn[2] @ own)


def polar_height_variance(
    range_m: FloatArray, elevation_rad: FloatArray, range_variance: FloatArray, elevation_variance: FloatArray
) -> FloatArray:
    """Variance (n,) of the height of polar plots above the Earth.

    With el' = el + r cos(el) / R_E, the elevation at which the line of sight passes the target's own horizon:
    dh = sin(el') dr + r cos(el') d el.
    """
    at_target = elevation_rad + range_m * np.cos(elevation_rad) / EARTH_RADIUS_M
    along, across = np.sin(at_target), range_m * np.cos(at_target)
    return np.asarray(along * along * range_variance + across * across * elevation_variance)


# --- geodetic plots and heights ---


def geodetic_plots(values: FloatArray, origin: Geodetic | None) -> FloatArray:
    """Positions (n, 2) in the plane of geodetic plots: latitude, longitude (degrees) and, or else 0, height.

    Raises:
        RefusedMessage: there is no origin.
    """
    if origin is None:
        raise RefusedMessage("no_origin", "Geodetic plots need an origin of the system plane.")
    o = origin
    height = values[:, 2] if values.shape[1] > 2 else np.zeros(len(values))
    east, north, _ = pymap3d.geodetic2enu(
        values[:, 0], values[:, 1], height, o.latitude_deg, o.longitude_deg, o.height_m
    )
    return np.stack([east, north], axis=1)


def height(z: FloatArray, up_m: FloatArray, origin: Geodetic | None) -> FloatArray:
    """Heights (n,) of what is ``up_m`` (n,) above the plane at z (n, 2): above the ellipsoid; above the plane without.

    The plane leaves the Earth: d^2 / 2 R_E, 785 m at 100 km.
    """
    if origin is None:
        return up_m
    o = origin
    _, _, found = pymap3d.enu2geodetic(z[:, 0], z[:, 1], up_m, o.latitude_deg, o.longitude_deg, o.height_m)
    return np.asarray(found, float)
