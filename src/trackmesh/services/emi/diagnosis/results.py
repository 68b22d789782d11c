"""What is told of a scan."""

from __future__ import annotations

from typing import Literal, NamedTuple

from trackmesh.services.emi.diagnosis.attitude import Attitude
from trackmesh.services.emi.diagnosis.detection import Limit
from trackmesh.services.emi.diagnosis.shape import Shape
from trackmesh.services.emi.kernels import FloatArray

Status = Literal[
    "ok", "no_target", "low_snr", "multiple_or_mismatch", "underdetermined", "edge", "invalid", "too_large"
]


class Target(NamedTuple):
    """One target.

    Attributes:
        position_m: (3,).
        depth_m: below the median height of the sensor; negative above it.
        covariance: (3 + 6 C, 3 + 6 C) of x, y, z and of the tensor's elements xx, yy, zz, xy, xz, yz of each channel.
        tensor_m3: (C, 6).
        channel: the strongest one, to which what follows belongs.
        principal_m3, principal_sd_m3: (3,) of it, see ``shape.Principal``.
        channel_principal_m3: (C, 3) responses of all channels along its principal axes.
        shape: which of the three values are equal as far as the noise lets one see.
        p_isotropic, p_axisymmetric: p values of the tests.
        axis, axis_covariance, axis_sd_rad: (3,), (3, 3), unit vector that points up; None for an isotropic body.
        attitude: its angles.
        inflation: by how much the covariance was raised for what the model does not explain.
        ambiguous: ``mirror`` if another target of the same scan is its image, and only one of them is there.
    """

    position_m: FloatArray
    depth_m: float
    covariance: FloatArray
    tensor_m3: FloatArray
    channel: int
    principal_m3: FloatArray
    principal_sd_m3: FloatArray
    channel_principal_m3: FloatArray
    shape: Shape
    p_isotropic: float
    p_axisymmetric: float
    axis: FloatArray | None
    axis_covariance: FloatArray | None
    axis_sd_rad: float | None
    attitude: Attitude
    inflation: float = 1.0
    ambiguous: Literal["mirror"] | None = None


class ScanResult(NamedTuple):
    """The answer for one scan; numbers that do not exist are None.

    Attributes:
        scan_index: of the scan in its batch.
        status: the verdict.
        reasons: short machine-readable words that qualify it.
        targets: the strongest first; none if the status is no_target, invalid or too_large.
        chi2, dof, p_value: goodness of fit over all samples, outliers left out; no p value with estimated noise.
        local_chi2: mean square of the residuals in noise variances, weighed by the squared signal.
        likelihood_ratio: by how much the targets lower the residual sum of squares, in units of the noise variance.
        bic: Bayesian information criterion of 0, 1, ... targets, as far as tried.
        sigma_t: standard deviation of the noise in T: as given (root mean square), or estimated.
        limit: what could have been missed, where there is no target.
        n_used, n_masked: samples.
        n_outliers: numbers weighed down.
        iterations: of the search.
    """

    scan_index: int
    status: Status
    reasons: tuple[str, ...]
    targets: tuple[Target, ...] = ()
    chi2: float | None = None
    dof: int | None = None
    p_value: float | None = None
    local_chi2: float | None = None
    likelihood_ratio: float | None = None
    bic: tuple[float, ...] = ()
    sigma_t: float | None = None
    limit: Limit | None = None
    n_used: int = 0
    n_masked: int = 0
    n_outliers: int = 0
    iterations: int = 0
