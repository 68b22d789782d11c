"""From a batch as it came to scans that can be fitted: what is missing, the level, the noise, where targets may be."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from trackmesh.services.emi.blocks import Blocks, averaged_field
from trackmesh.services.emi.diagnosis.detection import LR_THRESHOLD
from trackmesh.services.emi.estimators import EstimatorName
from trackmesh.services.emi.kernels import BoolArray, FloatArray
from trackmesh.services.emi.sensor import Background, Sensor
from trackmesh.services.emi.varpro import Bounds, Ground, Prior

ROUNDING = 1e-14
"""Part of a constant field that is left when the constant is taken off."""
QUIETEST = 1e-6
"""Noise of a channel, by its largest number, below which it is rounding."""
Side = Literal["below", "above", "unknown"]


class Options(NamedTuple):
    """How to invert.

    Attributes:
        estimator: by name.
        most_targets: sought, with the estimator varpro.
        background: what each component may hold beside the targets.
        robust: weigh outliers down.
        side: of the sensor on which targets lie.
        depth_min_m, depth_max_m: from the median height of the sensor; None is twice the scan's width.
        area_m: x, y, x, y of two corners within which targets lie; None is half a scan's width around it.
        prior_m: (2, 3) mean and standard deviation of the position of the first target; None for no prior.
        block_m: cells in which samples are averaged; None: only those of very large scans.
        lr_threshold: likelihood ratio that makes a target, for one channel.
    """

    estimator: EstimatorName = "varpro"
    most_targets: int = 1
    background: Background = "const"
    robust: bool = True
    side: Side = "below"
    depth_min_m: float = 0.05
    depth_max_m: float | None = None
    area_m: tuple[float, float, float, float] | None = None
    prior_m: FloatArray | None = None
    block_m: float | None = None
    lr_threshold: float = LR_THRESHOLD


class Scan(NamedTuple):
    """A scan ready to be fitted.

    Attributes:
        scan_index: in its batch.
        y: (C, W, K) field in T, 0 where masked.
        w: (C, W, K) one over its standard deviation, 0 where masked.
        n_masked: samples with something missing.
        n_used: samples of which something is there.
        n_numbers: numbers that are there.
    """

    scan_index: int
    y: FloatArray
    w: FloatArray
    n_masked: int
    n_used: int
    n_numbers: int


def readings_there(sensor: Sensor, field_t: FloatArray) -> BoolArray | None:
    """Which numbers (W, K) are usable: a receiver of a sample with all its components, in all channels; None: all."""
    finite = np.isfinite(field_t).all(0)
    if finite.all():
        return None
    whole = np.logical_and.reduceat(finite, sensor.first[:-1], axis=1)
    return np.asarray(np.repeat(whole, np.diff(sensor.first), axis=1))


def prepared(
    index: int,
    sensor: Sensor,
    field_t: FloatArray,
    sigma_t: FloatArray | float | None,
    centred: bool,
    blocks: Blocks | None = None,
) -> Scan:
    """A scan (C, W, K) of a batch.

    Args:
        index: in the batch.
        sensor: geometry, of the cells where samples are averaged.
        field_t: as it came.
        sigma_t: of its noise, broadcast against it; None where that is unknown.
        centred: its mean may be taken off, since the background takes any constant.
        blocks: cells in which its samples are averaged.
    """
    relative: FloatArray | float = 1.0
    if blocks is not None:
        field_t, relative = averaged_field(field_t, 1.0 if sigma_t is None else sigma_t, blocks)
        sigma_t = None if sigma_t is None else 1.0
    there = readings_there(sensor, field_t)
    y = field_t if there is None else np.where(there, field_t, 0.0)
    if centred:
        y = _centred(y, there)
    w = np.empty(field_t.shape)
    w[:] = 1.0 / (relative * (assumed_sigma(sensor, y) if sigma_t is None else sigma_t))
    if there is None:
        return Scan(index, np.array(y, np.float64, order="C"), w, 0, y.shape[1], y.size)
    w[:, ~there] = 0.0
    missing, used = int((~there.all(1)).sum()), int(there.any(1).sum())
    return Scan(index, np.ascontiguousarray(y), w, missing, used, int(there.sum()) * len(y))


def _centred(y: FloatArray, there: BoolArray | None) -> FloatArray:
    """The field (C, W, K) with its means taken off: a large constant must not cost digits."""
    level = max(float(y.max(initial=0.0)), -float(y.min(initial=0.0)))
    if there is None:
        y = y - y.mean(1, keepdims=True)
    else:
        y = np.where(there, y - y.sum(1, keepdims=True) / np.maximum(there.sum(0), 1), 0.0)
    left = max(float(y.max(initial=0.0)), -float(y.min(initial=0.0)))
    return y if left > ROUNDING * level else np.zeros_like(y)


def assumed_sigma(sensor: Sensor, y: FloatArray) -> FloatArray:
    """Standard deviations (C, 1, 1) of which the ratios matter: of one channel any, near to the data.

    Of several, what neighbours differ by (1.4826 times the median absolute difference from the mean of the nearest).
    """
    largest = np.abs(y).max((1, 2), initial=0.0)
    if len(y) == 1:
        return np.where(largest > 0.0, largest, 1.0)[:, None, None]
    rough = neighbour_noise(sensor, y)
    sigma = np.maximum(rough, QUIETEST * largest)
    return np.where(sigma > 0.0, sigma, 1.0)[:, None, None]


def neighbour_noise(sensor: Sensor, y: FloatArray) -> FloatArray:
    """Noise (C,) of each channel, as far as the field is smooth from sample to sample."""
    n_r = len(sensor.rx_radius_m)
    found = []
    for j in range(n_r):
        near = sensor.near[j::n_r] // n_r
        k = slice(sensor.first[j], sensor.first[j + 1])
        found.append((y[:, :, k] - y[:, near, k].mean(2)).reshape(len(y), -1))
    differences = np.abs(np.concatenate(found, axis=1))
    return np.asarray(1.4826 * np.median(differences, axis=1) / np.sqrt(1.0 + 1.0 / sensor.near.shape[1]))


def search_grounds(place_m: FloatArray, options: Options, sigma_known: bool) -> list[Ground]:
    """Where targets may be: half a scan's width around it and the depths of the options; one ground a side."""
    low, high = place_m.min(0), place_m.max(0)
    width = scan_width(place_m)
    surface = float(np.median(place_m[:, 2]))
    depth_max = 2.0 * width if options.depth_max_m is None else options.depth_max_m
    depths = (options.depth_min_m, max(depth_max, 1.001 * options.depth_min_m))
    flat = np.concatenate([low[:2] - 0.5 * width, high[:2] + 0.5 * width])
    if options.area_m is not None:
        x0, y0, x1, y1 = options.area_m
        flat = np.array([min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)])
    sides = {"below": (-1.0,), "above": (1.0,), "unknown": (-1.0, 1.0)}[options.side]
    boxes = [sorted(surface + side * depth for depth in depths) for side in sides]
    prior = search_prior(options.prior_m)
    return [
        Ground(Bounds(np.array([*flat[:2], z[0]]), np.array([*flat[2:], z[1]]), surface), prior, sigma_known)
        for z in boxes
    ]


def scan_width(place_m: FloatArray) -> float:
    """Diagonal of the scanned area."""
    return max(float(np.hypot(*np.ptp(place_m[:, :2], axis=0))), 1e-3)


def search_prior(prior_m: FloatArray | None) -> Prior:
    """The prior as the search takes it; no information where there is none."""
    if prior_m is None:
        return Prior(np.zeros(3), np.zeros((3, 3)))
    mean, sd = np.array(prior_m, np.float64)
    return Prior(mean.copy(), np.diag(sd**-2.0))
