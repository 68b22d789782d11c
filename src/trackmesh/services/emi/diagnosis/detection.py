"""Whether there is a target, how well it explains the scan, and what could have been missed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.kernels import FloatArray, IntArray
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Bounds, evaluate

LR_THRESHOLD = 40.0
"""Likelihood ratio below which a scan of one channel holds no target.

Noise alone stays below 33 in 99 of 100 scans, below 40 in 999 of 1000.
"""
SMALL_DOF = 30
CONFIDENT = 1.645
"""Standard deviations above the threshold with which a target is seen in 95 of 100 scans."""
LIMIT_DEPTHS = (0.125, 0.25, 0.5, 1.0)
"""Depths for which a limit is told, in widths of the scan."""


class Limit(NamedTuple):
    """How strong a compact target in the middle of the scan could be and yet be missed.

    Attributes:
        depth_m: (n,).
        polarizability_m3: (n,) of a sphere there that is seen in 95 of 100 such scans.
    """

    depth_m: FloatArray
    polarizability_m3: FloatArray


def noise_variance(chi2: FloatArray, scale: FloatArray, numbers: IntArray, dof: IntArray) -> FloatArray:
    """Variance (b,) of the residuals in units of the assumed one, for scans whose noise is unknown.

    The robust scale, corrected for the parameters; the mean square where there are too few numbers for a median.
    """
    free = np.maximum(dof, 1)
    return np.asarray(np.where(dof < SMALL_DOF, chi2 / free, scale**2 * numbers / free))


def detection_threshold(
    n_channels: int, dof: IntArray, sigma_known: bool, threshold: float = LR_THRESHOLD
) -> FloatArray:
    """Likelihood ratio (b,) that noise alone exceeds as rarely as ``threshold`` with one channel and known noise.

    The ratio is about chi2 with 3 + 6 C degrees of freedom (F with estimated noise), raised by the search over the
    position; equal tails of these laws carry the threshold over.
    """
    tail = chdtrc(9.0, threshold)
    q = 3.0 + N_TENSOR * n_channels
    if sigma_known:
        return np.full(len(dof), chdtri(q, tail))
    return np.asarray(q * fdtri(q, np.maximum(dof, 1), 1.0 - tail))


def chi2_p_value(chi2: FloatArray, dof: FloatArray | IntArray) -> FloatArray:
    """Probability (b,) of a larger chi2."""
    return np.asarray(chdtrc(np.maximum(dof, 1), chi2))


def detection_limit(
    sensor: Sensor, w: FloatArray, bounds: Bounds, threshold: float, variance: float, width_m: float
) -> Limit:
    """The limit that a scan without a target sets, by the mean likelihood ratio of a sphere in the middle.

    Args:
        sensor, w: geometry, and (C, W, K) one over the assumed standard deviation.
        bounds: the depths searched.
        threshold: likelihood ratio that makes a target.
        variance: of the noise, in units of the assumed one.
        width_m: of the scan.
    """
    least, most = sorted(abs(bounds.surface_m - z) for z in (bounds.lower_m[2], bounds.upper_m[2]))
    depth = np.unique(np.clip(width_m * np.array(LIMIT_DEPTHS), least, most))
    down = 1.0 if bounds.upper_m[2] > bounds.surface_m else -1.0
    middle = 0.5 * (bounds.lower_m + bounds.upper_m)[:2]
    nothing, every, ball = np.zeros_like(w), np.arange(w.shape[1]), np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    power = np.empty(len(depth))
    for i, d in enumerate(depth):
        place = np.array([[*middle, bounds.surface_m + down * d]])
        reduced = evaluate(sensor, nothing, w, every, place, np.zeros((len(w), 1, N_TENSOR)))
        # The channel that sees it best.
        power[i] = (ball @ reduced[:, :N_TENSOR, :N_TENSOR] @ ball).max()
    seen = (np.sqrt(threshold) + CONFIDENT) * np.sqrt(variance)
    with np.errstate(divide="ignore"):
        return Limit(depth, seen / np.sqrt(power))
