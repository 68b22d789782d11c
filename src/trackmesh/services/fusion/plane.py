"""Tangent planes of WGS84: where the origin of one lies in another, and how it is turned against it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.messages import Geodetic

FloatArray = npt.NDArray[np.float64]


def place(site: Geodetic, origin: Geodetic) -> tuple[FloatArray, FloatArray]:
    """The site (2,) in the plane of ``origin``, and the turn (2, 3) from its own east, north and up to that plane's."""
    where, turn = place_in_space(site, origin)
    return where[:2], turn[:2]


def place_in_space(site: Geodetic, origin: Geodetic) -> tuple[FloatArray, FloatArray]:
    """As ``place``, with the height above the plane: (3,), (3, 3)."""
    s, o = site, origin
    where = pymap3d.geodetic2enu(
        s.latitude_deg, s.longitude_deg, s.height_m, o.latitude_deg, o.longitude_deg, o.height_m
    )
    turn = np.empty((3, 3))
    for k, step in enumerate(np.eye(3).tolist()):
        u, v, w = pymap3d.enu2uvw(*step, s.latitude_deg, s.longitude_deg)
        turn[:, k] = _uvw2enu(float(u), float(v), float(w), o)
    return np.array([float(part) for part in where]), turn


def _uvw2enu(u: float, v: float, w: float, o: Geodetic) -> tuple[float, float, float]:
    lat, lon = np.deg2rad(o.latitude_deg), np.deg2rad(o.longitude_deg)
    along = np.cos(lon) * u + np.sin(lon) * v
    return (
        float(-np.sin(lon) * u + np.cos(lon) * v),
        float(-np.sin(lat) * along + np.cos(lat) * w),
        float(np.cos(lat) * along + np.sin(lat) * w),
    )
