"""The inversion of a batch of scans: arrays in, one result a scan out, in order.

Pure: no network, no clock. A scan's result depends on that scan alone, bit for bit; a bad one spoils no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from trackmesh.services.emi import diagnosis as dg
from trackmesh.services.emi.design import Sensor
from trackmesh.services.emi.fit import Data, Enough, Fit, fit_target
from trackmesh.services.emi.kernels import BoolArray, FloatArray
from trackmesh.services.emi.results import Scan, ScanResult, Setting, Status, degrees_of_freedom, verdicts
from trackmesh.services.emi.varpro import Bounds

CHUNK_SAMPLES = 10_000
"""Samples diagnosed together: many enough that small scans share the overhead, few enough to stream."""
WINDOW_IN_DEPTHS = 2.0
MAX_MASKED_SHARE = 0.5
GOOD_SIGMAS = 5.0
"""By how many standard deviations chi2 may exceed its mean in a fit that needs no other start (noise known)."""
GOOD_GAIN = 4.0
"""Likelihood ratio, in thresholds, that such a fit must have."""
ROUNDING = 1e-14
"""Part of a constant field that is left when the constant is taken off."""
HOPELESS_GAIN = 0.5
"""Likelihood ratio, in thresholds, below which a fit is not refined, since it will be no target."""
GOOD_SHARE = 0.1
"""Share of the field's power left over with which a fit needs no other start."""

Background = Literal["none", "const", "plane"]
N_BACKGROUND: dict[Background, int] = {"none": 0, "const": 1, "plane": 3}
XYZ = np.eye(3)
Z_ONLY = XYZ[2:]


class Coils(NamedTuple):
    """The sensor.

    Attributes:
        positions_m: (W, 3), z up.
        radius_m: of the transmitter.
        moment_am2: turns times current times area.
        is_loop: whether the transmitter is a loop of that radius, or taken as a point dipole.
        tx_axis: (3,) or (W, 3).
        tx_offset_m, rx_offset_m: (3,) from the position to the coil's centre and to the receiver.
        components: (K, 3) unit vectors of what is measured.
    """

    positions_m: FloatArray
    radius_m: float
    moment_am2: float
    is_loop: bool = True
    tx_axis: FloatArray = XYZ[2]
    tx_offset_m: FloatArray = np.zeros(3)
    rx_offset_m: FloatArray = np.zeros(3)
    components: FloatArray = XYZ


class Options(NamedTuple):
    """How to invert.

    Attributes:
        background: what each component may hold beside the target.
        robust: weigh outliers down.
        depth_min_m, depth_max_m: below the median height of the sensor; None is twice the scan's width.
        lr_threshold: likelihood ratio that makes a target, for one channel.
    """

    background: Background = "const"
    robust: bool = True
    depth_min_m: float = 0.05
    depth_max_m: float | None = None
    lr_threshold: float = dg.LR_THRESHOLD


def sensor_arrays(coils: Coils, background: Background) -> Sensor:
    """The geometry as the kernels take it: one row a sample, unit vectors, background columns of order one."""
    # C order throughout: each other memory layout would have the kernels compiled again.
    positions = np.array(coils.positions_m, np.float64, order="C")
    axes = np.array(np.broadcast_to(coils.tx_axis, positions.shape), np.float64, order="C")
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    tx, rx = positions + coils.tx_offset_m, positions + coils.rx_offset_m
    flat = positions[:, :2] - positions[:, :2].mean(0)
    basis = np.column_stack([np.ones(len(flat)), flat / max(float(np.abs(flat).max()), 1e-3)])
    return Sensor(
        tx,
        rx,
        axes,
        0.5 * (tx + rx),
        np.array(coils.components, np.float64, order="C"),
        np.ascontiguousarray(basis[:, : N_BACKGROUND[background]]),
        float(coils.radius_m) if coils.is_loop else 0.0,
        float(coils.moment_am2),
    )


def search_bounds(place_m: FloatArray, options: Options) -> Bounds:
    """The box of the search: half a scan's width around it, and the depths of the options."""
    low, high = place_m.min(0), place_m.max(0)
    width = max(float(np.hypot(*(high - low)[:2])), 1e-3)
    surface = float(np.median(place_m[:, 2]))
    depth_max = 2.0 * width if options.depth_max_m is None else options.depth_max_m
    depth_max = max(depth_max, 1.001 * options.depth_min_m)
    lower = np.array([low[0] - 0.5 * width, low[1] - 0.5 * width, surface - depth_max])
    upper = np.array([high[0] + 0.5 * width, high[1] + 0.5 * width, surface - options.depth_min_m])
    return Bounds(lower, upper, surface)


