"""Where a search starts: the core of the amplitude map.

Horizontally the centroid of |B|^2 over the samples above half of the largest |B|; the depth from the area of that
core, whose diameter is 0.941 depths for a compact target under a coincident dipole (and near to that for a loop).
"""

from __future__ import annotations

from math import pi, sqrt

import numpy as np

from trackmesh.services.emi.design import Sensor
from trackmesh.services.emi.kernels import FloatArray, kernel

FWHM_IN_DEPTHS = 0.941
SPIKE_SHARE = 0.03
N_NEIGHBOURS = 4
MAX_SPIKES = 8


@kernel
def power_map(y: FloatArray, w: FloatArray) -> FloatArray:
    """|B|^2 (W,) over components and channels, the median of each taken off first; 0 where there is no sample."""
    n_c, n_w, n_k = y.shape
    power = np.zeros(n_w)
    for c in range(n_c):
        for k in range(n_k):
            there = w[c, :, k] > 0.0
            level = np.median(y[c, :, k][there]) if np.any(there) else 0.0
            for i in range(n_w):
                if there[i]:
                    power[i] += (y[c, i, k] - level) ** 2
    return power


@kernel
def is_spike(sensor: Sensor, power: FloatArray, peak: int) -> bool:
    """Whether the nearest samples to ``peak`` are all far smaller, as no dipole field is."""
    n = power.shape[0]
    distance = np.empty(n)
    for i in range(n):
        dx = sensor.place_m[i, 0] - sensor.place_m[peak, 0]
        dy = sensor.place_m[i, 1] - sensor.place_m[peak, 1]
        distance[i] = dx * dx + dy * dy if power[i] > 0.0 else np.inf
    distance[peak] = np.inf
    for _ in range(min(N_NEIGHBOURS, n - 1)):
        near = int(np.argmin(distance))
        if power[near] > SPIKE_SHARE**2 * power[peak]:
            return False
        distance[near] = np.inf
    return True


@kernel
def spikes_cut(sensor: Sensor, y: FloatArray, w: FloatArray) -> FloatArray:
    """Weights with the samples of lonely spikes set to zero (a few at most)."""
    weights = w
    power = power_map(y, w)
    for _ in range(MAX_SPIKES):
        peak = int(np.argmax(power))
        if not is_spike(sensor, power, peak):
            break
        if weights is w:
            weights = w.copy()
        weights[:, peak, :] = 0.0
        power[peak] = 0.0
    return weights


@kernel
def start_points(
    sensor: Sensor, y: FloatArray, w: FloatArray, lower: FloatArray, upper: FloatArray, surface_m: float
) -> FloatArray:
    """Starts (4, 3): core centroid, place of the peak, and the centroid at half and at twice the depth."""
    power = power_map(y, w)
    place = sensor.place_m
    peak = int(np.argmax(power))
    total, x, z, core = 0.0, 0.0, 0.0, 0
    for i in range(power.shape[0]):
        if power[i] > 0.25 * power[peak]:
            total += power[i]
            x += power[i] * place[i, 0]
            z += power[i] * place[i, 1]
            core += 1
    depth = 2.0 * sqrt(core * cell_area(place) / pi) / FWHM_IN_DEPTHS
    starts = np.empty((4, 3))
    for s, (px, py, factor) in enumerate(
        (
            (x / total, z / total, 1.0),
            (place[peak, 0], place[peak, 1], 1.0),
            (x / total, z / total, 0.5),
            (x / total, z / total, 2.0),
        )
    ):
        starts[s, 0], starts[s, 1], starts[s, 2] = px, py, surface_m - factor * depth
        for j in range(3):
            starts[s, j] = min(max(starts[s, j], lower[j]), upper[j])
    return starts


@kernel
def cell_area(place: FloatArray) -> float:
    """Area that one sample stands for: the bounding box shared out, its rim allowed for."""
    n = place.shape[0]
    dx = place[:, 0].max() - place[:, 0].min()
    dy = place[:, 1].max() - place[:, 1].min()
    pitch = sqrt(dx * dy / n)
    return float((dx + pitch) * (dy + pitch) / n)
