"""One target fitted to one scan: windows, several starts, outliers.

The information is near the target: samples within two depths of it hold it all but a few per cent. So the search runs
on a window about the target (roughly at first, on a part of its samples), and all samples are asked for the noise and
the goodness of fit. Outliers are weighed down by Huber's weights (P. J. Huber, 1964).
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, Sensor, Y, background_levels, gram_matrices, residuals
from trackmesh.services.emi.kernels import FloatArray, IntArray
from trackmesh.services.emi.start import spikes_cut, start_points
from trackmesh.services.emi.varpro import Bounds, Local, evaluate, linear_part, norm, search

ROUGH_SAMPLES = 512
GOLDEN = 0.6180339887498949
ROUGH, FINE = 3e-3, 1e-6
"""Steps, in depths, at which a search ends."""
ROUGH_STALL, FINE_STALL = 1e-3, 1e-9
"""Gains, in noise variances, at which it ends."""
ROUGH_MOST, FINE_MOST = 12, 30
"""Iterations at most."""
MAX_PASSES = 4
STAYS = 0.1
"""A window stays where the target moves less than this, in depths."""
MIN_WINDOW = 64
MAX_WIDENINGS = 32
HUBER = 2.5
OUTLIER = 4.7
"""In standard deviations: one in 400 000 numbers of normal noise is larger."""
ROBUST_ROUNDS = 4
ROUNDING = 1e-9
"""Residuals below this part of the signal are rounding, not noise."""


class Data(NamedTuple):
    """One scan to be fitted.

    Attributes:
        sensor: geometry.
        y, w: (C, W, K) field in T, and one over its standard deviation (0: no sample).
        bounds: where the target may be.
        radius_in_depths: of the window.
    """

    sensor: Sensor
    y: FloatArray
    w: FloatArray
    bounds: Bounds
    radius_in_depths: float


class Enough(NamedTuple):
    """When a fit over all samples needs no other start, and when none is worth refining.

    Attributes:
        rss: residual sum of squares that is good,
        share: or its share of the sum without a target,
        gain: where it is lower than that sum by at least this.
        hopeless: gain, in noise variances, of a fit that is not worth refining.
    """

    rss: float
    share: float
    gain: float
    hopeless: float


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


def window(sensor: Sensor, centre: FloatArray, radius: float) -> IntArray:
    """Samples within ``radius`` (horizontally) of ``centre``; the radius grows until there are enough of them."""
    distance2 = ((sensor.place_m[:, :2] - centre[:2]) ** 2).sum(1)
    for _ in range(MAX_WIDENINGS):
        chosen = np.flatnonzero(distance2 <= radius**2)
        if len(chosen) >= min(len(distance2), MIN_WINDOW):
            return chosen
        radius *= 1.5
    return np.arange(len(distance2))


def thinned(chosen: IntArray, limit: int) -> IntArray:
    """About ``limit`` of the samples, taken evenly without falling into step with the lines of a grid."""
    if len(chosen) <= limit:
        return chosen
    return chosen[(np.arange(len(chosen)) * GOLDEN) % 1.0 < limit / len(chosen)]


def rough_search(data: Data, start: FloatArray) -> Local:
    """Search from ``start`` on some of the samples of a window, which follows the target until that stays."""
    sensor, y, w, bounds, radius_in_depths = data
    found = Local(start, np.zeros((len(y), N_TENSOR)), np.empty(0), 0, 0, False)
    for attempt in range(MAX_PASSES):
        r = found.r_m
        depth = bounds.surface_m - r[2]
        chosen = thinned(window(sensor, r, radius_in_depths * depth), ROUGH_SAMPLES)
        tensor = found.tensor_m3
        if attempt == 0:
            tensor = linear_part(evaluate(sensor, y, w, chosen, r, tensor))[0]
        done = found.iterations
        found = search(sensor, y, w, chosen, r, tensor, bounds, ROUGH, ROUGH_STALL, ROUGH_MOST)
        found = found._replace(iterations=done + found.iterations)
        if norm(found.r_m - r) < STAYS * depth:
            break
    return found


def fine_search(data: Data, rough: Local) -> Local:
    """Search on all samples of the window about where a search ended."""
    sensor, y, w, bounds, radius_in_depths = data
    chosen = window(sensor, rough.r_m, radius_in_depths * (bounds.surface_m - rough.r_m[2]))
    found = search(sensor, y, w, chosen, rough.r_m, rough.tensor_m3, bounds, FINE, FINE_STALL, FINE_MOST)
    return found._replace(iterations=rough.iterations + found.iterations)


def over_all(data: Data, found: Local) -> tuple[float, float]:
    """Residual sum of squares over all samples (linear part solved over all), and the same without a target."""
    every = np.arange(data.y.shape[1])
    reduced = evaluate(data.sensor, data.y, data.w, every, found.r_m, found.tensor_m3)
    return linear_part(reduced)[2], float(reduced[:, Y, Y].sum())


def all_residuals(data: Data, w: FloatArray, found: Local) -> FloatArray:
    """Residuals (C, W, K) whitened by ``w``; the background is fitted with the weights of ``data``."""
    sensor, y, weights = data.sensor, data.y, data.w
    gram = gram_matrices(sensor, y, weights, np.arange(y.shape[1]), found.r_m, found.tensor_m3)
    levels = background_levels(gram, sensor.basis.shape[1], found.tensor_m3)
    return residuals(sensor, y, w, found.r_m, found.tensor_m3, levels)


def robust_scale(e: FloatArray, w: FloatArray) -> float:
    """Standard deviation of the residuals by their median absolute value, over what has a weight."""
    return float(1.4826 * np.median(np.abs(e[w > 0.0])))


def huber_weights(e: FloatArray, w: FloatArray, scale: float) -> FloatArray:
    """Weights for the next round: ``w`` times sqrt(min(1, k s / |e|))."""
    limit = HUBER * scale
    return np.asarray(w * np.sqrt(limit / np.maximum(np.abs(e), limit)))


def best_of_starts(data: Data, enough: Enough) -> tuple[Local, float]:
    """The best search, and by how much it lowers the residual sum of squares of all samples."""
    starts = start_points(data.sensor, data.y, data.w, data.bounds)
    rough = rough_search(data, starts[0])
    rss, total = over_all(data, rough)
    iterations = rough.iterations
    for start in starts[1:]:
        if (rss <= enough.rss or rss <= enough.share * total) and total - rss >= enough.gain:
            break
        other = rough_search(data, start)
        rss_other, _ = over_all(data, other)
        iterations += other.iterations
        if rss_other < rss:
            rough, rss = other, rss_other
    rough = rough._replace(iterations=iterations)
    if (total - rss) * float((data.w > 0.0).sum()) < enough.hopeless * rss:
        return rough._replace(converged=False), total - rss
    best = fine_search(data, rough)
    rss, total = over_all(data, best)
    return best, total - rss


def fit_target(data: Data, robust: bool, enough: Enough) -> Fit:
    """The best single target of one scan.

    Args:
        data: one scan.
        robust: find spikes before the search, and weigh outliers down (Huber) after it.
        enough: when to stop trying.
    """
    w = data.w
    if robust:
        data = data._replace(w=spikes_cut(data.sensor, data.y, w))
    best, explained = best_of_starts(data, enough)
    e = all_residuals(data, w, best)
    scale, limit = robust_scale(e, w), np.inf
    if robust and float(np.abs(e).max()) > OUTLIER * scale > ROUNDING * sqrt(max(explained, 0.0)):
        for _ in range(ROBUST_ROUNDS):
            data = data._replace(w=huber_weights(e, w, scale))
            best = fine_search(data, best)
            e = all_residuals(data, w, best)
            scale = robust_scale(e, w)
        rss, total = over_all(data, best)
        explained, limit = total - rss, OUTLIER * scale
    kept = np.abs(e) <= limit
    return Fit(
        best.r_m,
        best.tensor_m3,
        best.reduced,
        explained,
        float((e[kept] ** 2).sum()),
        scale,
        int((~kept).sum()),
        best.n_window,
        best.iterations,
        best.converged,
    )
