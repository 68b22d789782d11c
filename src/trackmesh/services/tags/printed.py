"""The six-dimensional unscented update as the slides print it, to compare with.

Slides on RFID tracking, section 8.4: sigma points in all six dimensions with kappa = -3, so that the centre weighs
W0 = kappa / (n + kappa) = -1 and the others 1/6, at sqrt(n / (1 - W0)) = sqrt(3) standard deviations; the state in the
order [e, ve, ae, n, vn, an]; all readers of an instant at once. With a negative weight covariances need not stay
covariances; a step after which one is none is given up, and the prediction kept, as the slides say.

With the position first, the four idle directions move no range, and this very update becomes the two-dimensional one of
``measurement``: the failures come with the order of the state.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.measurement import distance
from trackmesh.services.tags.records import Records

FloatArray = npt.NDArray[np.float64]

ORDER = np.array([0, 2, 4, 1, 3, 5])
"""Where the slides' components are in our state."""

_CENTRE, _OTHERS, _SPREAD = -1.0, 1.0 / 6.0, math.sqrt(3.0)


@kernel
def update_instant(x: FloatArray, P: FloatArray, readers: FloatArray, z: Records) -> bool:
    """Update a state (6,) and covariance (6, 6) with all ranges (m,) of one instant in place; whether it succeeded.

    If P, the covariance of the ranges or the new P is not positive definite nothing is changed.

    Args:
        readers: (R, 3) places [east, north, height above the tags].
        z: (m,) records of ``RANGE``.
    """
    n, m = 6, len(z)
    L = np.empty((n, n))
    if not cholesky(_reordered(P), L):
        return False
    points = np.zeros((2 * n + 1, n))
    d = np.empty((2 * n + 1, m))
    for k in range(2 * n + 1):
        for a in range(n):
            points[k, a] = 0.0 if k == 0 else (_SPREAD if k <= n else -_SPREAD) * L[a, (k - 1) % n]
        for i in range(m):
            d[k, i] = distance(x[0] + points[k, 0], x[1] + points[k, 3], readers[z[i].reader])
    mean = np.zeros(m)
    for k in range(2 * n + 1):
        for i in range(m):
            mean[i] += (_CENTRE if k == 0 else _OTHERS) * d[k, i]
    S, C = np.zeros((m, m)), np.zeros((n, m))
    for k in range(2 * n + 1):
        weight = _CENTRE if k == 0 else _OTHERS
        for i in range(m):
            for a in range(n):
                C[a, i] += weight * points[k, a] * (d[k, i] - mean[i])
            for j in range(m):
                S[i, j] += weight * (d[k, i] - mean[i]) * (d[k, j] - mean[j])
    for i in range(m):
        S[i, i] += z[i].variance + (z[i].relative * mean[i]) ** 2
    return _apply(x, P, C, S, mean, z)


@kernel
def _apply(x: FloatArray, P: FloatArray, C: FloatArray, S: FloatArray, mean: FloatArray, z: Records) -> bool:
    """K = C S^-1, x += K nu, P -= K S K^T by the Cholesky factor of S, where P stays positive definite."""
    n, m = C.shape
    root = np.empty((m, m))
    if not cholesky(S, root):
        return False
    # B = root^-1 C^T and v = root^-1 nu: K nu = B^T v and K S K^T = B^T B.
    B, v = np.empty((m, n)), np.empty(m)
    for i in range(m):
        v[i] = z[i].range_m - mean[i]
        for j in range(i):
            v[i] -= root[i, j] * v[j]
        v[i] /= root[i, i]
        for a in range(n):
            B[i, a] = C[a, i]
            for j in range(i):
                B[i, a] -= root[i, j] * B[j, a]
            B[i, a] /= root[i, i]
    after = _reordered(P)
    for a in range(n):
        for b in range(n):
            for i in range(m):
                after[a, b] -= B[i, a] * B[i, b]
    if not cholesky(after, np.empty((n, n))):
        return False
    for a in range(n):
        for i in range(m):
            x[ORDER[a]] += B[i, a] * v[i]
        for b in range(n):
            P[ORDER[a], ORDER[b]] = after[min(a, b), max(a, b)]
    return True


@kernel
def _reordered(P: FloatArray) -> FloatArray:
    """A covariance (>= 6, >= 6) in the slides' order, (6, 6)."""
    out = np.empty((6, 6))
    for a in range(6):
        for b in range(6):
            out[a, b] = P[ORDER[a], ORDER[b]]
    return out


@kernel
def cholesky(A: FloatArray, L: FloatArray) -> bool:
    """Write the lower factor of a symmetric matrix; False if it is not positive definite."""
    n = len(A)
    for a in range(n):
        for b in range(a + 1):
            value = A[a, b]
            for c in range(b):
                value -= L[a, c] * L[b, c]
            if a == b:
                if not value > 0.0:
                    return False
                L[a, a] = math.sqrt(value)
            else:
                L[a, b] = value / L[b, b]
        for b in range(a + 1, n):
            L[a, b] = 0.0
    return True
