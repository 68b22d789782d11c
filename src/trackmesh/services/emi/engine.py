"""The inversion of a batch of scans: arrays in, one result a scan out, in order.

Pure: no network, no clock. A scan's result depends on that scan alone, bit for bit; a bad one spoils no other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.blocks import Blocks, averaged_coils, blocks_of
from trackmesh.services.emi.diagnosis.geometry import absurdity, coil_places, geometry_defect, mirrors
from trackmesh.services.emi.diagnosis.results import ScanResult, Status
from trackmesh.services.emi.diagnosis.verdict import Fitted, Setting, degrees_of_freedom, verdicts
from trackmesh.services.emi.estimators import ESTIMATORS, Enough, Fit, Task
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.scans import Options, Scan, prepared, scan_width, search_grounds
from trackmesh.services.emi.sensor import N_BACKGROUND, Coils, Sensor, sensor_arrays

CHUNK_SAMPLES = 10_000
"""Samples diagnosed together: many enough that small scans share the overhead, few enough to stream."""
MAX_MASKED_SHARE = 0.5
GOOD_SIGMAS = 5.0
"""By how many standard deviations chi2 may exceed its mean in a fit that needs no other start (noise known)."""
GOOD_GAIN = 4.0
"""Likelihood ratio, in thresholds, that such a fit must have."""
HOPELESS_GAIN = 0.5
"""Likelihood ratio, in thresholds, below which a fit is not refined, since it will be no target."""
GOOD_SHARE = 0.1
"""Share of the field's power left over with which a fit needs no other start (noise unknown)."""
KNOW_BACKGROUND = ("varpro", "ekf9")
FATAL = ("too_few_places", "too_few_samples")


class Survey(NamedTuple):
    """A geometry and options, made ready for any number of scans.

    Attributes:
        sensor, setting: for fits and verdicts.
        options: as given.
        absurd: why no scan over it is valid, or None.
        defect: why no scan over it determines a target (``collinear``: hardly), or None.
        blocks: cells in which samples are averaged, or None.
    """

    sensor: Sensor
    setting: Setting
    options: Options
    absurd: str | None
    defect: str | None
    blocks: Blocks | None


def survey(coils: Coils, options: Options, sigma_known: bool) -> Survey:
    """Make a geometry ready.

    Args:
        coils: at least one position.
        options: how to invert.
        sigma_known: whether scans come with their noise.
    """
    blocks = blocks_of(coils.positions_m, options.block_m) if np.isfinite(coils.positions_m).all() else None
    if blocks is not None:
        coils = averaged_coils(coils, blocks)
    sensor = sensor_arrays(coils, options.background)
    absurd = absurdity(sensor)
    place = sensor.place_m
    setting = Setting(
        search_grounds(place, options, sigma_known),
        place[:, :2].min(0),
        place[:, :2].max(0),
        scan_width(place),
        0.0 if coils.is_loop else coils.radius_m,
        N_BACKGROUND[options.background],
        options.lr_threshold,
        [] if absurd else mirrors(sensor),
    )
    defect = None if absurd else geometry_defect(coil_places(sensor))
    return Survey(sensor, setting, options, absurd, defect, blocks)


def invert(
    coils: Coils, field_t: FloatArray, sigma_t: FloatArray | float | None, options: Options
) -> Iterator[ScanResult]:
    """Invert a batch of scans over one geometry.

    Args:
        coils: geometry, at least one position.
        field_t: (B, C, W, K) secondary field in T; samples that are not finite are masked.
        sigma_t: standard deviation of the noise in T, broadcast against (C, W, K); None: estimated from the residuals.
        options: how.

    Yields:
        One result a scan, in order, as each chunk is done.
    """
    yield from invert_over(survey(coils, options, sigma_t is not None), field_t, sigma_t)


