"""Plots into the plane: polar to east and north with covariance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_UNBIAS_ABOVE_RAD = np.deg2rad(0.5)


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
    sin, cos = np.sin(azimuth_rad), np.cos(azimuth_rad)
    stretch = np.where(azimuth_variance_rad2 > _UNBIAS_ABOVE_RAD**2, np.exp(azimuth_variance_rad2 / 2.0), 1.0)
    across = rho * rho * azimuth_variance_rad2
    positions = np.stack([rho * sin, rho * cos], axis=1) * stretch[:, None]
    covariances = np.stack(
        [
            range_variance_m2 * sin * sin + across * cos * cos,
            (range_variance_m2 - across) * sin * cos,
            range_variance_m2 * cos * cos + across * sin * sin,
        ],
        axis=1,
    )
    return positions, covariances
