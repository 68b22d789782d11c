"""Principal polarizabilities, and which of them are equal as far as the noise lets one see."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc

from trackmesh.services.emi.fields import from_elements
from trackmesh.services.emi.kernels import FloatArray, IntArray

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
        raw_m3: (b, 3) eigenvalues as they are, those across the axis first.
        vectors: (b, 3, 3) the eigenvectors of these, one a column; the last, the axis, belongs to the eigenvalue that
            stands apart from the middle one, and points up.
        shape: (b,) index into ``SHAPES``.
        p_isotropic: (b,) p value of the test against three equal values.
        p_axisymmetric: (b,) and of that against two equal transverse ones.
    """

    values_m3: FloatArray
    sd_m3: FloatArray
    raw_m3: FloatArray
    vectors: FloatArray
    shape: IntArray
    p_isotropic: FloatArray
    p_axisymmetric: FloatArray


def principal_values(tensor_m3: FloatArray, covariance: FloatArray) -> Principal:
    """Eigenvalues, axes and shape of tensors (b, 6) with covariances (b, 6, 6), to first order.

    d lambda_i = v_i^T dM v_i. Isotropy is tested on the five deviatoric elements (A. Wald, 1943).
    """
    values, vectors = _axis_last(*np.linalg.eigh(from_elements(tensor_m3)))
    # One product a tensor: a product of all of them would have other last bits.
    deviatoric = (DEVIATORIC @ tensor_m3[:, :, None])[:, :, 0]
    p_isotropic = _wald(deviatoric, DEVIATORIC @ covariance @ DEVIATORIC.T)
    p_axisymmetric = _p_transverse(values, vectors, covariance)
    shape = np.where(p_isotropic > SIGNIFICANCE, 0, np.where(p_axisymmetric > SIGNIFICANCE, 1, 2))
    reported, sd = _reported(values, vectors, covariance, shape)
    return Principal(reported, sd, values, vectors, shape, p_isotropic, p_axisymmetric)


def along_axes(tensors_m3: FloatArray, vectors: FloatArray) -> FloatArray:
    """Responses (b, C, 3) of every channel's tensor (b, C, 6) along given axes (b, 3, 3), one a column."""
    squares = np.stack([dyads(vectors[:, :, i], vectors[:, :, i]) for i in range(3)], 2)
    return np.asarray(tensors_m3 @ squares)


def dyads(a: FloatArray, b: FloatArray) -> FloatArray:
    """Gradient (b, 6) of a^T M b by the elements of M."""
    cross = [a[:, i] * b[:, j] + a[:, j] * b[:, i] for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.stack([a[:, 0] * b[:, 0], a[:, 1] * b[:, 1], a[:, 2] * b[:, 2], *cross], 1)


def _axis_last(values: FloatArray, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    # The axis belongs to the eigenvalue that stands apart from the middle one.
    top = values[:, 2] - values[:, 1] >= values[:, 1] - values[:, 0]
    order = np.where(top[:, None], np.array([0, 1, 2]), np.array([1, 2, 0]))
    values = np.take_along_axis(values, order, 1)
    vectors = np.take_along_axis(vectors, order[:, None, :], 2)
    up = np.where(vectors[:, 2, 2] < 0.0, -1.0, 1.0)
    vectors = np.concatenate([vectors[:, :, :2], vectors[:, :, 2:] * up[:, None, None]], 2)
    return values, vectors


def _reported(
    values: FloatArray, vectors: FloatArray, covariance: FloatArray, shape: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Values and standard deviations (b, 3): equal ones averaged, since noise always splits their estimates."""
    mean = np.array([np.full((3, 3), 1.0 / 3.0), [[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 1.0]], np.eye(3)])[shape]
    gradient = mean @ np.stack([dyads(vectors[:, :, i], vectors[:, :, i]) for i in range(3)], 1)
    averaged = (mean @ values[:, :, None])[:, :, 0]
    sd = np.sqrt(np.maximum(((gradient @ covariance) * gradient).sum(2), 0.0))
    falling = np.argsort(-np.abs(averaged), axis=1, kind="stable")
    order = np.where((shape == SHAPES.index("general"))[:, None], falling, np.arange(3))
    return np.take_along_axis(averaged, order, 1), np.take_along_axis(sd, order, 1)


def _p_transverse(values: FloatArray, vectors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Wald's p value (b,) of two equal transverse values, from (M_11 - M_22, 2 M_12) in their plane."""
    v, u = vectors[:, :, 0], vectors[:, :, 1]
    gradient = np.stack([dyads(v, v) - dyads(u, u), 2.0 * dyads(v, u)], 1)
    difference = np.stack([values[:, 0] - values[:, 1], np.zeros(len(values))], 1)
    return _wald(difference, gradient @ covariance @ gradient.transpose(0, 2, 1))


def _wald(x: FloatArray, covariance: FloatArray) -> FloatArray:
    """Wald's p value (b,) of x (b, n) = 0."""
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    unit = covariance / (scale[:, :, None] * scale[:, None, :])
    z = x / scale
    return np.asarray(chdtrc(x.shape[1], (z * np.linalg.solve(unit, z[:, :, None])[:, :, 0]).sum(1)))
