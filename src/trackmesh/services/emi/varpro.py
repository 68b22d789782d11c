"""Separable least squares for one target: the position is searched, the tensor and the background are solved.

Levenberg-Marquardt on the Schur complement S = D'D - D'A (A'A)^-1 A'D of the Gram matrix (variable projection,
G. H. Golub and V. Pereyra, 1973, with L. Kaufman's form of the Jacobian). The matrix that is left at the end is the
Fisher matrix of position and tensor.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import (
    N_TENSOR,
    Sensor,
    Y,
    background_levels,
    gram_matrices,
    reduce_background,
    residuals,
    solve_spd,
)
from trackmesh.services.emi.kernels import FloatArray, IntArray, kernel
from trackmesh.services.emi.start import spikes_cut, start_points

MAX_ITERATIONS = 30
MAX_PASSES = 4
MIN_WINDOW = 64
MAX_WIDENINGS = 32
STEP_LIMIT = 0.5
TOLERANCE = 1e-6
COARSE = 3e-3
COARSE_SAMPLES = 512
HUBER = 2.5
OUTLIER = 4.7
ROBUST_ROUNDS = 4
ROUNDING = 1e-9
STAYS = 0.1


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


class Fit(NamedTuple):
    """One target fitted to one scan, in whitened units but for position and tensor.

    Attributes:
        r_m: (3,).
        tensor_m3: (C, 6).
        reduced: (C, 10, 10) Gram matrix of [A D y] over the window, from which the Fisher matrix is read.
        explained: by how much the target lowers the residual sum of squares of all samples, beside the background.
        chi2: residual sum of squares of all samples, outliers left out.
        scale: robust standard deviation of the whitened residuals of all samples.
        n_outliers: numbers left out of chi2 and weighed down in the fit.
        n_window: samples in the window.
        iterations: over all starts and passes.
        converged: whether the last search ended by a small step.
    """

    r_m: FloatArray
    tensor_m3: FloatArray
    reduced: FloatArray
    explained: float
    chi2: float
    scale: float
    n_outliers: int
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
) -> Local:
    """Minimise over the position from ``start`` (and a ``tensor`` near to its best there) on the ``chosen`` samples.

    The tensor at which D is taken is the one the last step predicts: one pass over the samples an iteration, and
    the same fixed point as with the exact one.
    """
    r = start.copy()
    reduced = evaluate(sensor, y, w, chosen, r, tensor)
    tensor, slope, rss = linear_part(reduced)
    damping, iterations, converged = 1e-3, 0, False
    while iterations < MAX_ITERATIONS and not converged:
        iterations += 1
        end = bounded_move(r, position_step(reduced, tensor, slope, damping), bounds)
        move = end - r
        trial = evaluate(sensor, y, w, chosen, end, predicted_tensor(tensor, slope, move))
        tensor_end, slope_end, rss_end = linear_part(trial)
        converged = norm(move) < tolerance * (bounds.surface_m - r[2])
        if rss_end <= rss * (1.0 + 1e-12) or converged:
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


@kernel
def window(sensor: Sensor, centre: FloatArray, radius: float) -> IntArray:
    """Samples within ``radius`` (horizontally) of ``centre``; the radius grows until there are enough of them."""
    n = sensor.place_m.shape[0]
    chosen = np.empty(n, np.int64)
    for _ in range(MAX_WIDENINGS):
        count = 0
        for i in range(n):
            dx, dy = sensor.place_m[i, 0] - centre[0], sensor.place_m[i, 1] - centre[1]
            if dx * dx + dy * dy <= radius * radius:
                chosen[count] = i
                count += 1
        if count >= min(n, MIN_WINDOW):
            return chosen[:count]
        radius *= 1.5
    return np.arange(n)


@kernel
def thinned(chosen: IntArray, limit: int) -> IntArray:
    """About ``limit`` of the samples, taken evenly without falling into step with the lines of a grid."""
    if chosen.size <= limit:
        return chosen
    share, golden = limit / chosen.size, 0.6180339887498949
    return chosen[(np.arange(chosen.size) * golden) % 1.0 < share]


@kernel
def windowed_search(
    sensor: Sensor, y: FloatArray, w: FloatArray, start: FloatArray, bounds: Bounds, radius_in_depths: float
) -> Local:
    """Search on a window about the target: roughly on some of its samples until it stays, then on all of them."""
    centre, iterations = start, 0
    depth = bounds.surface_m - start[2]
    chosen = thinned(window(sensor, start, radius_in_depths * depth), COARSE_SAMPLES)
    tensor = linear_part(evaluate(sensor, y, w, chosen, start, np.zeros((y.shape[0], N_TENSOR))))[0]
    for _ in range(MAX_PASSES):
        found = search(sensor, y, w, chosen, centre, tensor, bounds, COARSE)
        moved = norm(found.r_m - centre)
        centre, tensor, iterations = found.r_m, found.tensor_m3, iterations + found.iterations
        if moved < STAYS * depth:
            break
        depth = bounds.surface_m - centre[2]
        chosen = thinned(window(sensor, centre, radius_in_depths * depth), COARSE_SAMPLES)
    chosen = window(sensor, centre, radius_in_depths * (bounds.surface_m - centre[2]))
    found = search(sensor, y, w, chosen, centre, tensor, bounds, TOLERANCE)
    return Local(
        found.r_m, found.tensor_m3, found.reduced, found.n_window, iterations + found.iterations, found.converged
    )


@kernel
def over_all(sensor: Sensor, y: FloatArray, w: FloatArray, found: Local) -> tuple[float, float]:
    """Residual sum of squares over all samples (linear part solved over all), and the same without a target."""
    every = np.arange(y.shape[1])
    reduced = evaluate(sensor, y, w, every, found.r_m, found.tensor_m3)
    total = 0.0
    for c in range(y.shape[0]):
        total += reduced[c, Y, Y]
    return linear_part(reduced)[2], total


@kernel
def robust_scale(e: FloatArray, w: FloatArray) -> float:
    """Standard deviation of the residuals by their median absolute value, over what has a weight."""
    flat_e, flat_w = e.ravel(), w.ravel()
    return float(1.4826 * np.median(np.abs(flat_e[flat_w > 0.0])))


@kernel
def huber_weights(e: FloatArray, w: FloatArray, scale: float) -> FloatArray:
    """Weights for the next round: ``w`` times sqrt(min(1, k s / |e|))."""
    out = w.copy()
    flat_e, flat_out = e.ravel(), out.ravel()
    for i in range(flat_e.size):
        size = abs(flat_e[i])
        if size > HUBER * scale:
            flat_out[i] *= sqrt(HUBER * scale / size)
    return out


@kernel
def sum_of_squares(e: FloatArray, limit: float) -> tuple[float, int]:
    """Sum of squares of what is not above ``limit``, and how many are."""
    total, count = 0.0, 0
    for value in e.ravel():
        if abs(value) > limit:
            count += 1
        else:
            total += value * value
    return total, count


@kernel
def all_residuals(sensor: Sensor, y: FloatArray, w: FloatArray, weights: FloatArray, found: Local) -> FloatArray:
    """Residuals (C, W, K) whitened by ``w``; the background is fitted with ``weights``."""
    every = np.arange(y.shape[1])
    gram = gram_matrices(sensor, y, weights, every, found.r_m, found.tensor_m3)
    levels = background_levels(gram, sensor.basis.shape[1], found.tensor_m3)
    return residuals(sensor, y, w, found.r_m, found.tensor_m3, levels)


@kernel
def fit_target(
    sensor: Sensor,
    y: FloatArray,
    w: FloatArray,
    bounds: Bounds,
    robust: bool,
    radius_in_depths: float,
    good_rss: float,
    good_share: float,
) -> Fit:
    """The best single target of one scan.

    Args:
        sensor: geometry.
        y, w: (C, W, K) field in T, and one over its standard deviation (0: no sample).
        bounds: where the target may be.
        robust: find spikes before the search, and weigh outliers down (Huber) after it.
        radius_in_depths: of the window.
        good_rss, good_share: a fit over all samples with a smaller residual, or with a smaller share of the total,
            needs no other start.
    """
    weights = spikes_cut(sensor, y, w) if robust else w
    starts = start_points(sensor, y, weights, bounds.lower_m, bounds.upper_m, bounds.surface_m)
    best = windowed_search(sensor, y, weights, starts[0], bounds, radius_in_depths)
    rss, total = over_all(sensor, y, weights, best)
    iterations = best.iterations
    for s in range(1, starts.shape[0]):
        if rss <= good_rss or rss <= good_share * total:
            break
        other = windowed_search(sensor, y, weights, starts[s], bounds, radius_in_depths)
        rss_other, total = over_all(sensor, y, weights, other)
        iterations += other.iterations
        if rss_other < rss:
            best, rss = other, rss_other
    e = all_residuals(sensor, y, w, weights, best)
    scale, limit = robust_scale(e, w), np.inf
    if robust and np.max(np.abs(e)) > OUTLIER * scale > ROUNDING * sqrt(total):
        for _ in range(ROBUST_ROUNDS):
            weights = huber_weights(e, w, scale)
            best = windowed_search(sensor, y, weights, best.r_m, bounds, radius_in_depths)
            iterations += best.iterations
            e = all_residuals(sensor, y, w, weights, best)
            scale = robust_scale(e, w)
        rss, total = over_all(sensor, y, weights, best)
        limit = OUTLIER * scale
    chi2, n_outliers = sum_of_squares(e, limit)
    return Fit(
        best.r_m,
        best.tensor_m3,
        best.reduced,
        total - rss,
        chi2,
        scale,
        n_outliers,
        best.n_window,
        iterations,
        best.converged,
    )
