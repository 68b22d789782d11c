"""Biases of sensors: what they do to positions, and how differences of positions tell them.

A sensor has three biases, beta = [c0, c1, time_offset_s]; c0 and c1 are [range_m, azimuth_rad] of a polar sensor,
azimuth clockwise from north about its site in the plane, and [east_m, north_m] of a position sensor. Signs:

    measured range = true range + range_m          measured azimuth = true azimuth + azimuth_rad
    measured position = true position + [east_m, north_m]
    measured at stamp t = true at t + time_offset_s

so that to first order measured = true + J beta, J = [e_r, r e_az, v] of a polar sensor (e_r away from the site, e_az
clockwise) and [e_east, e_north, v] of a position sensor. Of tracks a and b of one target,
z_a - z_b = J_a beta_a - J_b beta_b + noise: linear in the biases of both sensors, as in the joint registration filters
of Bar-Shalom, Willett and Tian, "Tracking and Data Fusion" (2011). Corrections here are exact, J is for derivatives.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

COMPONENTS = 3
"""Biases a sensor; those it does not have keep the variance zero."""

_LEAST_RANGE_M = 1e-6


class Geometry(NamedTuple):
    """How a sensor measures: polar about ``site_m`` (2,), or positions in the plane."""

    polar: bool
    site_m: FloatArray


def shift(geometry: Geometry, at: FloatArray, bias: FloatArray) -> FloatArray:
    """What has to be subtracted from measured positions (..., 2); exactly zero where the bias is.

    Args:
        geometry: of the sensor.
        at: (..., 2) measured positions, or (..., 4) with velocities, without which the time offset does nothing.
        bias: (..., 3), broadcast against ``at``.
    """
    lead = at.shape[:-1] if bias.ndim == 1 else np.broadcast_shapes(at.shape[:-1], bias.shape[:-1])
    width = at.shape[-1]
    if at.shape[:-1] != lead:
        at = np.broadcast_to(at, (*lead, width))
    if bias.ndim > 1:
        bias = np.broadcast_to(bias, (*lead, COMPONENTS))
    rows, biases = at.reshape(-1, width), bias.reshape(-1, COMPONENTS)
    return _shift(geometry.polar, geometry.site_m, rows, biases).reshape(*lead, 2)


@kernel
def _shift(polar: bool, site_m: FloatArray, at: FloatArray, bias: FloatArray) -> FloatArray:
    """``shift`` of rows (n, 2 or 4) by biases (n, 3), or (1, 3) for all."""
    n, width = at.shape
    out = np.empty((n, 2))
    for k in range(n):
        b = bias[k] if len(bias) > 1 else bias[0]
        if polar:
            east, north = at[k, 0] - site_m[0], at[k, 1] - site_m[1]
            r = max(np.hypot(east, north), _LEAST_RANGE_M)
            stretch = max(r - b[0], 0.0) / r
            cos, sin = stretch * np.cos(b[1]), stretch * np.sin(b[1])
            out[k, 0], out[k, 1] = east - (east * cos - north * sin), north - (north * cos + east * sin)
        else:
            out[k, 0], out[k, 1] = b[0], b[1]
        if width == 4:
            out[k, 0] += b[2] * at[k, 2]
            out[k, 1] += b[2] * at[k, 3]
    return out


def corrected(geometry: Geometry, at: FloatArray, bias: FloatArray) -> FloatArray:
    """True positions (..., 2) of measured ones; the inverse, for ranges above the bias, is that with ``-bias``."""
    return np.asarray(at[..., :2] - shift(geometry, at, bias))


def told(geometry: Geometry, measured: FloatArray, true: FloatArray) -> FloatArray:
    """Biases (..., 2), without time offset, that make ``measured`` (..., 2) of ``true`` (..., 2)."""
    if not geometry.polar:
        return np.asarray(measured - true)
    (em, nm), (et, nt) = (np.moveaxis(z - geometry.site_m, -1, 0) for z in (measured, true))
    turn = np.arctan2(em * nt - nm * et, em * et + nm * nt)
    return np.stack([np.hypot(em, nm) - np.hypot(et, nt), turn], axis=-1)


def jacobian(geometry: Geometry, at: FloatArray) -> FloatArray:
    """J (..., 2, 3): how the biases move what is measured of targets at ``at``, (..., 2), or (..., 4) with velocities.

    At the corrected position it is the derivative of ``measured - corrected(measured, bias)`` by the biases (exact
    without time offset, with it but for what the target moves in that time).
    """
    rows = at.reshape(-1, at.shape[-1])
    return _jacobian(geometry.polar, geometry.site_m, rows).reshape(*at.shape[:-1], 2, COMPONENTS)


@kernel
def _jacobian(polar: bool, site_m: FloatArray, at: FloatArray) -> FloatArray:
    n, width = at.shape
    J = np.zeros((n, 2, COMPONENTS))
    for k in range(n):
        if polar:
            east, north = at[k, 0] - site_m[0], at[k, 1] - site_m[1]
            r = max(np.hypot(east, north), _LEAST_RANGE_M)
            J[k, 0, 0], J[k, 1, 0] = east / r, north / r
            J[k, 0, 1], J[k, 1, 1] = north, -east
        else:
            J[k, 0, 0] = J[k, 1, 1] = 1.0
        if width == 4:
            J[k, 0, 2], J[k, 1, 2] = at[k, 2], at[k, 3]
    return J


@kernel
def spread_through(H: FloatArray, P: FloatArray) -> FloatArray:
    """H P H^T (n, 2, 2) of rows H (n, 2, m) and one covariance P (m, m)."""
    n, _, m = H.shape
    out = np.zeros((n, 2, 2))
    for k in range(n):
        for a in range(2):
            for i in range(m):
                if H[k, a, i] == 0.0:
                    continue
                for j in range(m):
                    for b in range(2):
                        out[k, a, b] += H[k, a, i] * P[i, j] * H[k, b, j]
        out[k, 0, 1] = out[k, 1, 0] = 0.5 * (out[k, 0, 1] + out[k, 1, 0])
    return out


def spread(P: FloatArray, polar: bool, at_range_m: float) -> float:
    """Length of a shift's 1-sigma error, metres: sqrt(tr J P J^T) at a range, from P (>= 2, >= 2); no time offset."""
    return float(np.sqrt(P[0, 0] + P[1, 1] * (at_range_m**2 if polar else 1.0)))


