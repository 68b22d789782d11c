"""What a fit is worth: detection, goodness of fit, covariance, shape.

All functions take stacks: the leading axis b is the scans of a chunk. Each scan's answer is the same bits whatever
stands beside it.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.fields import from_elements
from trackmesh.services.emi.kernels import BoolArray, FloatArray, IntArray

LR_THRESHOLD = 45.0
"""Likelihood ratio below which a scan of one channel holds no target (noise alone stays below 33 in 99 of 100)."""
MIN_INFORMATION = 1e-9
"""Least eigenvalue of the unit-diagonal Fisher matrix of a fit that is determined."""
MIN_PLACES = 4
COLLINEAR = 1e-6
SMALL_DOF = 30
SIGNIFICANCE = 0.05

Shape = Literal["isotropic", "axisymmetric", "general"]
SHAPES: tuple[Shape, ...] = ("isotropic", "axisymmetric", "general")

_S2, _S6 = np.sqrt(2.0), np.sqrt(6.0)
DEVIATORIC = np.array(
    [
        [1 / _S2, -1 / _S2, 0, 0, 0, 0],
        [1 / _S6, 1 / _S6, -2 / _S6, 0, 0, 0],
        [0, 0, 0, _S2, 0, 0],
        [0, 0, 0, 0, _S2, 0],
        [0, 0, 0, 0, 0, _S2],
    ]
)


class Principal(NamedTuple):
    """Principal polarizabilities of a stack of tensors.

    Attributes:
        values_m3, sd_m3: (b, 3). Isotropic: the mean, three times. Axisymmetric: the transverse mean twice, then the
            axial value. General: descending by magnitude.
        axis: (b, 3) unit vector of the isolated eigenvalue, up; undefined for an isotropic tensor.
        axis_sd_rad: (b,) standard deviation of its direction (root of the sum of both variances).
        shape: (b,) index into ``SHAPES``.
        p_isotropic: (b,) p value of the test against three equal values.
    """

    values_m3: FloatArray
    sd_m3: FloatArray
    axis: FloatArray
    axis_sd_rad: FloatArray
    shape: IntArray
    p_isotropic: FloatArray


def geometry_defect(places_m: FloatArray) -> str | None:
    """Why samples at ``places_m`` (n, 3) cannot determine a target: ``too_few_places``, ``collinear``, or None."""
    unique = np.unique(places_m, axis=0)
    if len(unique) < MIN_PLACES:
        return "too_few_places"
    spread = np.linalg.svd(unique - unique.mean(0), compute_uv=False)
    return "collinear" if spread[1] <= COLLINEAR * spread[0] else None


def fisher_matrix(reduced: FloatArray) -> FloatArray:
    """Fisher matrix (b, 3 + 6 C, 3 + 6 C) of position and tensors from the reduced matrices (b, C, 10, 10)."""
    b, n_c = reduced.shape[:2]
    fisher = np.zeros((b, 3 + N_TENSOR * n_c, 3 + N_TENSOR * n_c))
    a, d = slice(0, N_TENSOR), slice(N_TENSOR, N_TENSOR + 3)
    for c in range(n_c):
        m = slice(3 + N_TENSOR * c, 9 + N_TENSOR * c)
        fisher[:, :3, :3] += reduced[:, c, d, d]
        fisher[:, :3, m] = reduced[:, c, d, a]
        fisher[:, m, :3] = reduced[:, c, a, d]
        fisher[:, m, m] = reduced[:, c, a, a]
    return fisher


def covariance_matrix(fisher: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of Fisher matrices (b, n, n), and the least eigenvalue (b,) of each scaled to a unit diagonal.

    Where that eigenvalue is below ``MIN_INFORMATION`` the inverse is the identity, which means nothing.
    """
    diagonal = np.diagonal(fisher, axis1=1, axis2=2)
    sound: BoolArray = np.all(np.isfinite(diagonal) & (diagonal > 0.0), axis=1)
    scale = np.where(sound[:, None], 1.0 / np.sqrt(np.where(sound[:, None], diagonal, 1.0)), 1.0)
    unit = np.where(sound[:, None, None], fisher * scale[:, :, None] * scale[:, None, :], np.eye(fisher.shape[-1]))
    least = np.where(sound, np.linalg.eigvalsh(unit)[:, 0], 0.0)
    known = least >= MIN_INFORMATION
    unit = np.where(known[:, None, None], unit, np.eye(fisher.shape[-1]))
    inverse = np.linalg.solve(unit, np.broadcast_to(np.eye(fisher.shape[-1]), unit.shape))
    inverse = 0.5 * (inverse + inverse.transpose(0, 2, 1))
    return inverse * scale[:, :, None] * scale[:, None, :], least


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


