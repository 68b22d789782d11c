"""Between messages and the arrays of the engine."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.messages import EmiGeometry, EmiResult, EmiScanBatch, EmiTarget
from trackmesh.services.emi.engine import XYZ, Z_ONLY, Coils, Options
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.results import ScanResult, Target

TESLA = {"T": 1.0, "nT": 1e-9, "pT": 1e-12, "arbitrary": 1.0}


class Request(NamedTuple):
    """The arguments of ``engine.invert``."""

    coils: Coils
    field_t: FloatArray
    sigma_t: FloatArray | float | None
    options: Options


def to_request(batch: EmiScanBatch, lr_threshold: float) -> Request:
    """The engine's view of a batch."""
    unit, options = TESLA[batch.field_unit], batch.options
    return Request(
        to_coils(batch.geometry),
        batch.field * unit,
        _sigma(batch, unit),
        Options(options.background, options.robust, options.depth_min_m, options.depth_max_m, lr_threshold),
    )


def to_coils(geometry: EmiGeometry) -> Coils:
    """The engine's view of a geometry."""
    tx = geometry.transmitter
    return Coils(
        geometry.positions_m,
        tx.radius_m,
        tx.turns * tx.current_a * math.pi * tx.radius_m**2,
        tx.model == "loop",
        np.array(tx.axis) if geometry.axes is None else geometry.axes,
        np.array(tx.offset_m),
        np.array(geometry.receiver.offset_m),
        XYZ if geometry.receiver.components == "xyz" else Z_ONLY,
    )


def to_message(batch: EmiScanBatch, result: ScanResult) -> EmiResult:
    """The answer to scan ``result.scan_index`` of ``batch``."""
    relative = ["tensor_relative"] if batch.field_unit == "arbitrary" and result.target is not None else []
    return EmiResult(
        batch_id=batch.batch_id,
        index=result.scan_index,
        status=result.status,
        reasons=[*result.reasons, *relative],
        targets=[] if result.target is None else [_target(result.target)],
        chi2=result.chi2,
        dof=result.dof,
        p_value=result.p_value,
        likelihood_ratio=result.likelihood_ratio,
        sigma_used=None if result.sigma_t is None else result.sigma_t / TESLA[batch.field_unit],
        n_used=result.n_used,
        n_masked=result.n_masked,
        n_outliers=result.n_outliers,
        iterations=result.iterations,
    )


def _target(target: Target) -> EmiTarget:
    return EmiTarget(
        position_m=target.position_m.tolist(),
        depth_m=target.depth_m,
        covariance=target.covariance,
        tensor_m3=target.tensor_m3,
        principal_m3=target.principal_m3.tolist(),
        principal_sd_m3=target.principal_sd_m3.tolist(),
        shape=target.shape,
        axis=None if target.axis is None else target.axis.tolist(),
        axis_sd_rad=target.axis_sd_rad,
    )


def _sigma(batch: EmiScanBatch, unit: float) -> FloatArray | float | None:
    if batch.sigma is None:
        return None
    by_component = np.array(batch.sigma, np.float64) * unit
    if batch.sigma_factor is None:
        return by_component
    return np.asarray(batch.sigma_factor[:, None] * by_component)
