"""What a fit leaves over, and which of it are outliers."""

from __future__ import annotations

from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import model_field
from trackmesh.services.emi.kernels import BoolArray, FloatArray
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Local, levels_and_gain

HUBER = 2.5
OUTLIER = 4.7
"""In standard deviations: one in 400 000 numbers of normal noise is larger."""
COMPANY = 0.5
"""Residuals of neighbours above this part of an outlier's limit, with its sign, keep it company."""
ROUNDING = 1e-9
"""Residuals below this part of the signal are rounding, not noise."""


class Residuals(NamedTuple):
    """The residuals of a fit over all samples.

    Attributes:
        e: (C, W, K) whitened; 0 where there is no sample.
        signal: (C, W, K) what the targets send back, likewise.
        explained: by how much the targets lower the residual sum of squares.
        scale: robust standard deviation of e.
        limit: beyond this a number is an outlier; infinite where none is to be left out.
    """

    e: FloatArray
    signal: FloatArray
    explained: float
    scale: float
    limit: float


def residuals(
    sensor: Sensor, y: FloatArray, w: FloatArray, weights: FloatArray, found: Local, robust: bool
) -> Residuals:
    """Residuals whitened by ``w``; the background is fitted with ``weights``."""
    levels, explained = levels_and_gain(sensor, y, weights, found.r_m, found.tensor_m3)
    signal, beneath = model_field(sensor, found.r_m, found.tensor_m3, levels)
    e, signal = w * (y - signal - beneath), w * signal
    size = np.abs(e)
    scale, largest = robust_scale(size, w), float(size.max())
    sought = robust and largest > OUTLIER * scale and largest > ROUNDING * sqrt(max(explained, 0.0))
    return Residuals(e, signal, explained, scale, OUTLIER * scale if sought else inf)


def robust_scale(size: FloatArray, w: FloatArray) -> float:
    """Standard deviation of residuals by the median of their absolute values, over what has a weight."""
    there = size[w > 0.0]
    half = len(there) // 2
    return 1.4826 * float(np.partition(there, half)[half]) if len(there) else 0.0


def huber_weights(rest: Residuals, w: FloatArray) -> FloatArray:
    """Weights for the next round: ``w`` times sqrt(min(1, k s / |e|))."""
    limit = HUBER * rest.scale
    return np.asarray(w * np.sqrt(limit / np.maximum(np.abs(rest.e), limit)))


def lonely_outliers(sensor: Sensor, rest: Residuals) -> BoolArray:
    """Outliers (C, W, K), left out or not, none of whose neighbours is off to the same side."""
    beyond = np.abs(rest.e) > OUTLIER * rest.scale
    if not beyond.any():
        return beyond
    lonely = beyond.copy()
    n_r = len(sensor.rx_radius_m)
    for c, i, k in np.argwhere(beyond):
        j = int(np.searchsorted(sensor.first, k, side="right")) - 1
        lonely[c, i, k] = not has_company(sensor, rest, c, i * n_r + j, k)
    return lonely


def has_company(sensor: Sensor, rest: Residuals, c: int, point: int, k: int) -> bool:
    """Whether a neighbour of ``point`` is off to the same side in the same component."""
    n_r = len(sensor.rx_radius_m)
    near = sensor.near[point][sensor.near[point] != point]
    theirs_k = sensor.first[near % n_r] + k - sensor.first[point % n_r]
    same = theirs_k < sensor.first[near % n_r + 1]
    theirs = rest.e[c, near[same] // n_r, theirs_k[same]]
    own = rest.e[c, point // n_r, k]
    return bool(((theirs * own > 0.0) & (np.abs(theirs) > COMPANY * OUTLIER * rest.scale)).any())


def is_structured(sensor: Sensor, rest: Residuals) -> bool:
    """Whether most outliers have company: then it is the model that is wrong, and not the readings."""
    beyond = int((np.abs(rest.e) > OUTLIER * rest.scale).sum())
    return beyond > 2 * int(lonely_outliers(sensor, rest).sum())


def local_misfit(rest: Residuals, kept: BoolArray) -> tuple[float, float]:
    """Mean square of the residuals weighed by the squared signal, and over how many numbers that is a mean."""
    square = np.where(kept, rest.signal**2, 0.0)
    total, fourth = float(square.sum()), float((square * square).sum())
    if not fourth > 0.0:
        return 0.0, 1.0
    return float((rest.e**2 * square).sum()) / total, total * total / fourth
