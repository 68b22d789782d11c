"""Plots into the plane: polar to east and north with covariance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

_UNBIAS_ABOVE_RAD2 = float(np.deg2rad(0.5)) ** 2


def polar_to_plane(
    range_m: FloatArray,
    azimuth_rad: FloatArray,
    elevation_rad: FloatArray | None,
    range_variance_m2: FloatArray,
    azimuth_variance_rad2: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Polar plots to the sensor's own tangent plane.

    east = rho sin az, north = rho cos az with the ground distance rho = range cos(elevation);
    R = s_r^2 e_r e_r^T + (rho s_az)^2 e_az e_az^T. Averaging over the azimuth error shortens the mean vector by
    exp(-s_az^2/2); it is divided out where s_az exceeds half a degree, below that it is smaller than the noise.

    Args:
        range_m: (n,) slant range.
        azimuth_rad: (n,) clockwise from north.
        elevation_rad: (n,) or None for level.
        range_variance_m2, azimuth_variance_rad2: (n,).

    Returns:
        positions (n, 2) [east_m, north_m], covariances (n, 3) [ee, en, nn] in m^2.
    """
    rho = range_m if elevation_rad is None else range_m * np.cos(elevation_rad)
    return _to_plane(rho, azimuth_rad, range_variance_m2, azimuth_variance_rad2)


@kernel
def _to_plane(
    rho: FloatArray, azimuth_rad: FloatArray, range_variance: FloatArray, azimuth_variance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    n = len(rho)
    positions, covariances = np.empty((n, 2)), np.empty((n, 3))
    for k in range(n):
        sin, cos, variance = np.sin(azimuth_rad[k]), np.cos(azimuth_rad[k]), azimuth_variance[k]
        stretch = np.exp(variance / 2.0) if variance > _UNBIAS_ABOVE_RAD2 else 1.0
        along, across = range_variance[k], rho[k] * rho[k] * variance
        positions[k, 0], positions[k, 1] = rho[k] * sin * stretch, rho[k] * cos * stretch
        covariances[k, 0] = along * sin * sin + across * cos * cos
        covariances[k, 1] = (along - across) * sin * cos
        covariances[k, 2] = along * cos * cos + across * sin * sin
    return positions, covariances