def invert_over(ready: Survey, field_t: FloatArray, sigma_t: FloatArray | float | None) -> Iterator[ScanResult]:
    """As ``invert``, over a geometry that is ready.

    Raises:
        ValueError: the noise is given where the geometry was made ready for scans without, or the other way round.
    """
    if (sigma_t is not None) != ready.setting.sigma_known:
        raise ValueError("The survey was made ready for scans of the other kind: with noise, or without.")
    chunk = chunk_length(field_t.shape[2])
    for first in range(0, len(field_t), chunk):
        indices = range(first, min(first + chunk, len(field_t)))
        # Absurd numbers overflow; what comes of it is found by looking at the results.
        with np.errstate(all="ignore"):
            centred = ready.options.background != "none" and ready.options.estimator in KNOW_BACKGROUND
            scans = [prepared(i, ready.sensor, field_t[i], sigma_t, centred, ready.blocks) for i in indices]
            results = _invert_chunk(scans, ready)
        yield from results


def chunk_length(n_samples: int) -> int:
    """How many scans of so many samples are diagnosed together."""
    return max(1, CHUNK_SAMPLES // max(n_samples, 1))


def _invert_chunk(scans: list[Scan], ready: Survey) -> list[ScanResult]:
    results = {scan.scan_index: _without_fit(scan, ready) for scan in scans}
    fitted = [_fitted(scan, ready) for scan in scans if results[scan.scan_index] is None]
    results |= {one.scan.scan_index: _counted(one.scan, "invalid", "overflow") for one in fitted}
    sound = [one for one in fitted if _is_finite(one.fit)]
    results |= {result.scan_index: result for result in verdicts(sound, ready.sensor, ready.setting)}
    return [result for result in results.values() if result is not None]


def _without_fit(scan: Scan, ready: Survey) -> ScanResult | None:
    """The answer for a scan that cannot be fitted, or None."""
    if ready.absurd:
        return _counted(scan, "invalid", ready.absurd)
    if scan.w.size - scan.n_numbers > MAX_MASKED_SHARE * scan.w.size:
        return _counted(scan, "invalid", "not_finite")
    defect = _defect(scan, ready)
    if defect != "too_few_places" and degrees_of_freedom(scan, 1, ready.setting.n_background) <= 0:
        defect = "too_few_samples"
    if defect in FATAL:
        return _counted(scan, "underdetermined", defect)
    return None if scan.y.any() else _counted(scan, "no_target", "zero_field")


def _defect(scan: Scan, ready: Survey) -> str | None:
    """What is wrong with the places of which the scan has something."""
    if not scan.n_masked:
        return ready.defect
    return geometry_defect(coil_places(ready.sensor, np.asarray((scan.w > 0.0).any((0, 2)))))


def _counted(scan: Scan, status: Status, reason: str) -> ScanResult:
    return ScanResult(scan.scan_index, status, (reason,), n_used=scan.n_used, n_masked=scan.n_masked)


def _is_finite(fit: Fit) -> bool:
    numbers = (fit.r_m, fit.tensor_m3, fit.reduced, fit.explained, fit.chi2, fit.scale)
    return all(bool(np.isfinite(x).all()) for x in numbers)


def _fitted(scan: Scan, ready: Survey) -> Fitted:
    """The best fit of either side."""
    options = ready.options
    fits = []
    for ground in ready.setting.grounds:
        enough = _enough(scan, ground.sigma_known, ready)
        task = Task(ready.sensor, scan.y, scan.w, ground, enough, options.robust, options.most_targets)
        fits.append(ESTIMATORS[options.estimator](task))
    side = max(range(len(fits)), key=lambda i: fits[i].explained)
    return Fitted(scan, fits[side], side, _defect(scan, ready))


def _enough(scan: Scan, sigma_known: bool, ready: Survey) -> Enough:
    threshold, hopeless = ready.options.lr_threshold, HOPELESS_GAIN * ready.options.lr_threshold
    if sigma_known:
        n = float(scan.n_numbers)
        return Enough(n + GOOD_SIGMAS * float(np.sqrt(2.0 * n)), 0.0, GOOD_GAIN * threshold, hopeless)
    # Of a single line a place on it explains most, wherever the target is.
    return Enough(0.0, 0.0 if ready.defect else GOOD_SHARE, 0.0, hopeless)