def chi2_p_value(chi2: FloatArray, dof: IntArray) -> FloatArray:
    """Probability (b,) of a larger chi2."""
    return np.asarray(chdtrc(np.maximum(dof, 1), chi2))


def principal_values(tensor_m3: FloatArray, covariance: FloatArray) -> Principal:
    """Eigenvalues, axis and shape of tensors (b, 6) with covariances (b, 6, 6), to first order.

    d lambda_i = v_i^T dM v_i;  d a = sum_j (v_j^T dM a) / (lambda_a - lambda_j) v_j.
    """
    values, vectors = np.linalg.eigh(from_elements(tensor_m3))
    # The axis belongs to the eigenvalue that stands apart from the middle one.
    top = values[:, 2] - values[:, 1] >= values[:, 1] - values[:, 0]
    order = np.where(top[:, None], np.array([0, 1, 2]), np.array([1, 2, 0]))
    values = np.take_along_axis(values, order, 1)
    vectors = np.take_along_axis(vectors, order[:, None, :], 2)
    p_isotropic = _wald(tensor_m3 @ DEVIATORIC.T, DEVIATORIC @ covariance @ DEVIATORIC.T)
    shape = np.where(
        p_isotropic > SIGNIFICANCE, 0, np.where(_p_transverse(values, vectors, covariance) > SIGNIFICANCE, 1, 2)
    )
    reported, sd = _reported(values, vectors, covariance, shape)
    axis = vectors[:, :, 2] * np.where(vectors[:, 2, 2] < 0.0, -1.0, 1.0)[:, None]
    return Principal(reported, sd, axis, _axis_sd(values, vectors, covariance), shape, p_isotropic)


def _reported(
    values: FloatArray, vectors: FloatArray, covariance: FloatArray, shape: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Values and standard deviations (b, 3): equal ones averaged, since noise always splits their estimates."""
    mean = np.array([np.full((3, 3), 1.0 / 3.0), [[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 1.0]], np.eye(3)])[shape]
    gradient = mean @ np.stack([_dyads(vectors[:, :, i], vectors[:, :, i]) for i in range(3)], 1)
    averaged = (mean @ values[:, :, None])[:, :, 0]
    sd = np.sqrt(np.maximum(((gradient @ covariance) * gradient).sum(2), 0.0))
    falling = np.argsort(-np.abs(averaged), axis=1, kind="stable")
    order = np.where((shape == SHAPES.index("general"))[:, None], falling, np.arange(3))
    return np.take_along_axis(averaged, order, 1), np.take_along_axis(sd, order, 1)


def _dyads(a: FloatArray, b: FloatArray) -> FloatArray:
    """Gradient (b, 6) of a^T M b by the elements of M."""
    cross = [a[:, i] * b[:, j] + a[:, j] * b[:, i] for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack([a[:, 0] * b[:, 0], a[:, 1] * b[:, 1], a[:, 2] * b[:, 2], *cross], 1)


def _p_transverse(values: FloatArray, vectors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Wald's p value (b,) of two equal transverse values, from (M_11 - M_22, 2 M_12) in their plane."""
    v, u = vectors[:, :, 0], vectors[:, :, 1]
    gradient = np.stack([_dyads(v, v) - _dyads(u, u), 2.0 * _dyads(v, u)], 1)
    difference = np.stack([values[:, 0] - values[:, 1], np.zeros(len(values))], 1)
    return _wald(difference, gradient @ covariance @ gradient.transpose(0, 2, 1))


def _axis_sd(values: FloatArray, vectors: FloatArray, covariance: FloatArray) -> FloatArray:
    variance = np.zeros(len(values))
    least_gap = 1e-9 * np.abs(values).max(1)
    for j in (0, 1):
        gap = np.maximum(np.abs(values[:, 2] - values[:, j]), least_gap)
        gradient = _dyads(vectors[:, :, j], vectors[:, :, 2]) / gap[:, None]
        variance += ((gradient[:, None, :] @ covariance)[:, 0, :] * gradient).sum(1)
    return np.minimum(np.sqrt(np.maximum(variance, 0.0)), np.pi / 2)


def _wald(x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Wald's p value (b,) of x (b, n) = 0."""
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    unit = covariance / (scale[:, :, None] * scale[:, None, :])
    z = x / scale
    return np.asarray(chdtrc(x.shape[1], (z * np.linalg.solve(unit, z[:, :, None])[:, :, 0]).sum(1)))


def inside(position_m: FloatArray, lower_m: FloatArray, upper_m: FloatArray) -> bool:
    """Whether a position lies within a box and not on its walls."""
    return bool(((position_m > lower_m) & (position_m < upper_m)).all())
