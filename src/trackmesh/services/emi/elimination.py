"""Small linear algebra on Gram matrices: the background eliminated, the tensors solved."""

from __future__ import annotations

from math import sqrt

import numpy as np

from trackmesh.services.emi.kernels import FloatArray, kernel

RIDGE = 1e-13


@kernel
def reduce_background(gram: FloatArray, p: int) -> FloatArray:
    """Eliminate the first ``p`` columns of each component and add the components: (C, n - p, n - p), symmetric."""
    n_c, n_k, n, _ = gram.shape
    m = n - p
    reduced = np.zeros((n_c, m, m))
    for c in range(n_c):
        for k in range(n_k):
            block = gram[c, k].copy()
            for a in range(p):
                pivot = block[a, a]
                if pivot <= RIDGE * gram[c, k, a, a]:
                    continue
                for i in range(a + 1, n):
                    factor = block[a, i] / pivot
                    for j in range(i, n):
                        block[i, j] -= factor * block[a, j]
            for i in range(m):
                for j in range(m):
                    reduced[c, i, j] += block[p + min(i, j), p + max(i, j)]
    return reduced


@kernel
def solve_spd(a: FloatArray, b: FloatArray) -> FloatArray:
    """Solve ``a`` x = ``b`` (n, k) for positive semidefinite ``a`` (n, n), scaled to a unit diagonal.

    A pivot below the ridge is taken as a direction without information: its unknown is left at (nearly) zero.
    """
    n, cols = b.shape
    scale, low, x = np.empty(n), np.zeros((n, n)), np.empty((n, cols))
    for i in range(n):
        scale[i] = 1.0 / sqrt(a[i, i]) if a[i, i] > 0.0 else 0.0
    for i in range(n):
        for j in range(i + 1):
            t = a[i, j] * scale[i] * scale[j]
            for q in range(j):
                t -= low[i, q] * low[j, q]
            if i > j:
                low[i, j] = t / low[j, j]
            else:
                low[i, i] = sqrt(t) if t > RIDGE else 1e150
    for col in range(cols):
        for i in range(n):
            t = b[i, col] * scale[i]
            for q in range(i):
                t -= low[i, q] * x[q, col]
            x[i, col] = t / low[i, i]
        for i in range(n - 1, -1, -1):
            t = x[i, col]
            for q in range(i + 1, n):
                t -= low[q, i] * x[q, col]
            x[i, col] = t / low[i, i]
        for i in range(n):
            x[i, col] *= scale[i]
    return x


@kernel
def background_levels(gram: FloatArray, p: int, tensor: FloatArray) -> FloatArray:
    """Background coefficients (C, K, p) that go with ``tensor`` (C, T, 6)."""
    n_c, n_k, n, _ = gram.shape
    levels = np.zeros((n_c, n_k, p))
    if p == 0:
        return levels
    left, right = np.empty((p, p)), np.empty((p, 1))
    for c in range(n_c):
        m = tensor[c].ravel()
        for k in range(n_k):
            for a in range(p):
                for b in range(p):
                    left[a, b] = gram[c, k, a, b]
                t = gram[c, k, a, n - 1]
                for q in range(m.size):
                    t -= gram[c, k, a, p + q] * m[q]
                right[a, 0] = t
            levels[c, k] = solve_spd(left, right)[:, 0]
    return levels
