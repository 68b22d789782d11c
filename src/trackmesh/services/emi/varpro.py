"""Separable least squares: positions are searched, tensors and background are solved.

Levenberg-Marquardt on the Schur complement S = D'D - D'A (A'A)^-1 A'D of the Gram matrix (variable projection,
G. H. Golub and V. Pereyra, 1973, with L. Kaufman's form of the Jacobian). The matrix that is left at the end is the
Fisher matrix of positions and tensors.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, gram_matrices
from trackmesh.services.emi.elimination import background_levels, reduce_background, solve_spd
from trackmesh.services.emi.kernels import FloatArray, IntArray, kernel
from trackmesh.services.emi.sensor import Sensor

STEP_LIMIT = 0.5
"""Longest step, in depths."""
LEAST_DEPTH = 1e-3


class Bounds(NamedTuple):
    """Box (3,), (3,) in which targets are searched, and the height their depths are counted from."""

    lower_m: FloatArray
    upper_m: FloatArray
    surface_m: float


class Prior(NamedTuple):
    """What is known beforehand of the first target: mean (3,) and inverse covariance (3, 3) of its position."""

    mean_m: FloatArray
    information: FloatArray


class Ground(NamedTuple):
    """What a search is given beside the data.

    Attributes:
        bounds: where targets may be.
        prior: of the first one.
        sigma_known: whether the weights are those of the noise; if not, only the ratios of them are.
    """

    bounds: Bounds
    prior: Prior
    sigma_known: bool


class Stop(NamedTuple):
    """When a search ends.

    Attributes:
        tolerance: at a step shorter than this, in depths,
        stall: or one that lowers the sum of squares by less than this, in noise variances,
        most: or after so many iterations.
    """

    tolerance: float
    stall: float
    most: int


class Local(NamedTuple):
    """Where one search ended.

    Attributes:
        r_m: (T, 3).
        tensor_m3: (C, T, 6).
        reduced: (C, 9 T + 1, 9 T + 1) Gram matrix of [A D y] over its samples, the background eliminated.
        n_window: its samples.
        iterations: done.
        converged: whether it ended by a small step.
    """

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
    """Reduced matrix (C, 9 T + 1, 9 T + 1) at ``r`` (T, 3)."""
    return reduce_background(gram_matrices(sensor, y, w, chosen, r, tensor), sensor.basis.shape[1])


@kernel
def linear_part(reduced: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Tensors (C, T, 6), (A'A)^-1 A'D (C, 6 T, 3 T), and the residual sum of squares."""
    n_c, last = reduced.shape[0], reduced.shape[1] - 1
    n_t = last // 9
    n_a = N_TENSOR * n_t
    tensor, slope, rss = np.empty((n_c, n_t, N_TENSOR)), np.empty((n_c, n_a, 3 * n_t)), 0.0
    for c in range(n_c):
        x = solve_spd(reduced[c, :n_a, :n_a], reduced[c, :n_a, n_a:])
        slope[c] = x[:, :-1]
        rss += reduced[c, last, last]
        for a in range(n_a):
            tensor[c, a // N_TENSOR, a % N_TENSOR] = x[a, -1]
            rss -= reduced[c, a, last] * x[a, -1]
    return tensor, slope, max(rss, 0.0)


@kernel
def prior_weight(rss: float, numbers: int, ground: Ground) -> float:
    """The noise variance in units of the weights: what the prior has to be multiplied by."""
    return 1.0 if ground.sigma_known else rss / numbers


@kernel
def prior_misfit(r: FloatArray, prior: Prior) -> float:
    """Mahalanobis distance of the first target from its prior, squared."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += (r[0, i] - prior.mean_m[i]) * prior.information[i, j] * (r[0, j] - prior.mean_m[j])
    return total


@kernel
def position_step(
    reduced: FloatArray, tensor: FloatArray, slope: FloatArray, damping: float, r: FloatArray, prior: Prior, pull: float
) -> FloatArray:
    """Levenberg-Marquardt step (T, 3); the prior counts ``pull`` times."""
    n_a, n_d = slope.shape[1], slope.shape[2]
    left, right = np.zeros((n_d, n_d)), np.zeros((n_d, 1))
    for c in range(reduced.shape[0]):
        m = tensor[c].ravel()
        for i in range(n_d):
            right[i, 0] += reduced[c, n_a + i, n_a + n_d]
            for a in range(n_a):
                right[i, 0] -= reduced[c, n_a + i, a] * m[a]
            for j in range(n_d):
                left[i, j] += reduced[c, n_a + i, n_a + j]
                for a in range(n_a):
                    left[i, j] -= reduced[c, n_a + i, a] * slope[c, a, j]
    for i in range(3):
        for j in range(3):
            left[i, j] += pull * prior.information[i, j]
            right[i, 0] -= pull * prior.information[i, j] * (r[0, j] - prior.mean_m[j])
    for i in range(n_d):
        left[i, i] *= 1.0 + damping
    return solve_spd(left, right).reshape(r.shape)


@kernel
def depth_of(r: FloatArray, bounds: Bounds) -> float:
    """Distance of a place (3,) from the height of the sensor."""
    return float(max(abs(bounds.surface_m - r[2]), LEAST_DEPTH))


@kernel
def bounded_move(r: FloatArray, step: FloatArray, bounds: Bounds) -> FloatArray:
    """``r`` + ``step`` (T, 3), no target moved by more than half its depth, the end inside the box."""
    end = np.empty(r.shape)
    for t in range(r.shape[0]):
        length, limit = norm(step[t]), STEP_LIMIT * depth_of(r[t], bounds)
        factor = limit / length if length > limit else 1.0
        for i in range(3):
            end[t, i] = min(max(r[t, i] + factor * step[t, i], bounds.lower_m[i]), bounds.upper_m[i])
    return end


@kernel
def search(
    sensor: Sensor,
    y: FloatArray,
    w: FloatArray,
    chosen: IntArray,
    start: FloatArray,
    tensor: FloatArray,
    ground: Ground,
    stop: Stop,
) -> Local:
    """Minimise over the positions from ``start`` (T, 3) and ``tensor`` (near to its best there) on ``chosen`` samples.

    The tensor at which D is taken is the one the last step predicts: one pass over the samples an iteration, and
    the same fixed point as with the exact one.
    """
    r = start.copy()
    reduced = evaluate(sensor, y, w, chosen, r, tensor)
    tensor, slope, rss = linear_part(reduced)
    damping, iterations, converged = 1e-3, 0, False
    numbers = chosen.size * y.shape[0] * y.shape[2]
    while iterations < stop.most and not converged:
        iterations += 1
        pull = prior_weight(rss, numbers, ground)
        step = position_step(reduced, tensor, slope, damping, r, ground.prior, pull)
        end = bounded_move(r, step, ground.bounds)
        trial = evaluate(sensor, y, w, chosen, end, predicted_tensor(tensor, slope, end - r))
        tensor_end, slope_end, rss_end = linear_part(trial)
        gain = rss - rss_end + pull * (prior_misfit(r, ground.prior) - prior_misfit(end, ground.prior))
        converged = moved_little(r, end, ground.bounds, stop.tolerance) or abs(gain) < stop.stall / numbers * rss
        if gain >= 0.0 or converged:
            r, tensor, slope, reduced, rss = end, tensor_end, slope_end, trial, rss_end
            damping = max(0.1 * damping, 1e-9)
        else:
            damping = max(10.0 * damping, 1e-3)
    return Local(r, tensor, reduced, chosen.size, iterations, converged)


@kernel
def moved_little(r: FloatArray, end: FloatArray, bounds: Bounds, share: float) -> bool:
    """Whether no target moved by more than ``share`` of its depth."""
    furthest = 0.0
    for t in range(r.shape[0]):
        furthest = max(furthest, norm(end[t] - r[t]) / depth_of(r[t], bounds))
    return furthest < share


@kernel
def predicted_tensor(tensor: FloatArray, slope: FloatArray, move: FloatArray) -> FloatArray:
    """The tensors (C, T, 6) that go with positions moved by ``move`` (T, 3), to first order."""
    out = tensor.copy()
    for c in range(tensor.shape[0]):
        for a in range(slope.shape[1]):
            for j in range(slope.shape[2]):
                out[c, a // N_TENSOR, a % N_TENSOR] -= slope[c, a, j] * move[j // 3, j % 3]
    return out


def inside(r: FloatArray, bounds: Bounds) -> bool:
    """Whether places (..., 3) lie within the box and not on its walls."""
    return bool(((r > bounds.lower_m) & (r < bounds.upper_m)).all())


@kernel
def norm(v: FloatArray) -> float:
    """Length of a vector (3,)."""
    return sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)


@kernel
def levels_and_gain(
    sensor: Sensor, y: FloatArray, w: FloatArray, r: FloatArray, tensor: FloatArray
) -> tuple[FloatArray, float]:
    """Over all samples: background levels (C, K, p) that go with ``tensor``, and how much targets at ``r`` explain."""
    p = sensor.basis.shape[1]
    gram = gram_matrices(sensor, y, w, np.arange(y.shape[1]), r, tensor)
    reduced, total = reduce_background(gram, p), 0.0
    for c in range(y.shape[0]):
        total += reduced[c, -1, -1]
    return background_levels(gram, p, tensor), total - linear_part(reduced)[2]
