"""What the places of a scan can tell at all: too few of them, absurd ones, those that see a mirror image as well."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.fields import from_elements, to_elements
from trackmesh.services.emi.kernels import BoolArray, FloatArray
from trackmesh.services.emi.sensor import Sensor

MIN_PLACES = 4
COLLINEAR = 1e-6
LEAST_SPACING_M, MOST_SPACING_M = 1e-3, 50.0
"""Spacings that are none of metres: positions told in another unit."""
ALL = slice(None)
UPRIGHT = np.array([0.0, 0.0, 1.0])


class Mirror(NamedTuple):
    """A plane that reflects a sensor, with all its coils, into itself: what it sees might be in front or behind.

    Attributes:
        normal: (3,) unit vector.
        height_m: distance of the plane from the origin, along it.
        sign: of the tensor in the mirror.
    """

    normal: FloatArray
    height_m: float
    sign: float


def absurdity(sensor: Sensor) -> str | None:
    """Why the places are no places: ``position_not_finite``, ``spacing``, or None."""
    if not (np.isfinite(sensor.tx_m).all() and np.isfinite(sensor.rx_m).all()):
        return "position_not_finite"
    unique = np.unique(sensor.place_m, axis=0)
    if len(unique) < 2:
        return None
    distance = np.median(KDTree(unique).query(unique, k=2)[0][:, 1])
    return None if LEAST_SPACING_M <= distance < MOST_SPACING_M else "spacing"


def coil_places(sensor: Sensor, there: BoolArray | slice = ALL) -> FloatArray:
    """Places (n, 3) of transmitters and receivers, each once, of all samples or of those that are ``there`` (W,)."""
    return np.unique(np.concatenate([sensor.tx_m[there], sensor.rx_m[there].reshape(-1, 3)]), axis=0)


def geometry_defect(places_m: FloatArray) -> str | None:
    """Why coils at ``places_m`` (n, 3), all different, cannot determine a target, or hardly.

    ``too_few_places``, ``collinear``, or None.
    """
    if len(places_m) < MIN_PLACES:
        return "too_few_places"
    return "collinear" if _extent(places_m)[1] <= COLLINEAR else None


def mirrors(sensor: Sensor) -> list[Mirror]:
    """The planes that reflect the sensor into itself.

    A reflection turns a field, which is axial, into that of the reflected coil. A coil whose centre lies in the plane
    keeps its axis if that is normal to it, and has it reversed if it lies within. The data u^T M h of a target
    stay the same if the same holds for all pairs of coils.
    """
    places = coil_places(sensor)
    middle = places.mean(0)
    found = []
    for normal in _normals(places - middle):
        tx, rx = _parity(sensor.tx_axis, normal), _parity(sensor.direction, normal)
        product = tx[:, None] * rx
        sign = float(product.flat[0])
        if sign and (product == sign).all():
            found.append(Mirror(normal, float(middle @ normal), sign))
    return found


def reflected(mirror: Mirror, position_m: FloatArray) -> FloatArray:
    """The image (3,) of a place."""
    return np.asarray(position_m - 2.0 * (position_m @ mirror.normal - mirror.height_m) * mirror.normal)


def reflection(mirror: Mirror, n_channels: int) -> FloatArray:
    """Linear map (3 + 6 C, 3 + 6 C) of small changes of position and tensors to those of the image."""
    R = np.eye(3) - 2.0 * np.outer(mirror.normal, mirror.normal)
    elements = np.stack([to_elements(mirror.sign * R @ from_elements(row) @ R) for row in np.eye(N_TENSOR)], 1)
    out = np.zeros((3 + N_TENSOR * n_channels,) * 2)
    out[:3, :3] = R
    for c in range(n_channels):
        m = slice(3 + N_TENSOR * c, 9 + N_TENSOR * c)
        out[m, m] = elements
    return out


def _normals(centred_m: FloatArray) -> list[FloatArray]:
    axes = np.linalg.eigh(centred_m.T @ centred_m)[1].T[::-1]
    extent = _extent(centred_m)
    if extent[1] <= COLLINEAR:
        along = axes[0]
        across = np.cross(along, UPRIGHT)
        if np.linalg.norm(across) <= COLLINEAR:
            return []
        across = across / np.linalg.norm(across)
        return [across, np.cross(across, along)]
    return [axes[2]] if extent[2] <= COLLINEAR else []


def _extent(places_m: FloatArray) -> FloatArray:
    """Singular values (3,) of the places about their mean, by the largest."""
    values = np.zeros(3)
    found = np.linalg.svd(places_m - places_m.mean(0), compute_uv=False)
    values[: len(found)] = found
    return np.asarray(values / max(values[0], 1e-300))


def _parity(axes: FloatArray, normal: FloatArray) -> FloatArray:
    """-1 for axes (..., 3) along the normal, 1 for those within the plane, else 0."""
    along = np.abs(axes @ normal)
    return np.where(along > 1.0 - COLLINEAR, -1.0, np.where(along < COLLINEAR, 1.0, 0.0))
