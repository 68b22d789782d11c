"""The linear algebra of one scan at one trial position: design rows, Gram matrices, small solves.

For channel c the whitened field is y = A(r) m_c + D dr + N b + noise, with A (rows, 6) the response to the elements
of the polarizability tensor, D (rows, 3) its derivative by position, N the background columns of each component.
Everything that follows needs only the Gram matrix of [N A D y]; the background is eliminated from it, component by
component, which leaves the ``reduced`` matrix of [A D y], (10, 10) a channel.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.fields import (
    MU0,
    Symmetric,
    Vector,
    dyad,
    green,
    green_gradient,
    primary,
    times,
    vector,
)
from trackmesh.services.emi.kernels import FloatArray, IntArray, kernel

N_TENSOR = 6
REDUCED = N_TENSOR + 3 + 1
Y = REDUCED - 1
RIDGE = 1e-13
BLOCK = 256
SCALE = MU0 / (4.0 * pi)


class Sensor(NamedTuple):
    """Where the coils were at each of W samples, and what they are.

    Attributes:
        tx_m, rx_m: (W, 3) centre of the transmitter, place of the receiver.
        tx_axis: (W, 3) unit vectors.
        place_m: (W, 3) midway between the two, where a sample counts as taken.
        components: (K, 3) unit vectors of the measured components.
        basis: (W, p) background columns of each component, p = 0, 1 or 3.
        radius_m: of the transmitter loop; 0 for a point dipole.
        moment_am2: turns times current times area.
    """

    tx_m: FloatArray
    rx_m: FloatArray
    tx_axis: FloatArray
    place_m: FloatArray
    components: FloatArray
    basis: FloatArray
    radius_m: float
    moment_am2: float


@kernel
def symmetric(row: FloatArray) -> Symmetric:
    """A row (6,) of an array."""
    return (row[0], row[1], row[2], row[3], row[4], row[5])


@kernel
def sample_rows(sensor: Sensor, i: int, r: Vector, tensor: FloatArray, rows_a: FloatArray, rows_d: FloatArray) -> None:
    """Rows A (K, 6) and D (C, K, 3) of sample ``i`` for a target at ``r`` with ``tensor`` (C, 6).

    For a component e: A m = u^T M h with u = G e, and D = J M u - T e with J the gradient of the primary field h and
    T that of the target's.
    """
    tx, rx = sensor.tx_m, sensor.rx_m
    to_target = (r[0] - tx[i, 0], r[1] - tx[i, 1], r[2] - tx[i, 2])
    to_receiver = (rx[i, 0] - r[0], rx[i, 1] - r[1], rx[i, 2] - r[2])
    h, jac = primary(to_target, vector(sensor.tx_axis[i]), sensor.radius_m)
    g = green(to_receiver)
    for c in range(rows_d.shape[0]):
        m = symmetric(tensor[c])
        t = green_gradient(to_receiver, times(m, h))
        for k in range(sensor.components.shape[0]):
            e = component(sensor, k)
            turned, moved = times(jac, times(m, times(g, e))), times(t, e)
            for j in range(3):
                rows_d[c, k, j] = turned[j] - moved[j]
    for k in range(sensor.components.shape[0]):
        row = dyad(times(g, component(sensor, k)), h, 1.0, 0.0)
        for a in range(3):
            rows_a[k, a], rows_a[k, 3 + a] = 0.5 * row[a], row[3 + a]


@kernel
def component(sensor: Sensor, k: int) -> Vector:
    """Direction of component ``k``, scaled: from the coil's unit moment and G to T."""
    scale = SCALE * sensor.moment_am2
    return (scale * sensor.components[k, 0], scale * sensor.components[k, 1], scale * sensor.components[k, 2])


