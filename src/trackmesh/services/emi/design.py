"""Design rows of T targets at trial positions, and their Gram matrices.

For channel c the whitened field is y = sum_t A(r_t) m_ct + D_t dr_t + N b + noise, with A (rows, 6) the response to
the elements of a polarizability tensor, D (rows, 3) its derivative by position, N the background columns of each
component. Everything that follows needs only the Gram matrices of [N A_1..A_T D_1..D_T y].

Transmitter and receiver enter alike (reciprocity): a component measures u^T M h, with h the field of the transmitter at
the target and u that of the receiver, were it driven; D = J_h M u + J_u M h with the gradients J of both.
"""

from __future__ import annotations

from math import pi

import numpy as np

from trackmesh.services.emi.fields import MU0, green, green_gradient, loop_primary, primary
from trackmesh.services.emi.kernels import FloatArray, IntArray, inlined, kernel
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.vectors import (
    Symmetric,
    Vector,
    dot,
    dyad,
    inner_symmetric,
    inner_vector,
    minus,
    scaled,
    times,
    vector,
)

N_TENSOR = 6
PER_TARGET = N_TENSOR + 3
BLOCK = 64
SCALE = MU0 / (4.0 * pi)


@inlined
def fill_row(
    sensor: Sensor,
    y: FloatArray,
    w: FloatArray,
    i: int,
    r: FloatArray,
    tensor: FloatArray,
    columns: FloatArray,
    row: int,
) -> None:
    """Whitened [N A D y] of sample ``i`` into ``row`` of ``columns`` (C, K, at least as many, n).

    For targets at ``r`` (T, 3) with ``tensor`` (C, T, 6).
    """
    n_t, p = r.shape[0], sensor.basis.shape[1]
    tx, axis = vector(sensor.tx_m, i), vector(sensor.tx_axis, i)
    for t in range(n_t):
        place = vector(r, t)
        h, jac = primary(minus(place, tx), axis, sensor.radius_m)
        for j in range(sensor.rx_radius_m.size):
            if sensor.rx_radius_m[j] > 0.0:
                _coil_rows(sensor, w, i, j, t, place, h, jac, tensor, columns, row)
            else:
                _point_rows(sensor, w, i, j, t, place, h, jac, tensor, columns, row)
    for c in range(y.shape[0]):
        for k in range(y.shape[2]):
            wt = w[c, i, k]
            for a in range(p):
                columns[c, k, row, a] = wt * sensor.basis[i, a]
            columns[c, k, row, p + PER_TARGET * n_t] = wt * y[c, i, k]


@inlined
def _point_rows(
    sensor: Sensor,
    w: FloatArray,
    i: int,
    j: int,
    t: int,
    place: Vector,
    h: Vector,
    jac: Symmetric,
    tensor: FloatArray,
    columns: FloatArray,
    row: int,
) -> None:
    """A and D of a receiver that measures at a point: u = G e."""
    to_receiver = minus(inner_vector(sensor.rx_m, i, j), place)
    p, scale = sensor.basis.shape[1], SCALE * sensor.moment_am2
    g = green(to_receiver)
    for c in range(tensor.shape[0]):
        m = inner_symmetric(tensor, c, t)
        # G is symmetric in all its derivatives: the gradient of G e, applied to M h, is that of G M h, applied to e.
        gradient = green_gradient(to_receiver, times(m, h))
        for k in range(sensor.first[j], sensor.first[j + 1]):
            e = inner_vector(sensor.direction, i, k)
            u, wt = times(g, e), scale * w[c, i, k]
            _put(
                columns, c, k, row, p, t, tensor.shape[1], wt, u, h, minus(times(jac, times(m, u)), times(gradient, e))
            )


@inlined
def _coil_rows(
    sensor: Sensor,
    w: FloatArray,
    i: int,
    j: int,
    t: int,
    place: Vector,
    h: Vector,
    jac: Symmetric,
    tensor: FloatArray,
    columns: FloatArray,
    row: int,
) -> None:
    """A and D of a receiving coil: u is the field of a loop."""
    from_receiver = minus(place, inner_vector(sensor.rx_m, i, j))
    p, scale = sensor.basis.shape[1], 4.0 * pi * SCALE * sensor.moment_am2
    for k in range(sensor.first[j], sensor.first[j + 1]):
        u, gradient = loop_primary(from_receiver, inner_vector(sensor.direction, i, k), sensor.rx_radius_m[j])
        for c in range(tensor.shape[0]):
            m = inner_symmetric(tensor, c, t)
            moved = scaled(times(gradient, times(m, h)), -1.0)
            wt = scale * w[c, i, k]
            _put(columns, c, k, row, p, t, tensor.shape[1], wt, u, h, minus(times(jac, times(m, u)), moved))


