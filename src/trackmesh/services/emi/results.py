"""From the fits of a chunk to one verdict a scan: status, reasons, target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np

from trackmesh.services.emi import diagnosis as dg
from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.fit import Fit
from trackmesh.services.emi.kernels import BoolArray, FloatArray, IntArray
from trackmesh.services.emi.varpro import Bounds

LEAST_NOISE = 1e-6
"""Of the largest number in the scan: estimated noise is not below it, since rounding would pass for signal."""
MISMATCH_P = 1e-6
"""p value of chi2 below which one dipole does not explain the scan."""
POOR_DEPTH = 0.2
"""Standard deviation of the depth, by the depth, above which the answer is poor."""
LINEAR_DEPTH = 0.015
"""The same ratio above which the linearised covariance is too small: its 95 % ellipsoid misses the truth too often."""
EDGE_IN_DEPTHS = 0.5
"""How far outside the scan, in depths, a target is seen only from one side."""
DIPOLE_RADII = 6.0
"""Depth in coil radii within which a point dipole is a rough model of a loop."""

Status = Literal["ok", "no_target", "low_snr", "multiple_or_mismatch", "underdetermined", "edge", "invalid"]


class Target(NamedTuple):
    """One target.

    Attributes:
        position_m: (3,).
        depth_m: below the median height of the sensor.
        covariance: (3 + 6 C, 3 + 6 C) of x, y, z and the tensor's elements xx, yy, zz, xy, xz, yz of each channel.
        tensor_m3: (C, 6).
        principal_m3, principal_sd_m3: (3,) of the strongest channel, see ``diagnosis.Principal``.
        shape: which of the three values are equal as far as the noise lets one see.
        axis: (3,) of the isolated principal value; None for an isotropic tensor.
        axis_sd_rad: of its direction.
    """

    position_m: FloatArray
    depth_m: float
    covariance: FloatArray
    tensor_m3: FloatArray
    principal_m3: FloatArray
    principal_sd_m3: FloatArray
    shape: dg.Shape
    axis: FloatArray | None
    axis_sd_rad: float | None


class ScanResult(NamedTuple):
    """The answer for one scan; numbers that do not exist are None.

    Attributes:
        scan_index: of the scan in its batch.
        status: the verdict.
        reasons: short machine-readable words that qualify it.
        target: there unless the status is no_target, underdetermined or invalid.
        chi2, dof, p_value: goodness of fit over all samples, outliers left out; no p value with estimated noise.
        likelihood_ratio: by how much the target lowers the residual sum of squares, in units of the noise variance.
        sigma_t: standard deviation of the noise in T: as given (root mean square), or estimated.
        n_used, n_masked: samples.
        n_outliers: numbers weighed down.
        iterations: of the search.
    """

    scan_index: int
    status: Status
    reasons: tuple[str, ...]
    target: Target | None = None
    chi2: float | None = None
    dof: int | None = None
    p_value: float | None = None
    likelihood_ratio: float | None = None
    sigma_t: float | None = None
    n_used: int = 0
    n_masked: int = 0
    n_outliers: int = 0
    iterations: int = 0


class Scan(NamedTuple):
    """A scan ready to be fitted: field (C, W, K) in T, 0 where masked; one over its sigma, 0 where masked."""

    scan_index: int
    y: FloatArray
    w: FloatArray
    n_masked: int


class Setting(NamedTuple):
    """What all scans of a batch share: the box of the search and what is known of coil and noise."""

    bounds: Bounds
    edge_lower_m: FloatArray
    edge_upper_m: FloatArray
    dipole_radius_m: float
    n_background: int
    sigma_known: bool
    lr_threshold: float


class _Stack(NamedTuple):
    """The numbers of a chunk, one row a scan."""

    dof: IntArray
    variance: FloatArray
    chi2: FloatArray
    p_value: FloatArray
    lr: FloatArray
    detected: BoolArray
    determined: BoolArray
    covariance: FloatArray
    principal: dg.Principal


def degrees_of_freedom(scan: Scan, n_background: int) -> int:
    """Numbers left after position, tensors and background."""
    n_c, n_w, n_k = scan.y.shape
    return int(n_c * ((n_w - scan.n_masked) * n_k - N_TENSOR - n_k * n_background) - 3)


def verdicts(fitted: Sequence[tuple[Scan, Fit]], setting: Setting) -> Iterator[ScanResult]:
    """One result for each fitted scan; all scans of one shape."""
    stack = _stack([scan for scan, _ in fitted], [fit for _, fit in fitted], setting)
    for i, (scan, fit) in enumerate(fitted):
        yield _verdict(scan, fit, stack, i, setting)


def _stack(scans: Sequence[Scan], fits: Sequence[Fit], setting: Setting) -> _Stack:
    n_c, n_w, n_k = scans[0].y.shape
    numbers = np.array([n_c * n_k * (n_w - s.n_masked) for s in scans])
    dof = np.array(
        [degrees_of_freedom(s, setting.n_background) - f.n_outliers for s, f in zip(scans, fits, strict=True)]
    )
    chi2 = np.array([f.chi2 for f in fits])
    variance = np.ones(len(fits))
    if not setting.sigma_known:
        variance = dg.noise_variance(chi2, np.array([f.scale for f in fits]), numbers, dof)
        variance = np.maximum(variance, LEAST_NOISE**2)
    p_value = dg.chi2_p_value(chi2, dof)
    mismatch = setting.sigma_known & (p_value < MISMATCH_P)
    inflation = variance * np.where(mismatch, np.maximum(chi2 / np.maximum(dof, 1), 1.0), 1.0)
    covariance, least = dg.covariance_matrix(dg.fisher_matrix(np.stack([f.reduced for f in fits])))
    covariance = covariance * inflation[:, None, None]
    lr = np.array([f.explained for f in fits]) / variance
    threshold = dg.detection_threshold(n_c, dof, setting.sigma_known, setting.lr_threshold)
    determined = (least >= dg.MIN_INFORMATION) & (dof > 0)
    principal = _principal(np.stack([f.tensor_m3 for f in fits]), covariance)
    return _Stack(dof, variance, chi2 / variance, p_value, lr, lr > threshold, determined, covariance, principal)


def _principal(tensors_m3: FloatArray, covariance: FloatArray) -> dg.Principal:
    """Of the strongest channel of each scan."""
    scan = np.arange(len(tensors_m3))
    strongest = np.argmax((tensors_m3**2).sum(2), 1)
    rows = 3 + N_TENSOR * strongest[:, None] + np.arange(N_TENSOR)
    block = covariance[scan[:, None, None], rows[:, :, None], rows[:, None, :]]
    return dg.principal_values(tensors_m3[scan, strongest], block)


def _verdict(scan: Scan, fit: Fit, stack: _Stack, i: int, setting: Setting) -> ScanResult:
    status, reasons = _judge(fit, stack, i, setting)
    reasons += ["masked_samples"] * (scan.n_masked > 0) + ["outliers"] * (fit.n_outliers > 0)
    there = status not in ("no_target", "underdetermined")
    return ScanResult(
        scan.scan_index,
        status,
        tuple(reasons),
        _target(fit, stack, i, setting) if there else None,
        chi2=float(stack.chi2[i]),
        dof=max(int(stack.dof[i]), 0),
        p_value=float(stack.p_value[i]) if setting.sigma_known else None,
        likelihood_ratio=float(stack.lr[i]),
        sigma_t=_sigma(scan, float(stack.variance[i])),
        n_used=scan.y.shape[1] - scan.n_masked,
        n_masked=scan.n_masked,
        n_outliers=fit.n_outliers,
        iterations=fit.iterations,
    )


def _judge(fit: Fit, stack: _Stack, i: int, setting: Setting) -> tuple[Status, list[str]]:
    """Status and reasons; what makes the position most doubtful gives the status."""
    if not stack.detected[i]:
        return "no_target", ["likelihood_ratio_below_threshold"]
    if not stack.determined[i]:
        return "underdetermined", ["information"]
    position, depth = fit.r_m, setting.bounds.surface_m - fit.r_m[2]
    depth_sd = float(np.sqrt(stack.covariance[i, 2, 2]))
    found: list[tuple[bool, Status, str]] = [
        (not dg.inside(position, setting.bounds.lower_m, setting.bounds.upper_m), "edge", "at_search_bound"),
        (not _seen_around(position, depth, setting), "edge", "outside_scan"),
        (depth_sd > POOR_DEPTH * depth, "low_snr", "depth_uncertain"),
        (setting.sigma_known and stack.p_value[i] < MISMATCH_P, "multiple_or_mismatch", "misfit"),
        (depth < DIPOLE_RADII * setting.dipole_radius_m, "ok", "dipole_transmitter_near"),
        (depth_sd > LINEAR_DEPTH * depth, "ok", "covariance_optimistic"),
        (not fit.converged, "ok", "not_converged"),
    ]
    true = [(status, reason) for holds, status, reason in found if holds]
    return (true[0][0] if true else "ok"), [reason for _, reason in true]


def _seen_around(position_m: FloatArray, depth_m: float, setting: Setting) -> bool:
    margin = EDGE_IN_DEPTHS * depth_m
    return dg.inside(position_m[:2], setting.edge_lower_m - margin, setting.edge_upper_m + margin)


def _target(fit: Fit, stack: _Stack, i: int, setting: Setting) -> Target:
    principal = stack.principal
    shape = dg.SHAPES[principal.shape[i]]
    isotropic = shape == "isotropic"
    return Target(
        fit.r_m,
        float(setting.bounds.surface_m - fit.r_m[2]),
        stack.covariance[i],
        fit.tensor_m3,
        principal.values_m3[i],
        principal.sd_m3[i],
        shape,
        None if isotropic else principal.axis[i],
        None if isotropic else float(principal.axis_sd_rad[i]),
    )


def _sigma(scan: Scan, variance: float) -> float:
    weights = scan.w[scan.w > 0.0]
    return float(np.sqrt(variance * np.mean(weights**-2.0)))
