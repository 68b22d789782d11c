"""Measurement models: what a plot says of a state [east_m, north_m, veast, vnorth | own parameters].

Positions are measured in the plane (polar plots are brought there first, ``convert.polar_to_plane``); a range rate is a
second, scalar measurement of the same plot, linearised after the first.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.estimation.plots import Plot

FloatArray = npt.NDArray[np.float64]

LEAST_DISTANCE_M = 1.0
"""Nearer to its site a sensor's range rate says nothing of the direction."""


@kernel
def update_position(x: FloatArray, P: FloatArray, d: int, z: FloatArray, R: FloatArray, K: FloatArray) -> float:
    """Kalman update with a position, in place; returns the log-likelihood of z.

    S = H P H^T + R, K = P H^T S^-1, x += K nu, P -= K S K^T, log N(nu; 0, S). If S is not positive definite the
    measurement is skipped and -inf returned.

    Args:
        x: (>= d,). P: (>= d, >= d). d: length of the state, 4 to 6.
        z: (2,) [east_m, north_m]. R: (3,) its covariance [ee, en, nn].
        K: (>= d, 2) scratch.
    """
    # Constants for the compiler.
    if d == 4:
        return _update_position(x, P, 4, z, R, K)
    if d == 5:
        return _update_position(x, P, 5, z, R, K)
    return _update_position(x, P, 6, z, R, K)


@inlined
def _update_position(x: FloatArray, P: FloatArray, d: int, z: FloatArray, R: FloatArray, K: FloatArray) -> float:
    s00, s01, s11 = P[0, 0] + R[0], P[0, 1] + R[1], P[1, 1] + R[2]
    det = s00 * s11 - s01 * s01
    if not (det > 0.0 and s00 > 0.0):
        return -np.inf
    v0, v1 = z[0] - x[0], z[1] - x[1]
    i00, i01, i11 = s11 / det, -s01 / det, s00 / det
    for a in range(d):
        K[a, 0] = P[a, 0] * i00 + P[a, 1] * i01
        K[a, 1] = P[a, 0] * i01 + P[a, 1] * i11
    for a in range(d):
        x[a] += K[a, 0] * v0 + K[a, 1] * v1
        k0 = K[a, 0] * s00 + K[a, 1] * s01
        k1 = K[a, 0] * s01 + K[a, 1] * s11
        for b in range(a, d):
            P[a, b] -= k0 * K[b, 0] + k1 * K[b, 1]
            P[b, a] = P[a, b]
    distance = v0 * v0 * i00 + 2.0 * v0 * v1 * i01 + v1 * v1 * i11
    return float(-np.log(2.0 * np.pi) - 0.5 * np.log(det) - 0.5 * distance)


@kernel
def range_rate(x: FloatArray, plot: Plot, h: FloatArray) -> float:
    """Range rate that a state (>= 4,) predicts for a plot; its gradient by position and velocity is written to h (4,).

    rho' = level v^T u with v the velocity relative to the sensor and u = (p - site) / |p - site|: d rho'/dv = level u,
    d rho'/dp = level (v - (v^T u) u) / |p - site|. ``level`` is the cosine of the elevation; the target is supposed to
    stay at its height.
    """
    de, dn = x[0] - plot.site[0], x[1] - plot.site[1]
    distance = max(math.hypot(de, dn), LEAST_DISTANCE_M)
    ue, un = de / distance, dn / distance
    ve, vn = x[2] - plot.site_velocity[0], x[3] - plot.site_velocity[1]
    along = ve * ue + vn * un
    h[0] = plot.level * (ve - along * ue) / distance
    h[1] = plot.level * (vn - along * un) / distance
    h[2], h[3] = plot.level * ue, plot.level * un
    return float(plot.level * along)


@kernel
def update_scalar(
    x: FloatArray, P: FloatArray, d: int, h: FloatArray, nu: float, variance: float, K: FloatArray
) -> float:
    """Kalman update with a scalar of gradient h (4,) by position and velocity, in place; returns its log-likelihood.

    s = h P h^T + variance, K = P h^T / s, x += K nu, P -= K s K^T. Not positive: skipped, -inf.

    Args:
        nu: measured minus predicted.
        K: (>= d, 2) scratch.
    """
    s = variance
    for a in range(d):
        K[a, 0] = P[a, 0] * h[0] + P[a, 1] * h[1] + P[a, 2] * h[2] + P[a, 3] * h[3]
        if a < 4:
            s += h[a] * K[a, 0]
    if not s > 0.0:
        return -np.inf
    for a in range(d):
        x[a] += K[a, 0] * nu / s
        for b in range(a, d):
            P[a, b] -= K[a, 0] * K[b, 0] / s
            P[b, a] = P[a, b]
    return float(-0.5 * (np.log(2.0 * np.pi * s) + nu * nu / s))
