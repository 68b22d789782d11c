"""Process noise over an interval, for motion along one axis: position, velocity and acceleration.

A block is (6,): [pp, pv, pa, vv, va, aa], the upper triangle of a symmetric 3x3 matrix.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

SERIES_BELOW = 0.05


@kernel
def singer_noise(sd: float, time_s: float, dt_s: float, out: FloatArray) -> None:
    """Write the noise of an acceleration that decays with ``time_s`` about its mean, with standard deviation ``sd``.

    Singer (1970), closed form; below u = dt/time = 0.05 its series to u^2 about the white jerk of density 2 sd^2/time,
    since there the closed form is a small difference of large numbers.
    """
    u, t = dt_s / time_s, time_s
    if u < SERIES_BELOW:
        white_jerk(2.0 * sd * sd / t, dt_s, out)
        out[0] *= 1.0 - u * (5.0 / 9.0 - u * 25.0 / 126.0)
        out[1] *= 1.0 - u * (2.0 / 3.0 - u * 5.0 / 18.0)
        out[2] *= 1.0 - u * (1.0 - u * 11.0 / 20.0)
        out[3] *= 1.0 - u * (3.0 / 4.0 - u * 7.0 / 20.0)
        out[4] *= 1.0 - u * (1.0 - u * 7.0 / 12.0)
        out[5] *= 1.0 - u * (1.0 - u * 2.0 / 3.0)
        return
    e, ee = math.exp(-u), math.exp(-2.0 * u)
    out[0] = t**4 * (1.0 - ee + 2.0 * u + 2.0 * u**3 / 3.0 - 2.0 * u * u - 4.0 * u * e)
    out[1] = t**3 * (ee + 1.0 - 2.0 * e + 2.0 * u * e - 2.0 * u + u * u)
    out[2] = t**2 * (1.0 - ee - 2.0 * u * e)
    out[3] = t**2 * (4.0 * e - 3.0 - ee + 2.0 * u)
    out[4] = t * (ee + 1.0 - 2.0 * e)
    out[5] = 1.0 - ee
    for k in range(6):
        out[k] *= sd * sd


@kernel
def white_jerk(density: float, dt_s: float, out: FloatArray) -> None:
    """Write the noise of a white jerk of ``density`` (m^2/s^5): integrals of its Wiener process."""
    out[0] = density * dt_s**5 / 20.0
    out[1] = density * dt_s**4 / 8.0
    out[2] = density * dt_s**3 / 6.0
    out[3] = density * dt_s**3 / 3.0
    out[4] = density * dt_s * dt_s / 2.0
    out[5] = density * dt_s


@kernel
def add_white_acceleration(P: FloatArray, density: float, dt_s: float) -> None:
    """Add the noise of a white acceleration of ``density`` (m^2/s^3) per axis to a covariance (>= 4, >= 4)."""
    for i in range(2):
        P[i, i] += density * dt_s**3 / 3.0
        P[i, i + 2] += density * dt_s * dt_s / 2.0
        P[i + 2, i] = P[i, i + 2]
        P[i + 2, i + 2] += density * dt_s


@kernel
def add_along(P: FloatArray, block: FloatArray, east: float, north: float, own: int) -> None:
    """Add a block of noise that acts along the unit vector (east, north), its third component at index ``own``."""
    u0, u1 = east, north
    for i in range(2):
        a = u0 if i == 0 else u1
        for j in range(2):
            # The product first: it is the same for (i, j) and (j, i), so that P stays symmetric to the last bit.
            ab = a * (u0 if j == 0 else u1)
            P[i, j] += block[0] * ab
            P[i, j + 2] += block[1] * ab
            P[j + 2, i] += block[1] * ab
            P[i + 2, j + 2] += block[3] * ab
        P[i, own] += block[2] * a
        P[own, i] += block[2] * a
        P[i + 2, own] += block[4] * a
        P[own, i + 2] += block[4] * a
    P[own, own] += block[5]
