"""The alpha-beta filter: constant gains instead of a covariance, for very many cheap tracks.

With d = z - (p + T v):  p' = p + T v + alpha d,  v' = v + (beta / T) d, each coordinate alone. The target moves with
constant velocity and white acceleration, x' = F x + G a, F = [[1, T], [0, 1]], G = [T^2/2, T], a ~ N(0, sigma_v^2),
measured as z = p + w, w ~ N(0, sigma_w^2). In positions over sigma_w and velocities over sigma_w / T everything depends
on the manoeuvring index lambda = T^2 sigma_v / sigma_w alone (Kalata 1984).

Three kinds of gains: of the steady Kalman filter (lambda known, slow start), of the least-squares line through all k
plots (decreasing, deaf in the end), and their greater one, which loses a thousandth to the Kalman filter. Where lambda
is not known, the decreasing gains are held from plot k_end on (He You, *Radar Data Processing with Applications*), or
a bank of filters with several k_end finds out by itself. Gains suppose nearly even intervals; where intervals differ by
more than a factor of two, use a Kalman filter.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
FloatLike = float | FloatArray
IntLike = int | IntArray

BANK_K_END = np.array([2, 3, 5, 8, 13, 21, 34])
"""Where the filters of a bank stop to decrease their gains: each remembers 1.6 times longer than the one before."""

BANK_INDEX = np.array([2.5, 1.3, 0.355, 0.124, 0.0444, 0.0165, 0.00619])
"""The manoeuvring index for which each filter of a bank is made: ``k_end_rule`` of it is its k_end."""

BANK_WINDOW = 20
"""Innovations that a bank weighs its filters by."""

_SETTLED = 120
"""Plots after which even the slowest filter of a bank is in its steady state."""


def manoeuvring_index(dt_s: FloatLike, sigma_v_mps2: FloatLike, sigma_w_m: FloatLike) -> FloatArray:
    """The index lambda = T^2 sigma_v / sigma_w (Kalata 1984): how far a target strays within T, in deviations of z.

    Args:
        dt_s, sigma_v_mps2, sigma_w_m: interval, standard deviations of the acceleration and of the measured position;
            shapes that broadcast.
    """
    return np.asarray(np.square(dt_s) * sigma_v_mps2 / np.asarray(sigma_w_m, float))


def steady_gains(index: FloatLike) -> tuple[FloatArray, FloatArray]:
    """Gains alpha and beta of the Kalman filter in its steady state (Kalata 1984), shapes of ``index`` >= 0.

    r = (4 + lambda - sqrt(lambda^2 + 8 lambda)) / 4, alpha = 1 - r^2, beta = 2 (1 - r)^2, so that
    beta = 2 (2 - alpha) - 4 sqrt(1 - alpha) and lambda^2 = beta^2 / (1 - alpha); written without cancellation.
    """
    index = np.asarray(index, float)
    root = np.sqrt(index * (index + 8.0))
    gap = (index + root) / (4.0 + index + root)
    return np.asarray(gap * (2.0 - gap)), np.asarray(2.0 * gap * gap)


def decreasing_gains(k: IntLike) -> tuple[FloatArray, FloatArray]:
    """Gains alpha and beta at plot k = 1, 2, ... of the least-squares line, shapes of ``k``.

    alpha = 2 (2k - 1) / (k (k + 1)), beta = 6 / (k (k + 1)): from the third plot on the Kalman filter without process
    noise and with nothing known before. At the second they are 1 and 1 (the line through two plots); at the first the
    formula gives no usable gain, and (1, 0) puts the track on the plot, at rest.
    """
    k = np.asarray(k, float)
    both = k * (k + 1.0)
    return np.asarray(2.0 * (2.0 * k - 1.0) / both), np.asarray(np.where(k > 1.0, 6.0 / both, 0.0))


def combined_gains(k: IntLike, index: FloatLike) -> tuple[FloatArray, FloatArray]:
    """The greater of decreasing and steady gains, shapes of ``k`` and ``index`` broadcast: a quick start, never deaf.

    The first two plots start the track whatever lambda is, therefore only the decreasing gains count there.
    """
    started = np.asarray(k) > 2
    falling, steady = decreasing_gains(k), steady_gains(index)
    alpha, beta = (np.maximum(f, np.where(started, s, 0.0)) for f, s in zip(falling, steady, strict=True))
    return alpha, beta


def k_end_rule(index: FloatLike) -> IntArray:
    """The plot from which on decreasing gains are best held, shape of ``index``; at least 2.

    The middle of where the decreasing gains meet the steady ones a and b: k_alpha = (4 - a + sqrt((4 - a)^2 - 8a)) / 2a
    and k_beta = (sqrt(1 + 24 / b) - 1) / 2. For small lambda k_end T is near 2.6 sqrt(sigma_w / sigma_v), a time of
    memory that does not depend on T.

    Raises:
        ValueError: an index is not positive; without manoeuvres there is no end.
    """
    if not np.all(np.asarray(index) > 0.0):
        raise ValueError("the manoeuvring index must be positive")
    a, b = steady_gains(index)
    by_alpha = ((4.0 - a) + np.sqrt(np.square(4.0 - a) - 8.0 * a)) / (2.0 * a)
    by_beta = (np.sqrt(1.0 + 24.0 / b) - 1.0) / 2.0
    return np.asarray(np.maximum(np.rint((by_alpha + by_beta) / 2.0), 2.0), np.int64)


@kernel
def step(
    x: FloatArray, z: FloatArray, dt_s: FloatArray, k: IntArray, alpha: FloatArray, beta: FloatArray
) -> FloatArray:
    """One plot for each of n tracks: p' = p + T v + alpha d, v' = v + (beta / T) d with d = z - (p + T v).

    A first plot (k = 1) starts the track there, at rest, whatever ``x`` held. Two plots of one time (T = 0) tell
    nothing of the velocity: it stays, and such a plot is best not counted in k.

    Args:
        x: (n, 4) states [east_m, north_m, veast, vnorth] at the last plots.
        z: (n, 2) plots. dt_s: (n,) seconds since the last plots, >= 0.
        k: (n,) number of this plot in its track, from 1.
        alpha, beta: (n,) gains at k, by ``combined_gains``, or ``decreasing_gains`` of min(k, k_end).

    Returns:
        (n, 4) states at these plots.
    """
    n = len(x)
    out = np.empty((n, 4))
    for i in range(n):
        rate = beta[i] / dt_s[i] if dt_s[i] > 0.0 else 0.0
        for a in range(2):
            predicted = x[i, a] + dt_s[i] * x[i, a + 2]
            d = z[i, a] - predicted
            out[i, a] = predicted + alpha[i] * d
            out[i, a + 2] = x[i, a + 2] + rate * d
            if k[i] == 1:
                out[i, a], out[i, a + 2] = z[i, a], 0.0
    return out


def steady_covariance(
    alpha: FloatLike, beta: FloatLike, dt_s: FloatLike, sigma_v_mps2: FloatLike, sigma_w_m: FloatLike
) -> FloatArray:
    """Covariance (..., 2, 2) of [position, velocity] of one coordinate that held gains lead to; arguments broadcast.

    The solution of P = (I - K H)(F P F^T + Q)(I - K H)^T + K R K^T, K = [alpha, beta / T], Q = sigma_v^2 G G^T,
    R = sigma_w^2. It holds for any stable gains; for ``steady_gains`` it is that of the Kalman filter.

    Raises:
        ValueError: the gains are not stable (alpha > 0, 0 < beta < 4 - 2 alpha), or an interval is not positive.
    """
    a, b, dt, sv, sw = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (alpha, beta, dt_s, sigma_v_mps2, sigma_w_m))
    )
    if not np.all((a > 0.0) & (b > 0.0) & (b < 4.0 - 2.0 * a) & (dt > 0.0)):
        raise ValueError("steady covariance needs alpha > 0, 0 < beta < 4 - 2 alpha and dt_s > 0")
    R, Q = sw * sw, np.square(sv * dt * dt)
    c, f, g = 1.0 - a, 1.0 - b, 2.0 - b
    # With T = 1: three linear equations for position variance, covariance and velocity variance.
    M = np.stack(
        [
            np.stack([1.0 - c * c, -2.0 * c * c, -c * c], -1),
            np.stack([c * b, 1.0 - c * (1.0 - 2.0 * b), -c * f], -1),
            np.stack([-b * b, 2.0 * b * f, 1.0 - f * f], -1),
        ],
        -2,
    )
    y = np.stack([a * a * R + c * c * Q / 4.0, a * b * R + c * g * Q / 4.0, b * b * R + g * g * Q / 4.0], -1)
    return _matrices(np.linalg.solve(M, y[..., None])[..., 0], dt)


def error_covariances(
    alpha: FloatArray, beta: FloatArray, dt_s: FloatLike, sigma_v_mps2: FloatLike, sigma_w_m: FloatLike
) -> FloatArray:
    """Exact covariances (..., n, 2, 2) of [position, velocity] of one coordinate after plots 1 to n of a track.

    P_k = (I - K_k H)(F P_{k-1} F^T + Q)(I - K_k H)^T + K_k R K_k^T, no simulation: the filter is linear, its gains are
    known. After the first plot the velocity is not known at all and its variance is infinite; the second removes that.

    Args:
        alpha, beta: (..., n) gains of plots 1 to n, those of the first two being (1, 0) and (1, 1).
        dt_s, sigma_v_mps2, sigma_w_m: interval and noise, of shapes that broadcast with the leading axes.

    Raises:
        ValueError: the first two gains do not start a track.
    """
    if alpha.shape[-1] < 2 or not np.all((alpha[..., :2] == 1.0) & (beta[..., :2] == [0.0, 1.0])):
        raise ValueError("the gains of the first two plots must be (1, 0) and (1, 1)")
    dt, sv, sw = (np.asarray(v, float) for v in (dt_s, sigma_v_mps2, sigma_w_m))
    shape = np.broadcast_shapes(alpha.shape[:-1], beta.shape[:-1], dt.shape, sv.shape, sw.shape)
    n = alpha.shape[-1]
    gains = (np.ascontiguousarray(np.broadcast_to(v, (*shape, n))).reshape(-1, n) for v in (alpha, beta))
    noise = (np.ascontiguousarray(np.broadcast_to(v, shape)).ravel() for v in (np.square(sv * dt * dt), sw * sw))
    return _matrices(_propagate(*gains, *noise).reshape(*shape, n, 3), dt[..., None])


@kernel
def _propagate(alpha: FloatArray, beta: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    m, n = alpha.shape
    out = np.empty((m, n, 3))
    for i in range(m):
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = R[i], 0.0, np.inf
        p, c, v = R[i], 0.0, 0.0
        for k in range(1, n):
            a, b = alpha[i, k], beta[i, k]
            p, c, v = p + 2.0 * c + v + Q[i] / 4.0, c + v + Q[i] / 2.0, v + Q[i]
            p, c, v = (
                (1.0 - a) * (1.0 - a) * p + a * a * R[i],
                (1.0 - a) * (c - b * p) + a * b * R[i],
                v - 2.0 * b * c + b * b * (p + R[i]),
            )
            out[i, k, 0], out[i, k, 1], out[i, k, 2] = p, c, v
    return out


def kalman_gains(n: int, index: FloatLike) -> tuple[FloatArray, FloatArray]:
    """Gains alpha and beta (..., n) of the Kalman filter at plots 1 to n: the best that gains can do.

    Nothing is known before the first plot, therefore the first two gains are (1, 0) and (1, 1), whatever lambda is.

    Args:
        n: number of plots, at least 2.
        index: manoeuvring index lambda >= 0, of the leading shape of the gains.
    """
    index = np.asarray(index, float)
    Q = np.square(index)
    alpha, beta = np.ones((2, *index.shape, n))
    beta[..., 0] = 0.0
    p, c, v = np.ones_like(Q), np.ones_like(Q), 2.0 + Q / 4.0
    for k in range(2, n):
        p, c, v = p + 2.0 * c + v + Q / 4.0, c + v + Q / 2.0, v + Q
        alpha[..., k], beta[..., k] = p / (p + 1.0), c / (p + 1.0)
        p, c, v = p / (p + 1.0), c / (p + 1.0), v - c * c / (p + 1.0)
    return alpha, beta


class Bank(NamedTuple):
    """Filters with ``BANK_K_END`` side by side, for n tracks whose noise levels nobody knows.

    Attributes:
        x: (n, 7, 4) states [east_m, north_m, veast, vnorth] at the last plots.
        energy: (n, 7, 2) running means of the squared innovations of each coordinate, m^2.
        k: (n,) plots so far; a row with 0 is free, its next plot starts a track.
    """

    x: FloatArray
    energy: FloatArray
    k: IntArray


def make_bank(n: int) -> Bank:
    """A bank with n free rows."""
    c = len(BANK_K_END)
    return Bank(np.zeros((n, c, 4)), np.zeros((n, c, 2)), np.zeros(n, np.int64))


_BANK_ALPHA, _BANK_BETA = decreasing_gains(np.arange(1, BANK_K_END[-1] + 1))


@kernel
def feed_bank(bank: Bank, rows: IntArray, z: FloatArray, dt_s: FloatArray) -> None:
    """Feed plot j to all filters of row ``rows[j]``, in place; rows may repeat.

    Filter c has ``decreasing_gains`` of min(k, k_end_c); from the third plot on e_c += (d_c^2 - e_c) / min(k - 2, 20).

    Args:
        bank: changed in ``rows``.
        z: (m, 2) plots. dt_s: (m,) seconds since the rows' last plots, >= 0.
    """
    for j in range(len(rows)):
        i = rows[j]
        bank.k[i] += 1
        k = bank.k[i]
        window = min(max(k - 2, 1), BANK_WINDOW)
        for c in range(len(BANK_K_END)):
            alpha, beta = _BANK_ALPHA[min(k, BANK_K_END[c]) - 1], _BANK_BETA[min(k, BANK_K_END[c]) - 1]
            rate = beta / dt_s[j] if dt_s[j] > 0.0 else 0.0
            for a in range(2):
                if k == 1:
                    bank.x[i, c, a], bank.x[i, c, a + 2], bank.energy[i, c, a] = z[j, a], 0.0, 0.0
                    continue
                predicted = bank.x[i, c, a] + dt_s[j] * bank.x[i, c, a + 2]
                d = z[j, a] - predicted
                bank.x[i, c, a] = predicted + alpha * d
                bank.x[i, c, a + 2] += rate * d
                if k > 2:
                    bank.energy[i, c, a] += (d * d - bank.energy[i, c, a]) / window


def bank_estimate(bank: Bank, rows: IntArray, dt_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (m, 4) and covariances (m, 4, 4) of rows at their last plots, by averaging over the filters.

    Filter c has the weight of its concentrated likelihood (noise levels maximised out) over the last
    m = min(k - 2, 20) plots: w_c ~ prod_a e_{c,a}^(-m/2), a = east, north. Its own covariance is the exact one of its
    gains at lambda_c = ``BANK_INDEX``, scaled by its innovations, e_{c,a} m / (m - 2): the variance of Student's t,
    since e is an estimate too. The output is moment-matched. Before the fifth plot (m < 3) no variance can be told, it
    is infinite. Simulated with lambda from 0 to 10, 95 % regions held 94 to 99.7 % of the errors from plot 40 on and 83
    to 98 % before. Above lambda = 3 the velocity falls behind the Kalman filter: no filter here has a beta above 1.

    Args:
        rows: (m,) rows with at least one plot.
        dt_s: (m,) intervals between plots of these rows.

    Raises:
        ValueError: an interval is not positive.
    """
    if not np.all(dt_s > 0.0):
        raise ValueError("dt_s must be positive")
    return _average(bank, rows, dt_s, _bank_spread())


