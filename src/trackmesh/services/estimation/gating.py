"""Which plots can belong to which tracks: an ellipse around each predicted position."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@kernel
def gate(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    t_s: FloatArray,
    z: FloatArray,
    R: FloatArray,
    z_t_s: FloatArray,
    limit: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """All pairs of track and plot within the gate of at least one model, with the cost of the pair.

    A pair is inside when D_j = nu_j^T S_j^-1 nu_j <= limit for some model j, S_j = P_j + R; a target that turns is then
    not lost because the quiet model is sure of itself. The cost is that of the whole mixture,
    -2 ln sum_j mu_j |S_j|^-1/2 exp(-D_j/2), which for one model is D + ln|S|. Plots are sorted by north and windowed.

    Each track is compared with a plot at the plot's own time, moved there by its velocity (the covariance is not: the
    times differ by less than a scan).

    Args:
        x: (n, r, 4) predicted states. P: (n, r, 4, 4). mu: (n, r). t_s: (n,) their times.
        z: (m, 2) plots. R: (m, 3) covariances [ee, en, nn]. z_t_s: (m,) their times.
        limit: largest squared distance.

    Returns:
        track index, plot index, cost of each pair, in order of track, then north.
    """
    n, r = mu.shape
    m = len(z)
    order = np.argsort(z[:, 1])
    north = z[order, 1]
    r_max = 0.0
    late, early = -np.inf, np.inf
    for j in range(m):
        r_max = max(r_max, R[j, 2])
        late, early = max(late, z_t_s[j]), min(early, z_t_s[j])
    size = 8 * (n + m) + 64
    ii: IntArray = np.empty(size, np.int64)
    jj: IntArray = np.empty(size, np.int64)
    cost: FloatArray = np.empty(size)
    count = 0
    for i in range(n):
        low, high = np.inf, -np.inf
        for a in range(r):
            spread = max(abs(late - t_s[i]), abs(early - t_s[i])) * abs(x[i, a, 3])
            reach = np.sqrt(limit * (P[i, a, 1, 1] + r_max)) + spread
            low, high = min(low, x[i, a, 1] - reach), max(high, x[i, a, 1] + reach)
        k = np.searchsorted(north, low)
        while k < m and north[k] <= high:
            j = order[k]
            k += 1
            value = mixture_cost(x[i], P[i], mu[i], z[j], R[j], z_t_s[j] - t_s[i], limit)
            if np.isinf(value):
                continue
            if count == size:
                size *= 2
                ii, jj, cost = _grown(ii, size), _grown(jj, size), _grown(cost, size)
            ii[count], jj[count], cost[count] = i, j, value
            count += 1
    return ii[:count], jj[:count], cost[:count]


@kernel
def mixture_cost(
    x: FloatArray, P: FloatArray, mu: FloatArray, z: FloatArray, R: FloatArray, dt_s: float, limit: float
) -> float:
    """Cost of one plot for one track (see ``gate``), infinite outside every model's gate."""
    r = len(mu)
    inside = False
    top, total = -np.inf, 0.0
    for a in range(r):
        v0 = z[0] - x[a, 0] - dt_s * x[a, 2]
        v1 = z[1] - x[a, 1] - dt_s * x[a, 3]
        s00, s01, s11 = P[a, 0, 0] + R[0], P[a, 0, 1] + R[1], P[a, 1, 1] + R[2]
        det = s00 * s11 - s01 * s01
        if not det > 0.0:
            continue
        distance = (v0 * v0 * s11 - 2.0 * v0 * v1 * s01 + v1 * v1 * s00) / det
        inside = inside or distance <= limit
        log_weight = np.log(max(mu[a], 1e-300)) - 0.5 * (distance + np.log(det))
        if log_weight > top:
            total = total * np.exp(top - log_weight) + 1.0
            top = log_weight
        else:
            total += np.exp(log_weight - top)
    return -2.0 * (top + np.log(total)) if inside else np.inf


@kernel
def _grown(array: npt.NDArray[Any], size: int) -> npt.NDArray[Any]:
    out = np.empty(size, array.dtype)
    out[: len(array)] = array
    return out