def invert(
    coils: Coils, field_t: FloatArray, sigma_t: FloatArray | float | None, options: Options
) -> Iterator[ScanResult]:
    """Invert a batch of scans over one geometry.

    Args:
        coils: geometry, finite throughout, at least one position.
        field_t: (B, C, W, K) secondary field in T; samples that are not finite are masked.
        sigma_t: standard deviation of the noise in T, broadcast against (C, W, K); None: estimated from the residuals.
        options: how.

    Yields:
        One result a scan, in order, as each chunk is done.
    """
    sensor = sensor_arrays(coils, options.background)
    setting = _setting(coils, sensor, sigma_t is not None, options)
    defect = dg.geometry_defect(sensor.place_m)
    chunk = max(1, CHUNK_SAMPLES // len(sensor.place_m))
    for first in range(0, len(field_t), chunk):
        indices = range(first, min(first + chunk, len(field_t)))
        # Absurd numbers overflow; what comes of it is found by looking at the results.
        with np.errstate(all="ignore"):
            scans = [_prepare(i, field_t[i], sigma_t, options.background != "none") for i in indices]
            results = _invert_chunk(scans, sensor, setting, defect, options.robust)
        yield from results


def _setting(coils: Coils, sensor: Sensor, sigma_known: bool, options: Options) -> Setting:
    place = sensor.place_m[:, :2]
    return Setting(
        search_bounds(sensor.place_m, options),
        place.min(0),
        place.max(0),
        0.0 if coils.is_loop else coils.radius_m,
        N_BACKGROUND[options.background],
        sigma_known,
        options.lr_threshold,
    )


def _invert_chunk(
    scans: list[Scan], sensor: Sensor, setting: Setting, defect: str | None, robust: bool
) -> list[ScanResult]:
    results = {scan.scan_index: _without_fit(scan, sensor, setting, defect) for scan in scans}
    fitted = [(s, _fit(s, sensor, setting, robust)) for s in scans if results[s.scan_index] is None]
    results |= {s.scan_index: _counted(s, "invalid", "overflow") for s, _ in fitted}
    sound = [(scan, fit) for scan, fit in fitted if _is_finite(fit)]
    if sound:
        results |= {result.scan_index: result for result in verdicts(sound, setting)}
    return [result for result in results.values() if result is not None]


def _prepare(index: int, field_t: FloatArray, sigma_t: FloatArray | float | None, centred: bool) -> Scan:
    sample_there: BoolArray = np.all(np.isfinite(field_t), axis=(0, 2))
    there = np.broadcast_to(sample_there[None, :, None], field_t.shape)
    y = np.where(there, field_t, 0.0)
    if centred and sample_there.any():
        # The background takes any constant; a large one must not cost digits.
        level = float(np.abs(y).max())
        y = np.where(there, y - y[:, sample_there].mean(1, keepdims=True), 0.0)
        if float(np.abs(y).max()) <= ROUNDING * level:
            y = np.zeros_like(y)
    if sigma_t is None:
        # Any scale will do; one near to the data keeps the numbers in range.
        sigma_t = float(np.abs(y).max(initial=0.0)) or 1.0
    w = np.where(there, 1.0 / np.broadcast_to(sigma_t, field_t.shape), 0.0)
    return Scan(index, np.ascontiguousarray(y), np.ascontiguousarray(w), int(len(sample_there) - sample_there.sum()))


def _without_fit(scan: Scan, sensor: Sensor, setting: Setting, defect: str | None) -> ScanResult | None:
    """The answer for a scan that cannot be fitted, or None."""
    if scan.n_masked > MAX_MASKED_SHARE * scan.y.shape[1]:
        return _counted(scan, "invalid", "not_finite")
    if scan.n_masked:
        defect = dg.geometry_defect(sensor.place_m[scan.w[0, :, 0] > 0.0])
    if defect is None and degrees_of_freedom(scan, setting.n_background) <= 0:
        defect = "too_few_samples"
    if defect is not None:
        return _counted(scan, "underdetermined", defect)
    return None if scan.y.any() else _counted(scan, "no_target", "zero_field")


def _counted(scan: Scan, status: Status, reason: str) -> ScanResult:
    n_used = scan.y.shape[1] - scan.n_masked
    return ScanResult(scan.scan_index, status, (reason,), n_used=n_used, n_masked=scan.n_masked)


def _is_finite(fit: Fit) -> bool:
    numbers = (fit.r_m, fit.tensor_m3, fit.reduced, fit.explained, fit.chi2, fit.scale)
    return all(bool(np.isfinite(x).all()) for x in numbers)


def _fit(scan: Scan, sensor: Sensor, setting: Setting, robust: bool) -> Fit:
    n = float((scan.w > 0.0).sum())
    good_rss = n + GOOD_SIGMAS * float(np.sqrt(2.0 * n)) if setting.sigma_known else 0.0
    good_gain = GOOD_GAIN * setting.lr_threshold if setting.sigma_known else 0.0
    enough = Enough(good_rss, GOOD_SHARE, good_gain, HOPELESS_GAIN * setting.lr_threshold)
    return fit_target(Data(sensor, scan.y, scan.w, setting.bounds, WINDOW_IN_DEPTHS), robust, enough)
