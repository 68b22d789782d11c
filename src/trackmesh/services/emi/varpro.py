"""Separable least squares for one target: the position is searched, the tensor and the background are solved.

Levenberg-Marquardt on the Schur complement S = D'D - D'A (A'A)^-1 A'D of the Gram matrix (variable projection,
G. H. Golub and V. Pereyra, 1973, with L. Kaufman's form of the Jacobian). The matrix that is left at the end is the
Fisher matrix of position and tensor.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, Sensor, Y, gram_matrices, reduce_background, solve_spd
from trackmesh.services.emi.kernels import FloatArray, IntArray, kernel

STEP_LIMIT = 0.5
"""Longest step, in depths."""


class Bounds(NamedTuple):
    """Box (3,), (3,) in which the target is searched, and the height its depth is counted from."""

    lower_m: FloatArray
    upper_m: FloatArray
    surface_m: float


class Local(NamedTuple):
    """Where one search ended: position (3,), tensor (C, 6), reduced matrix of the window (C, 10, 10), its samples."""

    r_m: FloatArray
    tensor_m3: FloatArray
    reduced: FloatArray
    n_window: int
    iterations: int
    converged: bool


@kernel
def evaluate(
    sensor: Sensor, y: FloatArray, w: FloatArray, chosen: IntArray, r: FloatArray, tensor: FloatArray
) -> FloatArray:
    """Reduced matrix (C, 10, 10) at ``r``."""
    return reduce_background(gram_matrices(sensor, y, w, chosen, r, tensor), sensor.basis.shape[1])


@kernel
def linear_part(reduced: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Tensor (C, 6), (A'A)^-1 A'D (C, 6, 3), and the residual sum of squares."""
    n_c = reduced.shape[0]
    tensor, slope, rss = np.empty((n_c, N_TENSOR)), np.empty((n_c, N_TENSOR, 3)), 0.0
    for c in range(n_c):
        x = solve_spd(reduced[c, :N_TENSOR, :N_TENSOR], reduced[c, :N_TENSOR, N_TENSOR:])
        tensor[c], slope[c] = x[:, 3], x[:, :3]
        rss += reduced[c, Y, Y]
        for a in range(N_TENSOR):
            rss -= reduced[c, a, Y] * tensor[c, a]
    return tensor, slope, max(rss, 0.0)


@kernel
def position_step(reduced: FloatArray, tensor: FloatArray, slope: FloatArray, damping: float) -> FloatArray:
    """Levenberg-Marquardt step (3,)."""
    left, right = np.zeros((3, 3)), np.zeros((3, 1))
    for c in range(reduced.shape[0]):
        for i in range(3):
            right[i, 0] += reduced[c, N_TENSOR + i, Y]
            for a in range(N_TENSOR):
                right[i, 0] -= reduced[c, N_TENSOR + i, a] * tensor[c, a]
            for j in range(3):
                left[i, j] += reduced[c, N_TENSOR + i, N_TENSOR + j]
                for a in range(N_TENSOR):
                    left[i, j] -= reduced[c, N_TENSOR + i, a] * slope[c, a, j]
    for i in range(3):
        left[i, i] *= 1.0 + damping
    return solve_spd(left, right)[:, 0]


@kernel
def bounded_move(r: FloatArray, step: FloatArray, bounds: Bounds) -> FloatArray:
    """``r`` + ``step``, the step no longer than half the depth, the end inside the box."""
    length = sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    limit = STEP_LIMIT * (bounds.surface_m - r[2])
    factor = limit / length if length > limit else 1.0
    end = np.empty(3)
    for i in range(3):
        end[i] = min(max(r[i] + factor * step[i], bounds.lower_m[i]), bounds.upper_m[i])
    return end


@kernel
def search(
    sensor: Sensor,
    y: FloatArray,
    w: FloatArray,
    chosen: IntArray,
    start: FloatArray,
    tensor: FloatArray,
    bounds: Bounds,
    tolerance: float,
    stall: float,
    most: int,
) -> Local:
    """Minimise over the position from ``start`` (and a ``tensor`` near to its best there) on the ``chosen`` samples.

    The tensor at which D is taken is the one the last step predicts: one pass over the samples an iteration, and
    the same fixed point as with the exact one. The search ends when a step is shorter than ``tolerance`` depths, or
    lowers the sum of squares by less than ``stall`` noise variances (a step of sqrt(stall) standard deviations), or
    after ``most`` iterations.
    """
    r = start.copy()
    reduced = evaluate(sensor, y, w, chosen, r, tensor)
    tensor, slope, rss = linear_part(reduced)
    damping, iterations, converged = 1e-3, 0, False
    stall /= chosen.size * y.shape[0] * y.shape[2]
    while iterations < most and not converged:
        iterations += 1
        end = bounded_move(r, position_step(reduced, tensor, slope, damping), bounds)
        move = end - r
        trial = evaluate(sensor, y, w, chosen, end, predicted_tensor(tensor, slope, move))
        tensor_end, slope_end, rss_end = linear_part(trial)
        converged = norm(move) < tolerance * (bounds.surface_m - r[2]) or abs(rss - rss_end) < stall * rss
        if rss_end <= rss or converged:
            r, tensor, slope, reduced, rss = end, tensor_end, slope_end, trial, rss_end
            damping = max(0.1 * damping, 1e-9)
        else:
            damping = max(10.0 * damping, 1e-3)
    return Local(r, tensor, reduced, chosen.size, iterations, converged)


@kernel
def predicted_tensor(tensor: FloatArray, slope: FloatArray, move: FloatArray) -> FloatArray:
    """The tensor (C, 6) that goes with a position moved by ``move``, to first order."""
    out = tensor.copy()
    for c in range(tensor.shape[0]):
        for a in range(N_TENSOR):
            for j in range(3):
                out[c, a] -= slope[c, a, j] * move[j]
    return out


@kernel
def norm(v: FloatArray) -> float:
    """Length of a vector (3,)."""
    return sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
