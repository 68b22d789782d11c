"""Extended Kalman filters over the samples of a scan, one target: the joint one, and the separate pair of the thesis.

The target does not move, so a filter's time is the number of the sample. The joint state is position, tensors and
background, with one covariance. The pair (Liu Zhiyang, EMI detection by filter tracking, 2018, table 4-1) updates the
tensor by a Kalman filter that takes the position as exact, then the position by an extended one that takes the
tensor as exact; its innovation is z - h(x), and its gain P H^T S^-1, where equations 4-26, 4-31 and 4-33 misprint.
"""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, PER_TARGET, fill_row
from trackmesh.services.emi.kernels import FloatArray, kernel
from trackmesh.services.emi.sensor import Sensor


@kernel
def joint_filter(
    sensor: Sensor, y: FloatArray, w: FloatArray, state: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The joint filter, once over all samples.

    Args:
        sensor: geometry.
        y, w: (C, W, K) field, and one over its standard deviation (0 where there is no sample).
        state: (n,) position, tensors (6 a channel), background levels (p a channel and component).
        covariance: (n, n) of it.
    """
    n_c, n_w, n_k = y.shape
    p = sensor.basis.shape[1]
    x, P = state.copy(), covariance.copy()
    row, h = np.empty((n_c, n_k, 1, p + PER_TARGET + 1)), np.empty(x.size)
    a, d, last = p, p + N_TENSOR, p + PER_TARGET
    for i in range(n_w):
        at = x.copy()
        tensor = at[3 : 3 + N_TENSOR * n_c].reshape(n_c, 1, N_TENSOR)
        fill_row(sensor, y, w, i, at[:3].reshape(1, 3), tensor, row, 0)
        for c in range(n_c):
            for k in range(n_k):
                if w[c, i, k] > 0.0:
                    first = 3 + N_TENSOR * n_c + p * (n_k * c + k)
                    h[:] = 0.0
                    h[:3] = row[c, k, 0, d:last]
                    h[3 + N_TENSOR * c : 9 + N_TENSOR * c] = row[c, k, 0, a:d]
                    h[first : first + p] = row[c, k, 0, :p]
                    # All numbers of a sample are linearised at the state before it.
                    predicted = (h[3:] * at[3:]).sum()
                    scalar_update(x, P, h, row[c, k, 0, last] - predicted - (h * (x - at)).sum())
    return x, P


@kernel
def separate_filters(
    sensor: Sensor, y: FloatArray, w: FloatArray, r0: FloatArray, tensor0: FloatArray, p0: float, q: float
) -> tuple[FloatArray, FloatArray]:
    """The thesis's pair, once over all samples: position (3,) and tensors (C, 6).

    Args:
        sensor: geometry.
        y, w: (C, W, K) field, and one over its standard deviation (0 where there is no sample).
        r0, tensor0: (3,), (C, 6) where to begin.
        p0, q: P(0) = p0 I and Q = q I, for position and tensors alike.
    """
    n_c, n_w, n_k = y.shape
    r, m = r0.copy(), tensor0.copy()
    P_r, P_m = p0 * np.eye(3), np.empty((n_c, N_TENSOR, N_TENSOR))
    for c in range(n_c):
        P_m[c] = p0 * np.eye(N_TENSOR)
    p = sensor.basis.shape[1]
    row = np.empty((n_c, n_k, 1, p + PER_TARGET + 1))
    a, d, last = p, p + N_TENSOR, p + PER_TARGET
    for i in range(n_w):
        fill_row(sensor, y, w, i, r.reshape(1, 3), m.reshape(n_c, 1, N_TENSOR), row, 0)
        for c in range(n_c):
            _drift(P_m[c], q)
            for k in range(n_k):
                h = row[c, k, 0, a:d].copy()
                scalar_update(m[c], P_m[c], h, row[c, k, 0, last] - (h * m[c]).sum())
        _drift(P_r, q)
        fill_row(sensor, y, w, i, r.reshape(1, 3), m.reshape(n_c, 1, N_TENSOR), row, 0)
        at = r.copy()
        for c in range(n_c):
            for k in range(n_k):
                h = row[c, k, 0, d:last].copy()
                innovation = row[c, k, 0, last] - (row[c, k, 0, a:d] * m[c]).sum() - (h * (r - at)).sum()
                scalar_update(r, P_r, h, innovation)
    return r, m


@kernel
def _drift(P: FloatArray, q: float) -> None:
    for i in range(len(P)):
        P[i, i] += q


@kernel
def scalar_update(x: FloatArray, P: FloatArray, h: FloatArray, innovation: float) -> None:
    """Kalman update in place by one number of unit variance: x (n,), P (n, n), measurement row h (n,)."""
    n = x.size
    ph, s = np.empty(n), 1.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += P[i, j] * h[j]
        ph[i] = total
        s += h[i] * total
    for i in range(n):
        gain = ph[i] / s
        x[i] += gain * innovation
        for j in range(n):
            P[i, j] -= gain * ph[j]
