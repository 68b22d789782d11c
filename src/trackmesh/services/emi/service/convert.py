"""Between messages and the arrays of the engine."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.messages import (
    EmiAngles,
    EmiGeometry,
    EmiLimit,
    EmiOptions,
    EmiReceiver,
    EmiResult,
    EmiScanBatch,
    EmiTarget,
)
from trackmesh.services.emi.diagnosis.attitude import Attitude
from trackmesh.services.emi.diagnosis.results import ScanResult, Target
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import XYZ, Z_ONLY, Coils, Receiver, rotations

TESLA = {"T": 1.0, "nT": 1e-9, "pT": 1e-12, "arbitrary": 1.0}
DIRECTIONS = {"xyz": XYZ, "z": Z_ONLY}


class Head(NamedTuple):
    """What every answer to a batch repeats."""

    batch_id: str
    field_unit: str
    unit_id: str | None = None
    geometry_id: str | None = None


class Request(NamedTuple):
    """The arguments of ``engine.invert``."""

    coils: Coils
    field_t: FloatArray
    sigma_t: FloatArray | float | None
    options: Options


def to_request(batch: EmiScanBatch, geometry: EmiGeometry, lr_threshold: float) -> Request:
    """The engine's view of a batch over a geometry."""
    unit = TESLA[batch.field_unit]
    return Request(to_coils(geometry), batch.field * unit, sigma_t(batch), to_options(batch.options, lr_threshold))


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
        tuple(to_receiver(receiver) for receiver in geometry.all_receivers),
        None if geometry.attitude is None else rotations(geometry.attitude),
    )


def to_receiver(receiver: EmiReceiver) -> Receiver:
    """The engine's view of a receiver."""
    measured = receiver.components
    directions = DIRECTIONS[measured] if isinstance(measured, str) else np.array(measured)
    return Receiver(directions, np.array(receiver.offset_m), receiver.radius_m)


def to_options(options: EmiOptions, lr_threshold: float) -> Options:
    """The engine's view of options."""
    prior = options.prior
    x0, y0, x1, y1 = options.area_m or (0.0, 0.0, 0.0, 0.0)
    return Options(
        options.estimator,
        options.max_targets,
        options.background,
        options.robust,
        options.side,
        options.depth_min_m,
        options.depth_max_m,
        None if options.area_m is None else (x0, y0, x1, y1),
        None if prior is None else np.array([prior.position_m, prior.sd_m]),
        options.block_m,
        lr_threshold,
    )


def sigma_t(batch: EmiScanBatch) -> FloatArray | float | None:
    """Standard deviation of the noise in T, broadcast against a scan (C, W, K)."""
    if batch.sigma is None:
        return None
    sigma: FloatArray = np.array(batch.sigma, np.float64) * TESLA[batch.field_unit]
    if batch.sigma_factor is not None:
        sigma = np.asarray(batch.sigma_factor[:, None] * sigma)
    if batch.channel_factor is not None:
        sigma = np.asarray(batch.channel_factor[:, None, None] * sigma)
    return sigma


def to_message(result: ScanResult, head: Head) -> EmiResult:
    """The answer to one scan."""
    relative = ["tensor_relative"] if head.field_unit == "arbitrary" and result.targets else []
    limit = result.limit
    return EmiResult(
        batch_id=head.batch_id,
        index=result.scan_index,
        status=result.status,
        reasons=[*result.reasons, *relative],
        targets=[to_target(target) for target in result.targets],
        chi2=result.chi2,
        dof=result.dof,
        p_value=result.p_value,
        likelihood_ratio=result.likelihood_ratio,
        sigma_used=None if result.sigma_t is None else result.sigma_t / TESLA[head.field_unit],
        n_used=result.n_used,
        n_masked=result.n_masked,
        n_outliers=result.n_outliers,
        iterations=result.iterations,
        local_chi2=result.local_chi2,
        bic=list(result.bic),
        limit=None if limit is None else EmiLimit(depth_m=limit.depth_m, polarizability_m3=limit.polarizability_m3),
        unit_id=head.unit_id,
        geometry_id=head.geometry_id,
    )


def to_target(target: Target) -> EmiTarget:
    """One target of an answer."""
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
        p_isotropic=target.p_isotropic,
        p_axisymmetric=target.p_axisymmetric,
        axis_covariance=target.axis_covariance,
        angles=to_angles(target.attitude),
        channel=target.channel,
        channel_principal_m3=target.channel_principal_m3,
        inflation=target.inflation,
        ambiguous=target.ambiguous,
    )


def to_angles(attitude: Attitude) -> EmiAngles:
    """The angles of a target."""
    named = {f"{name}_rad": value for name, value in attitude.angles_rad.items()}
    return EmiAngles.model_validate({**named, "covariance": attitude.covariance, "undefined": attitude.undefined})
