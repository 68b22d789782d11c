"""Where a search starts: the core of the amplitude map.

Horizontally the centroid of |B|^2 over the samples above half of the largest |B|; the depth from the area of that
core, whose diameter is 0.941 depths for a compact target under a coincident dipole (and near to that for a loop).
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from trackmesh.services.emi.design import Sensor
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.varpro import Bounds

FWHM_IN_DEPTHS = 0.941
SPIKE_SHARE = 0.03
N_NEIGHBOURS = 4
MAX_SPIKES = 8


def power_map(y: FloatArray, w: FloatArray) -> FloatArray:
    """|B|^2 (W,) over components and channels, the median of each taken off first; 0 where there is no sample."""
    there = w[0, :, 0] > 0.0
    power = np.zeros(y.shape[1])
    level = np.median(y[:, there], axis=1, keepdims=True)
    power[there] = ((y[:, there] - level) ** 2).sum((0, 2))
    return power


def is_spike(sensor: Sensor, power: FloatArray, peak: int) -> bool:
    """Whether the nearest samples to ``peak`` are all far smaller, as no dipole field is."""
    others = np.flatnonzero(power > 0.0)
    others = others[others != peak]
    distance2 = ((sensor.place_m[others, :2] - sensor.place_m[peak, :2]) ** 2).sum(1)
    nearest = others[np.argsort(distance2, kind="stable")[:N_NEIGHBOURS]]
    return bool((power[nearest] < SPIKE_SHARE**2 * power[peak]).all())


def spikes_cut(sensor: Sensor, y: FloatArray, w: FloatArray) -> FloatArray:
    """Weights with the samples of lonely spikes set to zero (a few at most)."""
    power, weights = power_map(y, w), w
    for _ in range(MAX_SPIKES):
        peak = int(np.argmax(power))
        if not is_spike(sensor, power, peak):
            break
        weights = weights.copy()
        weights[:, peak, :] = 0.0
        power[peak] = 0.0
    return weights


def start_points(sensor: Sensor, y: FloatArray, w: FloatArray, bounds: Bounds) -> FloatArray:
    """Starts (4, 3): core centroid, place of the peak, and the centroid at half and at twice the depth."""
    power, flat = power_map(y, w), sensor.place_m[:, :2]
    core = power > 0.25 * power.max()
    middle = power[core] @ flat[core] / power[core].sum()
    depth = 2.0 * sqrt(int(core.sum()) * cell_area(flat) / pi) / FWHM_IN_DEPTHS
    starts = np.array(
        [
            [*middle, bounds.surface_m - depth],
            [*flat[np.argmax(power)], bounds.surface_m - depth],
            [*middle, bounds.surface_m - 0.5 * depth],
            [*middle, bounds.surface_m - 2.0 * depth],
        ]
    )
    return np.asarray(np.clip(starts, bounds.lower_m, bounds.upper_m))


def cell_area(flat_m: FloatArray) -> float:
    """Area that one of the samples at (W, 2) stands for: the bounding box shared out, its rim allowed for."""
    dx, dy = np.ptp(flat_m, axis=0)
    pitch = sqrt(dx * dy / len(flat_m))
    return float((dx + pitch) * (dy + pitch) / len(flat_m))
