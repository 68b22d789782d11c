"""The samples that a search looks at: those near the targets, roughly some of them, at last all."""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.kernels import FloatArray, IntArray, kernel
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import (
    Bounds,
    Ground,
    Local,
    Stop,
    depth_of,
    evaluate,
    linear_part,
    moved_little,
    prior_misfit,
    prior_weight,
    search,
)

RADIUS_IN_DEPTHS = 2.0
MIN_WINDOW = 64
MAX_WIDENINGS = 32
ROUGH_SAMPLES = 512
GOLDEN = 0.6180339887498949
ROUGH = Stop(3e-3, 1e-3, 12)
FINE = Stop(1e-6, 1e-6, 30)
MAX_PASSES = 4
STAYS = 0.1
"""A window stays where the targets move less than this, in depths."""


@kernel
def window(sensor: Sensor, r: FloatArray, bounds: Bounds, most: int) -> IntArray:
    """Samples within two depths (horizontally) of a target; the radius grows until there are enough of them.

    Of more than ``most`` about so many, taken evenly without falling into step with the lines of a grid.
    """
    n_w = len(sensor.place_m)
    radius, found = RADIUS_IN_DEPTHS, 0
    inside = np.empty(n_w, np.int64)
    for attempt in range(MAX_WIDENINGS):
        found = 0
        for i in range(n_w):
            if attempt == MAX_WIDENINGS - 1 or _near_any(sensor, i, r, bounds, radius):
                inside[found] = i
                found += 1
        if found >= min(n_w, MIN_WINDOW):
            break
        radius *= 1.5
    if found <= most:
        return inside[:found]
    kept = 0
    for i in range(found):
        if (i * GOLDEN) % 1.0 < most / found:
            inside[kept] = inside[i]
            kept += 1
    return inside[:kept]


@kernel
def _near_any(sensor: Sensor, i: int, r: FloatArray, bounds: Bounds, radius: float) -> bool:
    for t in range(r.shape[0]):
        dx, dy = sensor.place_m[i, 0] - r[t, 0], sensor.place_m[i, 1] - r[t, 1]
        if dx * dx + dy * dy <= (radius * depth_of(r[t], bounds)) ** 2:
            return True
    return False


@kernel
def rough_search(sensor: Sensor, y: FloatArray, w: FloatArray, ground: Ground, start: FloatArray) -> Local:
    """Search from ``start`` (T, 3) on some samples of a window, which follows the targets until they stay."""
    n_c, n_t, n_w = y.shape[0], start.shape[0], len(sensor.place_m)
    chosen = window(sensor, start, ground.bounds, ROUGH_SAMPLES)
    r, iterations = start, 0
    tensor, _, _ = linear_part(evaluate(sensor, y, w, chosen, r, np.zeros((n_c, n_t, N_TENSOR))))
    found = Local(r, tensor, np.empty((0, 0, 0)), 0, 0, False)
    for attempt in range(MAX_PASSES):
        if attempt > 0:
            chosen = window(sensor, r, ground.bounds, ROUGH_SAMPLES)
        found = search(sensor, y, w, chosen, r, found.tensor_m3, ground, ROUGH)
        iterations += found.iterations
        stays = moved_little(r, found.r_m, ground.bounds, STAYS)
        r = found.r_m
        if stays or len(chosen) == n_w:
            break
    return Local(r, found.tensor_m3, found.reduced, found.n_window, iterations, found.converged)


@kernel
def fine_search(sensor: Sensor, y: FloatArray, w: FloatArray, ground: Ground, rough: Local) -> Local:
    """Search on all samples of the window about where a search ended."""
    chosen = window(sensor, rough.r_m, ground.bounds, len(sensor.place_m))
    found = search(sensor, y, w, chosen, rough.r_m, rough.tensor_m3, ground, FINE)
    iterations = rough.iterations + found.iterations
    return Local(found.r_m, found.tensor_m3, found.reduced, found.n_window, iterations, found.converged)


@kernel
def over_all(sensor: Sensor, y: FloatArray, w: FloatArray, ground: Ground, found: Local) -> tuple[float, float]:
    """Cost over all samples (tensors solved over all; the prior's share in it), and the same without a target."""
    n_c, n_w, n_k = y.shape
    reduced = found.reduced
    if found.n_window < n_w:
        reduced = evaluate(sensor, y, w, np.arange(n_w), found.r_m, found.tensor_m3)
    _, _, rss = linear_part(reduced)
    total, last = 0.0, reduced.shape[1] - 1
    for c in range(n_c):
        total += reduced[c, last, last]
    return rss + prior_weight(rss, n_c * n_w * n_k, ground) * prior_misfit(found.r_m, ground.prior), total
