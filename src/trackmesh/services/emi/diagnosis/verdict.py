"""From the fits of a chunk to one verdict a scan: status, reasons, targets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.diagnosis.covariance import MIN_INFORMATION, covariance_matrix, fisher_matrix
from trackmesh.services.emi.diagnosis.detection import (
    chi2_p_value,
    detection_limit,
    detection_threshold,
    noise_variance,
)
from trackmesh.services.emi.diagnosis.geometry import Mirror
from trackmesh.services.emi.diagnosis.results import ScanResult, Status, Target
from trackmesh.services.emi.diagnosis.targets import image_of, targets_of
from trackmesh.services.emi.estimators import Fit
from trackmesh.services.emi.kernels import BoolArray, FloatArray, IntArray
from trackmesh.services.emi.scans import Scan
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Ground, inside

LEAST_NOISE = 1e-6
"""Of the largest number in the scan: estimated noise is not below it, since rounding would pass for signal."""
MISMATCH_P = 1e-6
"""p value of chi2 below which the targets do not explain the scan."""
POOR_DEPTH = 0.2
"""Standard deviation of the depth, by the depth, above which the answer is poor."""
LINEAR_DEPTH = 0.015
"""The same ratio above which the linearised covariance is too small: its 95 % ellipsoid misses the truth too often."""
EDGE_IN_DEPTHS = 0.5
"""How far outside the scan, in depths, a target is seen only from one side."""
EDGE_SD = 0.1
"""Horizontal standard deviation, in depths, with which a target is outside as soon as it is beyond the rim."""
DIPOLE_RADII = 10.0
"""Depth in coil radii within which a point dipole is a rough model of a loop."""
APART = 2.0
"""Standard deviations by which a mirror image must be away to be another place."""


class Setting(NamedTuple):
    """What all scans of a batch share.

    Attributes:
        grounds: where targets may be, one a side of the sensor.
        edge_lower_m, edge_upper_m: (2,) corners of the scanned area.
        width_m: of it.
        dipole_radius_m: radius of a transmitter that is taken as a point dipole; 0 for a loop.
        n_background: columns a component.
        lr_threshold: likelihood ratio that makes a target, for one channel.
        mirrors: planes that reflect the sensor into itself.
    """

    grounds: list[Ground]
    edge_lower_m: FloatArray
    edge_upper_m: FloatArray
    width_m: float
    dipole_radius_m: float
    n_background: int
    lr_threshold: float
    mirrors: list[Mirror]

    @property
    def surface_m(self) -> float:
        """Height from which depths are counted."""
        return self.grounds[0].bounds.surface_m

    @property
    def sigma_known(self) -> bool:
        """Whether scans come with their noise."""
        return self.grounds[0].sigma_known


class Fitted(NamedTuple):
    """A scan, its fit, the side of the sensor that it is on, and what is wrong with its places."""

    scan: Scan
    fit: Fit
    side: int
    defect: str | None


class _Stack(NamedTuple):
    """The numbers of the fits of a chunk that have as many targets, one row a scan."""

    dof: IntArray
    variance: FloatArray
    chi2: FloatArray
    p_value: FloatArray
    local: FloatArray
    p_local: FloatArray
    lr: FloatArray
    threshold: FloatArray
    determined: BoolArray
    inflation: FloatArray
    targets: list[list[Target]]


def degrees_of_freedom(scan: Scan, n_targets: int, n_background: int) -> int:
    """Numbers left after positions, tensors and background."""
    n_c, _, n_k = scan.y.shape
    return int(scan.n_numbers - n_c * (N_TENSOR * n_targets + n_k * n_background) - 3 * n_targets)


def verdicts(fitted: Sequence[Fitted], sensor: Sensor, setting: Setting) -> Iterator[ScanResult]:
    """One result for each fitted scan."""
    by_targets: defaultdict[int, list[Fitted]] = defaultdict(list)
    for one in fitted:
        by_targets[len(one.fit.r_m)].append(one)
    for alike in by_targets.values():
        stack = _stack(alike, setting)
        for i, one in enumerate(alike):
            yield _verdict(one, stack, i, sensor, setting)


def _stack(fitted: Sequence[Fitted], setting: Setting) -> _Stack:
    fits, n_t, n_c = [one.fit for one in fitted], len(fitted[0].fit.r_m), len(fitted[0].scan.y)
    numbers = np.array([one.scan.n_numbers for one in fitted])
    dof = np.array([degrees_of_freedom(one.scan, n_t, setting.n_background) - one.fit.n_outliers for one in fitted])
    chi2 = np.array([fit.chi2 for fit in fits])
    variance = np.ones(len(fits))
    if not setting.sigma_known:
        variance = noise_variance(chi2, np.array([fit.scale for fit in fits]), numbers, dof)
        quietest = [LEAST_NOISE * np.abs(one.scan.y * one.scan.w).max() for one in fitted]
        variance = np.maximum(variance, np.array(quietest) ** 2)
    chi2, local = chi2 / variance, np.array([fit.local for fit in fits]) / variance
    n_local = np.array([fit.n_local for fit in fits])
    p_value, p_local = chi2_p_value(chi2, dof), chi2_p_value(local * n_local, n_local)
    inflation = np.maximum(chi2 / np.maximum(dof, 1), 1.0) if setting.sigma_known else np.ones(len(fits))
    inflation = np.where(p_local < MISMATCH_P, np.maximum(inflation, local), inflation)
    scale = (variance * inflation)[:, None, None]
    fisher = fisher_matrix(np.stack([fit.reduced for fit in fits]))
    fisher[:, :3, :3] += scale * setting.grounds[0].prior.information
    covariance, least = covariance_matrix(fisher)
    covariance = covariance * scale
    covariance += np.stack([fit.excess if fit.excess.size else np.zeros(fisher.shape[1:]) for fit in fits])
    threshold = detection_threshold(n_c, dof, setting.sigma_known, setting.lr_threshold)
    lr = np.array([fit.explained for fit in fits]) / variance
    determined = (least >= MIN_INFORMATION) & (dof > 0)
    r, tensor = np.stack([fit.r_m for fit in fits]), np.stack([fit.tensor_m3 for fit in fits])
    targets = targets_of(r, setting.surface_m - r[:, :, 2], tensor, covariance)
    return _Stack(dof, variance, chi2, p_value, local, p_local, lr, threshold, determined, inflation, targets)


def _verdict(one: Fitted, stack: _Stack, i: int, sensor: Sensor, setting: Setting) -> ScanResult:
    scan, fit, bounds = one.scan, one.fit, setting.grounds[one.side].bounds
    variance, threshold = float(stack.variance[i]), float(stack.threshold[i])
    targets: list[Target] = []
    if stack.lr[i] > threshold and stack.determined[i]:
        targets = [target._replace(inflation=float(stack.inflation[i])) for target in stack.targets[i]]
    image = _image(targets, setting)
    status, reasons = _judge(one, targets, image, stack, i, setting)
    reasons += ["masked_samples"] * (scan.n_masked > 0) + ["outliers"] * (fit.n_outliers > 0)
    limit = None
    if status == "no_target":
        limit = detection_limit(sensor, scan.w, bounds, threshold, variance, setting.width_m)
    return ScanResult(
        scan.scan_index,
        status,
        tuple(reasons),
        tuple(image or targets),
        chi2=float(stack.chi2[i]),
        dof=max(int(stack.dof[i]), 0),
        p_value=float(stack.p_value[i]) if setting.sigma_known else None,
        local_chi2=float(stack.local[i]),
        likelihood_ratio=float(stack.lr[i]),
        bic=tuple(fit.bic[np.isfinite(fit.bic)].tolist()),
        sigma_t=_sigma(scan, variance),
        limit=limit,
        n_used=scan.n_used,
        n_masked=scan.n_masked,
        n_outliers=fit.n_outliers,
        iterations=fit.iterations,
    )


def _image(targets: list[Target], setting: Setting) -> list[Target]:
    """A single target and its mirror image, if the scan cannot tell which of them is there; else nothing."""
    if len(targets) != 1:
        return []
    (target,) = targets
    for mirror in setting.mirrors:
        image = image_of(target, mirror, setting.surface_m)._replace(inflation=target.inflation)
        apart = target.position_m - image.position_m
        sd = np.sqrt(max(float(mirror.normal @ target.covariance[:3, :3] @ mirror.normal), 0.0))
        allowed = any(inside(image.position_m, ground.bounds) for ground in setting.grounds)
        if allowed and np.linalg.norm(apart) > APART * sd:
            return [target._replace(ambiguous="mirror"), image]
    return []


def _judge(
    one: Fitted, targets: list[Target], image: list[Target], stack: _Stack, i: int, setting: Setting
) -> tuple[Status, list[str]]:
    """Status and reasons; what makes the positions most doubtful gives the status."""
    if not stack.lr[i] > stack.threshold[i]:
        return "no_target", ["likelihood_ratio_below_threshold"]
    if not stack.determined[i]:
        return "underdetermined", [one.defect or "information"]
    bounds = setting.grounds[one.side].bounds
    places = [(target, abs(target.depth_m), float(np.sqrt(target.covariance[2, 2]))) for target in targets]
    misfit = setting.sigma_known and bool(stack.p_value[i] < MISMATCH_P)
    found: list[tuple[bool, Status, str]] = [
        (one.defect is not None, "underdetermined", one.defect or ""),
        (bool(image), "underdetermined", "mirror"),
        (any(not inside(t.position_m, bounds) for t, _, _ in places), "edge", "at_search_bound"),
        (any(not _seen_around(target, setting) for target in targets), "edge", "outside_scan"),
        (any(sd > POOR_DEPTH * depth for _, depth, sd in places), "low_snr", "depth_uncertain"),
        (misfit, "multiple_or_mismatch", "misfit"),
        (bool(stack.p_local[i] < MISMATCH_P), "multiple_or_mismatch", "misfit_near_target"),
        (
            any(depth < DIPOLE_RADII * setting.dipole_radius_m for _, depth, _ in places),
            "ok",
            "dipole_transmitter_near",
        ),
        (any(sd > LINEAR_DEPTH * depth for _, depth, sd in places), "ok", "covariance_optimistic"),
        (one.fit.excess.size > 0, "ok", "estimator_inefficient"),
        (not one.fit.converged, "ok", "not_converged"),
    ]
    true = [(status, reason) for holds, status, reason in found if holds]
    return (true[0][0] if true else "ok"), [reason for _, reason in true]


def _seen_around(target: Target, setting: Setting) -> bool:
    depth, flat = abs(target.depth_m), target.position_m[:2]
    sd = float(np.sqrt(target.covariance[0, 0] + target.covariance[1, 1]))
    margin = EDGE_IN_DEPTHS * depth if sd <= EDGE_SD * depth else 0.0
    return bool(((flat > setting.edge_lower_m - margin) & (flat < setting.edge_upper_m + margin)).all())


def _sigma(scan: Scan, variance: float) -> float:
    weights = scan.w[scan.w > 0.0]
    return float(np.sqrt(variance * np.mean(weights**-2.0)))
