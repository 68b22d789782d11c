"""Fixed-lag smoothing: position and velocity some plots ago, refined by every plot since.

Each model carries, for each lag, y = position and velocity of then, C = cov(x, y) and Y = cov(y). They are mixed like
the state, propagated (C <- F C) and updated by its gain: the exact joint filter of present and past, per model. One lag
is one plot with time between; a second plot of one time moves nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.bank import Models, State, Work
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.repair import is_state

FloatArray = npt.NDArray[np.float64]


@kernel
def shift(s: State) -> None:
    """Move every lag one plot back; the nearest becomes the present state: y = x, C = P, Y = P of these components."""
    for lag in range(len(s.y_t_s) - 1, -1, -1):
        for j in range(len(s.mu)):
            for k in range(4):
                s.y[lag, j, k] = s.y[lag - 1, j, k] if lag else s.x[j, k]
                for a in range(s.x.shape[1]):
                    s.C[lag, j, a, k] = s.C[lag - 1, j, a, k] if lag else s.P[j, a, k]
                for m in range(4):
                    s.Y[lag, j, k, m] = s.Y[lag - 1, j, k, m] if lag else s.P[j, k, m]
        s.y_t_s[lag] = s.y_t_s[lag - 1] if lag else s.t_s


@kernel
def renew(s: State) -> None:
    """Forget the past: the present stands in its place."""
    for _ in range(len(s.y_t_s)):
        shift(s)


@kernel
def repair(s: State, doubtful: bool, w: Work) -> None:
    """Renew the past where it is ``doubtful``, or itself no state, which is counted."""
    for lag in range(len(s.y_t_s)):
        for j in range(len(s.mu)):
            if not (doubtful or is_state(s.y[lag, j], s.Y[lag, j], 4, w)):
                doubtful = True
                w.repairs += 1
    if doubtful:
        renew(s)


@kernel
def mix(models: Models, s: State, lag: int, low: int, high: int, w: Work) -> None:
    """Mix a lag of models low..high-1 by ``w.weight``, before the states themselves, whose mixed ones are in ``w.x``.

    What comes from other models has the prior in place of the own
    parameters of model j, uncorrelated with everything.
    """
    n = high - low
    for j in range(n):
        for k in range(4):
            value = 0.0
            for a in range(n):
                value += w.weight[a, j] * s.y[lag, low + a, k]
            w.y[j, k] = value
            for m in range(4):
                w.C[j, k, m] = w.Y[j, k, m] = 0.0
        for a in range(n):
            weight = w.weight[a, j]
            for k in range(4):
                dx, dy = s.x[low + a, k] - w.x[j, k], s.y[lag, low + a, k] - w.y[j, k]
                for m in range(4):
                    shift_m = s.y[lag, low + a, m] - w.y[j, m]
                    w.C[j, k, m] += weight * (s.C[lag, low + a, k, m] + dx * shift_m)
                    w.Y[j, k, m] += weight * (s.Y[lag, low + a, k, m] + dy * shift_m)
        for k in range(4, models.states[low + j]):
            # The weighted sum of all shifts is zero: the others together hold the opposite, at the prior's mean.
            shift_own = s.x[low + j, k] - models.numbers[low + j, 1]
            for m in range(4):
                shift_m = s.y[lag, low + j, m] - w.y[j, m]
                w.C[j, k, m] = w.weight[j, j] * (s.C[lag, low + j, k, m] + shift_own * shift_m)
    for j in range(n):
        for k in range(4):
            s.y[lag, low + j, k] = w.y[j, k]
            for m in range(4):
                s.Y[lag, low + j, k, m] = w.Y[j, k, m]
        for a in range(models.states[low + j]):
            for m in range(4):
                s.C[lag, low + j, a, m] = w.C[j, a, m]


@kernel
def predict(s: State, j: int, d: int, w: Work) -> None:
    """C <- F C of model ``j``, whose F of length d is in ``w.F``."""
    for lag in range(len(s.y_t_s)):
        for m in range(4):
            for a in range(d):
                value = 0.0
                for k in range(d):
                    value += w.F[a, k] * s.C[lag, j, k, m]
                w.block[a] = value
            for a in range(d):
                s.C[lag, j, a, m] = w.block[a]


@kernel
def update_position(s: State, j: int, d: int, z: FloatArray, R: FloatArray, w: Work) -> None:
    """Update the lags of model ``j`` with a position, before its state is.

    With G = C^T H^T S^-1: y += G nu, Y -= G S G^T, C <- (I - K H) C.
    """
    P = s.P[j]
    s00, s01, s11 = P[0, 0] + R[0], P[0, 1] + R[1], P[1, 1] + R[2]
    det = s00 * s11 - s01 * s01
    if not (det > 0.0 and s00 > 0.0):
        return
    v0, v1 = z[0] - s.x[j, 0], z[1] - s.x[j, 1]
    for lag in range(len(s.y_t_s)):
        C = s.C[lag, j]
        for k in range(4):
            w.gain[k, 0] = (C[0, k] * s11 - C[1, k] * s01) / det
            w.gain[k, 1] = (C[1, k] * s00 - C[0, k] * s01) / det
        for k in range(4):
            s.y[lag, j, k] += w.gain[k, 0] * v0 + w.gain[k, 1] * v1
            for m in range(k, 4):
                s.Y[lag, j, k, m] -= w.gain[k, 0] * C[0, m] + w.gain[k, 1] * C[1, m]
                s.Y[lag, j, m, k] = s.Y[lag, j, k, m]
            for a in range(d):
                C[a, k] -= P[a, 0] * w.gain[k, 0] + P[a, 1] * w.gain[k, 1]


@kernel
def update_scalar(s: State, j: int, d: int, h: FloatArray, nu: float, variance: float, w: Work) -> None:
    """As ``update_position``, with a scalar of gradient h (4,)."""
    P = s.P[j]
    total = variance
    for a in range(d):
        w.gain[a, 1] = P[a, 0] * h[0] + P[a, 1] * h[1] + P[a, 2] * h[2] + P[a, 3] * h[3]
        if a < 4:
            total += h[a] * w.gain[a, 1]
    if not total > 0.0:
        return
    for lag in range(len(s.y_t_s)):
        C = s.C[lag, j]
        for k in range(4):
            w.gain[k, 0] = C[0, k] * h[0] + C[1, k] * h[1] + C[2, k] * h[2] + C[3, k] * h[3]
        for k in range(4):
            s.y[lag, j, k] += w.gain[k, 0] * nu / total
            for m in range(k, 4):
                s.Y[lag, j, k, m] -= w.gain[k, 0] * w.gain[m, 0] / total
                s.Y[lag, j, m, k] = s.Y[lag, j, k, m]
            for a in range(d):
                C[a, k] -= w.gain[a, 1] * w.gain[k, 0] / total