@functools.cache
def _bank_spread() -> FloatArray:
    """(7, n, 3) covariance [pp, pv, vv] of each filter (T = 1) at plot k for one square metre of innovation energy."""
    k = np.arange(1, _SETTLED + 1)
    gains = decreasing_gains(np.minimum(k, BANK_K_END[:, None]))
    P = error_covariances(*gains, 1.0, BANK_INDEX, 1.0)
    innovation = np.ones(P.shape[:2])
    innovation[:, 1:] += P[:, :-1, 0, 0] + 2.0 * P[:, :-1, 0, 1] + P[:, :-1, 1, 1] + BANK_INDEX[:, None] ** 2 / 4.0
    # The running mean that feed_bank keeps, of expectations.
    energy = np.ones_like(innovation)
    for n in range(2, _SETTLED):
        energy[:, n] = energy[:, n - 1] + (innovation[:, n] - energy[:, n - 1]) / min(n - 1, BANK_WINDOW)
    return np.ascontiguousarray(np.stack([P[..., 0, 0], P[..., 0, 1], P[..., 1, 1]], -1) / energy[..., None])


@kernel
def _average(bank: Bank, rows: IntArray, dt_s: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
    m, n_filters = len(rows), len(BANK_K_END)
    mean, P = np.zeros((m, 4)), np.zeros((m, 4, 4))
    w = np.empty(n_filters)
    for j in range(m):
        i = rows[j]
        count = min(bank.k[i] - 2, BANK_WINDOW)
        _weights(bank.energy[i], count, w)
        for c in range(n_filters):
            for a in range(4):
                mean[j, a] += w[c] * bank.x[i, c, a]
        if count < 3:
            for a in range(4):
                P[j, a, a] = np.inf
            continue
        for c in range(n_filters):
            own = spread[c, min(bank.k[i], len(spread[c])) - 1]
            for a in range(2):
                scale = w[c] * bank.energy[i, c, a] * count / (count - 2.0)
                P[j, a, a] += scale * own[0]
                P[j, a, a + 2] += scale * own[1] / dt_s[j]
                P[j, a + 2, a + 2] += scale * own[2] / dt_s[j] ** 2
            for a in range(4):
                for b in range(a, 4):
                    P[j, a, b] += w[c] * (bank.x[i, c, a] - mean[j, a]) * (bank.x[i, c, b] - mean[j, b])
        for a in range(4):
            for b in range(a):
                P[j, a, b] = P[j, b, a]
    return mean, P


@kernel
def _weights(energy: FloatArray, count: int, w: FloatArray) -> None:
    """Write the weights of the filters into ``w``: e^(-count/2) over both coordinates, equal before any innovation."""
    top, total = -np.inf, 0.0
    for c in range(len(w)):
        w[c] = 0.0
        if count > 0:
            # The floor lets plots without noise give equal weights.
            w[c] = -0.5 * count * (np.log(max(energy[c, 0], 1e-300)) + np.log(max(energy[c, 1], 1e-300)))
        top = max(top, w[c])
    for c in range(len(w)):
        w[c] = np.exp(w[c] - top)
        total += w[c]
    for c in range(len(w)):
        w[c] /= total


def _matrices(upper: FloatArray, dt_s: FloatArray) -> FloatArray:
    """(..., 3) [pp, pv, vv] with T = 1 as (..., 2, 2) in seconds."""
    p, c, v = upper[..., 0], upper[..., 1] / dt_s, upper[..., 2] / dt_s**2
    return np.stack([np.stack([p, c], -1), np.stack([c, v], -1)], -2)