@inlined
def _put(
    columns: FloatArray,
    c: int,
    k: int,
    row: int,
    p: int,
    t: int,
    n_t: int,
    wt: float,
    u: Vector,
    h: Vector,
    d: Vector,
) -> None:
    product = dyad(u, h, wt, 0.0)
    at_a, at_d = p + N_TENSOR * t, p + N_TENSOR * n_t + 3 * t
    for a in range(3):
        columns[c, k, row, at_a + a] = 0.5 * product[a]
        columns[c, k, row, at_a + 3 + a] = product[3 + a]
        columns[c, k, row, at_d + a] = wt * d[a]


@kernel
def gram_matrices(
    sensor: Sensor, y: FloatArray, w: FloatArray, chosen: IntArray, r: FloatArray, tensor: FloatArray
) -> FloatArray:
    """Gram matrices (C, K, n, n) of the whitened columns [N A D y] over the ``chosen`` samples, n = p + 9 T + 1.

    Args:
        sensor: geometry.
        y, w: (C, W, K) field in T, and one over its standard deviation (0 where there is no sample).
        chosen: indices of samples.
        r: (T, 3) positions of the targets.
        tensor: (C, T, 6) tensors with which D is taken.
    """
    n_c, _, n_k = y.shape
    n = sensor.basis.shape[1] + PER_TARGET * r.shape[0] + 1
    gram, columns = np.zeros((n_c, n_k, n, n)), np.empty((n_c, n_k, BLOCK, n))
    for first in range(0, chosen.size, BLOCK):
        block = chosen[first : first + BLOCK]
        fill_columns(sensor, y, w, block, r, tensor, columns)
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
    r: FloatArray,
    tensor: FloatArray,
    columns: FloatArray,
) -> None:
    """Whitened columns [N A D y] of the ``chosen`` samples into ``columns`` (C, K, at least as many, n)."""
    for row in range(chosen.size):
        fill_row(sensor, y, w, chosen[row], r, tensor, columns, row)


@kernel
def model_field(sensor: Sensor, r: FloatArray, tensor: FloatArray, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What targets at ``r`` (T, 3) with ``tensor`` (C, T, 6) send back, and what lies beneath: (C, W, K) each, in T.

    ``levels`` (C, K, p) are the coefficients of the background columns.
    """
    n_c, n_w, n_k = tensor.shape[0], sensor.direction.shape[0], sensor.direction.shape[1]
    signal, beneath = np.zeros((n_c, n_w, n_k)), np.zeros((n_c, n_w, n_k))
    for i in range(n_w):
        for t in range(r.shape[0]):
            _add_signal(sensor, i, t, vector(r, t), tensor, signal)
        for c in range(n_c):
            for k in range(n_k):
                for a in range(sensor.basis.shape[1]):
                    beneath[c, i, k] += sensor.basis[i, a] * levels[c, k, a]
    return signal, beneath


@inlined
def _add_signal(sensor: Sensor, i: int, t: int, place: Vector, tensor: FloatArray, signal: FloatArray) -> None:
    h, _ = primary(minus(place, vector(sensor.tx_m, i)), vector(sensor.tx_axis, i), sensor.radius_m)
    scale = SCALE * sensor.moment_am2
    for j in range(sensor.rx_radius_m.size):
        from_receiver = minus(place, inner_vector(sensor.rx_m, i, j))
        for k in range(sensor.first[j], sensor.first[j + 1]):
            e = inner_vector(sensor.direction, i, k)
            if sensor.rx_radius_m[j] > 0.0:
                u = scaled(loop_primary(from_receiver, e, sensor.rx_radius_m[j])[0], 4.0 * pi)
            else:
                u = times(green(from_receiver), e)
            for c in range(tensor.shape[0]):
                signal[c, i, k] += scale * dot(u, times(inner_symmetric(tensor, c, t), h))


def response_rows(sensor: Sensor, r: FloatArray) -> FloatArray:
    """Rows A (W, K, 6) of all samples for one target at ``r`` (1, 3), in T per m^3."""
    n_w, n_k = sensor.direction.shape[:2]
    p = sensor.basis.shape[1]
    columns = np.empty((1, n_k, n_w, p + PER_TARGET + 1))
    nothing, every = np.zeros((1, n_w, n_k)), np.arange(n_w)
    fill_columns(sensor, nothing, np.ones_like(nothing), every, r, np.zeros((1, 1, N_TENSOR)), columns)
    return np.ascontiguousarray(columns[0, :, :, p : p + N_TENSOR].transpose(1, 0, 2))