@kernel
def gram_matrices(
    sensor: Sensor, y: FloatArray, w: FloatArray, chosen: IntArray, r: FloatArray, tensor: FloatArray
) -> FloatArray:
    """Gram matrices (C, K, n, n) of the whitened columns [N A D y] over the ``chosen`` samples.

    Args:
        sensor: geometry.
        y, w: (C, W, K) field in T, and one over its standard deviation (0 where there is no sample).
        chosen: indices of samples.
        r: (3,) position of the target.
        tensor: (C, 6) tensor with which D is taken.
    """
    n_c, _, n_k = y.shape
    n = sensor.basis.shape[1] + REDUCED
    gram, columns = np.zeros((n_c, n_k, n, n)), np.empty((n_c, n_k, BLOCK, n))
    for first in range(0, chosen.size, BLOCK):
        block = chosen[first : first + BLOCK]
        fill_columns(sensor, y, w, block, vector(r), tensor, columns)
        for c in range(n_c):
            for k in range(n_k):
                x = columns[c, k, : block.size]
                gram[c, k] += np.dot(x.T, x)
    return gram


@kernel
def fill_columns(
    sensor: Sensor,
    y: FloatArray,
    w: FloatArray,
    chosen: IntArray,
    r: Vector,
    tensor: FloatArray,
    columns: FloatArray,
) -> None:
    """Whitened columns [N A D y] of the ``chosen`` samples into ``columns`` (C, K, at least as many, n)."""
    n_c, _, n_k = y.shape
    p = sensor.basis.shape[1]
    rows_a, rows_d = np.empty((n_k, N_TENSOR)), np.empty((n_c, n_k, 3))
    for row, i in enumerate(chosen):
        sample_rows(sensor, i, r, tensor, rows_a, rows_d)
        for c in range(n_c):
            for k in range(n_k):
                wt = w[c, i, k]
                for a in range(p):
                    columns[c, k, row, a] = wt * sensor.basis[i, a]
                for a in range(N_TENSOR):
                    columns[c, k, row, p + a] = wt * rows_a[k, a]
                for a in range(3):
                    columns[c, k, row, p + N_TENSOR + a] = wt * rows_d[c, k, a]
                columns[c, k, row, p + Y] = wt * y[c, i, k]


@kernel
def reduce_background(gram: FloatArray, p: int) -> FloatArray:
    """Eliminate the first ``p`` columns of each component and add the components: (C, 10, 10), symmetric."""
    n_c, n_k, n, _ = gram.shape
    reduced = np.zeros((n_c, REDUCED, REDUCED))
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
            for i in range(REDUCED):
                for j in range(REDUCED):
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
    """Background coefficients (C, K, p) that go with ``tensor`` (C, 6)."""
    n_c, n_k, n, _ = gram.shape
    levels = np.zeros((n_c, n_k, p))
    if p == 0:
        return levels
    left, right = np.empty((p, p)), np.empty((p, 1))
    for c in range(n_c):
        for k in range(n_k):
            for a in range(p):
                for b in range(p):
                    left[a, b] = gram[c, k, a, b]
                t = gram[c, k, a, n - 1]
                for q in range(N_TENSOR):
                    t -= gram[c, k, a, p + q] * tensor[c, q]
                right[a, 0] = t
            levels[c, k] = solve_spd(left, right)[:, 0]
    return levels


@kernel
def residuals(
    sensor: Sensor, y: FloatArray, w: FloatArray, r: FloatArray, tensor: FloatArray, levels: FloatArray
) -> FloatArray:
    """Whitened residuals (C, W, K), 0 where there is no sample."""
    n_c, n_w, n_k = y.shape
    out = np.zeros((n_c, n_w, n_k))
    rows_a, rows_d = np.empty((n_k, N_TENSOR)), np.empty((n_c, n_k, 3))
    place = vector(r)
    for i in range(n_w):
        sample_rows(sensor, i, place, tensor, rows_a, rows_d)
        for c in range(n_c):
            for k in range(n_k):
                model = 0.0
                for a in range(N_TENSOR):
                    model += rows_a[k, a] * tensor[c, a]
                for a in range(sensor.basis.shape[1]):
                    model += sensor.basis[i, a] * levels[c, k, a]
                out[c, i, k] = w[c, i, k] * (y[c, i, k] - model)
    return out