def length(bias: FloatArray, polar: bool, at_range_m: float) -> float:
    """Length of the shift by a bias (>= 2,) at a range, metres; no time offset."""
    return float(np.hypot(bias[0], bias[1] * (at_range_m if polar else 1.0)))


# --- what pairs of tracks tell ---


class Tracks(NamedTuple):
    """Raw local tracks of one sensor: x (n, 2), or (n, 4) with velocities, and P (n, 2, 2) or (n, 4, 4)."""

    geometry: Geometry
    x: FloatArray
    P: FloatArray


def residuals(a: Tracks, bias_a: FloatArray, b: Tracks, bias_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What is left of z_a - z_b (..., n, 2) of pairs when both are corrected, and H = [J_a, -J_b] (..., n, 2, 6).

    Both J are taken where the target most likely is, z_a - P_a (P_a + P_b)^-1 (z_a - z_b) and likewise its velocity:
    the error of this is not correlated with that of the difference. With each J at its own track, errors would be
    multiplied with themselves, and two sensors on one mast would learn, pair by pair, a sum of biases that cannot be
    known.

    Args:
        a, b: the tracks of the pairs, row by row.
        bias_a, bias_b: (3,), or (k, 1, 3) for k hypotheses.
    """
    R = a.P[:, :2, :2] + b.P[:, :2, :2]
    xa, xb, against = _same_velocity(a, b)
    za, zb = corrected(a.geometry, xa, bias_a), corrected(b.geometry, xb, bias_b)
    left = za - zb
    u = _solved(R, left)[..., None]
    target = za - (a.P[:, :2, :2] @ u)[..., 0]
    if xa.shape[-1] == 4:
        target = np.concatenate([target, xa[:, 2:] - (against @ u)[..., 0]], axis=-1)
    return left, np.concatenate([jacobian(a.geometry, target), -jacobian(b.geometry, target)], axis=-1)


def _same_velocity(a: Tracks, b: Tracks) -> tuple[FloatArray, FloatArray, FloatArray]:
    """States of pairs with a velocity for both, the weighted mean, and its covariance with the error of z_a - z_b."""
    if a.x.shape[-1] == 2:
        return a.x, b.x, np.zeros((len(a.x), 2, 2))
    of_a, of_b = np.trace(a.P[:, 2:, 2:], axis1=1, axis2=2), np.trace(b.P[:, 2:, 2:], axis1=1, axis2=2)
    share = (of_b / np.maximum(of_a + of_b, 1e-12))[:, None]
    velocity = share * a.x[:, 2:] + (1.0 - share) * b.x[:, 2:]
    against = share[..., None] * a.P[:, 2:, :2] - (1.0 - share)[..., None] * b.P[:, 2:, :2]
    return np.concatenate([a.x[:, :2], velocity], axis=1), np.concatenate([b.x[:, :2], velocity], axis=1), against


def _solved(R: FloatArray, e: FloatArray) -> FloatArray:
    """R^-1 e (..., n, 2), R (n, 2, 2) symmetric, in closed form."""
    determinant = R[:, 0, 0] * R[:, 1, 1] - R[:, 1, 0] ** 2
    first = R[:, 1, 1] * e[..., 0] - R[:, 1, 0] * e[..., 1]
    second = R[:, 0, 0] * e[..., 1] - R[:, 1, 0] * e[..., 0]
    return np.asarray(np.stack([first, second], axis=-1) / determinant[:, None])


def whitened(R: FloatArray, columns: FloatArray) -> FloatArray:
    """L^-1 columns with R = L L^T: R (..., 2, 2) positive definite, columns (..., 2, k)."""
    l11 = np.sqrt(R[..., 0, 0])
    l21 = R[..., 1, 0] / l11
    l22 = np.sqrt(R[..., 1, 1] - l21 * l21)
    first = columns[..., 0, :] / l11[..., None]
    second = (columns[..., 1, :] - l21[..., None] * first) / l22[..., None]
    return np.stack([first, second], axis=-2)


def positive_definite(R: FloatArray) -> BoolArray:
    """Which of R (n, 2, 2) are covariances that can be divided by."""
    with np.errstate(invalid="ignore", over="ignore"):
        determinant = R[:, 0, 0] * R[:, 1, 1] - R[:, 1, 0] ** 2
        large_enough = determinant > 1e-12 * R[:, 0, 0] * R[:, 1, 1]
    return np.asarray((R[:, 0, 0] > 0.0) & large_enough & np.isfinite(determinant))


def distances(left: FloatArray, H: FloatArray, P: FloatArray, R: FloatArray) -> FloatArray:
    """D = e^T (H P H^T + R)^-1 e of rows: e (n, 2), H (n, 2, 6), P (6, 6), R (n, 2, 2)."""
    w = whitened(spread_through(H, P) + R, left[:, :, None])
    return np.asarray((w * w).sum(axis=(1, 2)))


def information(
    y: FloatArray, H: FloatArray, R: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Sums over rows of w H^T R^-1 H (6, 6) and w H^T R^-1 y (6,), for y = H beta + noise of covariance R / w."""
    rows = whitened(R, np.concatenate([H, y[:, :, None]], axis=2)) * np.sqrt(weight)[:, None, None]
    flat = rows.reshape(-1, H.shape[2] + 1)
    return flat[:, :-1].T @ flat[:, :-1], flat[:, :-1].T @ flat[:, -1]


def repetition(since_s: float, correlation_s: float) -> float:
    """What a look counts ``since_s`` after the last one, when errors are correlated by exp(-since / correlation).

    Of n values of such a process, correlated by rho from one to the next, the mean is as good as that of
    1 + (n - 1) (1 - rho) / (1 + rho) independent ones: the first counts for one, each other for tanh(since / (2 tau)).
    """
    return float(np.tanh(since_s / (2.0 * correlation_s))) if correlation_s > 0.0 else 1.0


# --- the filter ---


@kernel
def learn(
    beta: FloatArray, P: FloatArray, precision: FloatArray, vector: FloatArray
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The Gaussian N(beta, P) times exp(-b^T Lambda b / 2 + eta^T b): mean (n,) and covariance (n, n).

    With P = L L^T: P' = L (I + L^T Lambda L)^-1 L^T, beta' = beta + P' (eta - Lambda beta). The matrix that is solved
    has no eigenvalue below one, and P' is a product of a factor with itself: nothing has to be inverted or repaired.
    Components without variance stay as they are.

    Raises:
        numpy.linalg.LinAlgError: P is no covariance.
    """
    free = np.flatnonzero(np.diag(P) > 0.0)
    L = np.linalg.cholesky(P[free][:, free])
    information = precision[free][:, free]
    C = np.linalg.cholesky(np.eye(len(free)) + L.T @ information @ L)
    W = np.linalg.solve(C, L.T)
    new_P, new_beta = np.zeros_like(P), beta.copy()
    of_free = W.T @ W
    gain = of_free @ (vector - precision @ beta)[free]
    for a in range(len(free)):
        new_beta[free[a]] += gain[a]
        for b in range(a + 1):
            new_P[free[a], free[b]] = new_P[free[b], free[a]] = of_free[a, b]
    return new_beta, new_P


def drift(
    beta: FloatArray, P: FloatArray, prior: FloatArray, walk: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Let biases wander: a random walk that the prior bounds, so that what nothing is heard of ends at the prior.

    The Gauss-Markov process of stationary variance s^2 that starts as a walk of q: phi = exp(-q^2 dt / (2 s^2)),
    beta <- phi beta, P <- phi P phi^T + (1 - phi^2) s^2.

    Args:
        beta: (n,). P: (n, n).
        prior: (n,) s, one sigma; walk: (n,) q, one sigma per square root of a second.
        dt_s: time passed.
    """
    rate = np.divide(walk * walk, 2.0 * prior * prior, out=np.zeros_like(prior), where=prior > 0.0)
    phi = np.exp(-rate * dt_s)
    return phi * beta, mirrored(phi[:, None] * P * phi) + np.diag(-np.expm1(-2.0 * rate * dt_s) * prior * prior)


def mirrored(P: FloatArray) -> FloatArray:
    """The lower triangle of P, mirrored."""
    return np.asarray(np.tril(P) + np.tril(P, -1).T)


# --- what can be known ---


class Known(NamedTuple):
    """How well the biases (n,) are known.

    Attributes:
        remaining: variance over prior variance: 1 where nothing was learnt.
        held: share of each bias that lies in directions of which mostly the prior is known.
        tie: (n, n) how these directions join biases: large where only a difference of two, or a sum, is known.
    """

    remaining: FloatArray
    held: FloatArray
    tie: FloatArray


def known(P: FloatArray, prior: FloatArray) -> Known:
    """Compare a covariance (n, n) with independent priors (n,) of one sigma.

    The eigenvectors of P in units of the prior whose eigenvalue exceeds one half are the directions in which the data
    told less than the prior did.
    """
    n = len(prior)
    result = Known(np.zeros(n), np.zeros(n), np.zeros((n, n)))
    free = np.flatnonzero(prior > 0.0)
    scaled = P[np.ix_(free, free)] / np.outer(prior[free], prior[free])
    value, vector = np.linalg.eigh(scaled)
    blind = vector[:, value > 0.5]
    result.remaining[free] = np.diag(scaled)
    result.tie[np.ix_(free, free)] = blind @ blind.T
    result.held[:] = np.diag(result.tie)
    return result
