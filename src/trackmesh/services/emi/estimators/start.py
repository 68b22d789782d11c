"""Where a search starts: the core of the amplitude map.

Horizontally the centroid of |B|^2 over the points above half of the largest |B|; the depth from the area of that
core, whose diameter is 0.941 depths for a compact target under a coincident dipole (and near to that for a loop).
A point is one receiver at one sample.
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from trackmesh.services.emi.kernels import BoolArray, FloatArray
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Bounds, Ground

FWHM_IN_DEPTHS = 0.941
SPIKE_SHARE = 0.03
MAX_SPIKES = 8
DEPTHS = (1.0, 0.5, 2.0)
"""Tried over the centroid, in depths by the core's area; the first one also over the peak."""
BESIDE = (0.5, 0.2)
"""Tried on both sides of a single line, in depths: on the line itself, all that points to a side may vanish."""
LINE = 1e-6


def by_point(sensor: Sensor, squares: FloatArray) -> FloatArray:
    """Sums (W R,) of (C, W, K) over channels and over the components of each receiver."""
    return np.asarray(np.add.reduceat(squares.sum(0), sensor.first[:-1], axis=1).ravel())


def power_map(sensor: Sensor, y: FloatArray, w: FloatArray) -> FloatArray:
    """Whitened |B|^2 (W R,), the median of each component taken off first; 0 where there is no sample."""
    there = w > 0.0
    level = _medians(y, there)
    return by_point(sensor, np.where(there, (w.max(1, keepdims=True) * (y - level)) ** 2, 0.0))


def _medians(y: FloatArray, there: BoolArray) -> FloatArray:
    """Medians (C, 1, K) over the samples; of an even number the upper one."""
    counts = there.sum(1)
    if (counts == y.shape[1]).all():
        return np.partition(y, y.shape[1] // 2, axis=1)[:, y.shape[1] // 2][:, None]
    ordered = np.sort(np.where(there, y, np.inf), axis=1)
    return np.take_along_axis(ordered, np.minimum(counts // 2, y.shape[1] - 1)[:, None], 1)


def spikes(sensor: Sensor, power: FloatArray) -> list[int]:
    """Points (a few at most) whose nearest ones are all far smaller, as in no dipole field."""
    power, found = power.copy(), []
    for _ in range(MAX_SPIKES):
        peak = int(np.argmax(power))
        near = power[sensor.near[peak][sensor.near[peak] != peak]]
        near = near[near > 0.0]
        if not len(near) or (near >= SPIKE_SHARE**2 * power[peak]).any():
            break
        found.append(peak)
        power[peak] = 0.0
    return found


def without(sensor: Sensor, w: FloatArray, points: list[int]) -> FloatArray:
    """Weights with the readings of some points set to zero."""
    if not points:
        return w
    w, n_r = w.copy(), len(sensor.rx_radius_m)
    for point in points:
        sample, j = divmod(point, n_r)
        w[:, sample, sensor.first[j] : sensor.first[j + 1]] = 0.0
    return w


def start_points(sensor: Sensor, power: FloatArray, ground: Ground) -> FloatArray:
    """Starts (4 to 9, 3): the prior's mean where there is one; core centroid, peak, centroid at other depths.

    Of a single line also to its sides.
    """
    flat, bounds = sensor.point_m[:, :2], ground.bounds
    core = power > 0.25 * power.max()
    middle = power[core] @ flat[core] / power[core].sum()
    sides = _sides_of_line(flat)
    # Across a line nothing is seen: the length of the core must do.
    area = int(core.sum()) * cell_area(flat) if not sides else pi / 4.0 * core_length(flat[core]) ** 2
    depth = 2.0 * sqrt(area / pi) / FWHM_IN_DEPTHS
    z = bounds.surface_m + towards(bounds) * depth * np.array(DEPTHS)
    starts = [[*middle, z[0]], [*flat[np.argmax(power)], z[0]], [*middle, z[1]], [*middle, z[2]]]
    starts += [[*(middle + share * depth * side), z[0]] for share in BESIDE for side in sides]
    if ground.prior.information.any():
        starts.insert(0, ground.prior.mean_m.tolist())
    return np.asarray(np.minimum(np.maximum(starts, bounds.lower_m), bounds.upper_m))


def _sides_of_line(flat_m: FloatArray) -> list[FloatArray]:
    """Unit vectors (2,) to both sides of the line on which all points (n, 2) lie; none if they do not."""
    centred = flat_m - flat_m.mean(0)
    spread = centred.T @ centred
    # The product of the eigenvalues against the square of their sum.
    if spread[0, 0] * spread[1, 1] - spread[0, 1] ** 2 > (LINE * (spread[0, 0] + spread[1, 1])) ** 2:
        return []
    _, axes = np.linalg.eigh(spread)
    return [axes[:, 0], -axes[:, 0]]


def core_length(flat_m: FloatArray) -> float:
    """Length that points (n, 2) on a line cover, each its share."""
    length = float(np.hypot(*(flat_m.max(0) - flat_m.min(0))))
    return length * len(flat_m) / max(len(flat_m) - 1, 1)


def towards(bounds: Bounds) -> float:
    """-1 where targets lie below the sensor, 1 where they lie above."""
    return -1.0 if bounds.upper_m[2] <= bounds.surface_m else 1.0


def cell_area(flat_m: FloatArray) -> float:
    """Area that one of the points (n, 2) stands for: the bounding box shared out, its rim allowed for."""
    dx, dy = (flat_m.max(0) - flat_m.min(0)).tolist()
    pitch = sqrt(dx * dy / len(flat_m))
    return float((dx + pitch) * (dy + pitch) / len(flat_m))
