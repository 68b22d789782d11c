"""The axis of a body and its angles, with their covariance; or why there are none.

Yaw psi, pitch theta and roll phi as in ``polarizability.rotation``: the axis is (-sin theta, cos theta sin phi,
cos theta cos phi). A tensor knows neither the sign of its axes nor their order: the axis is that of the isolated
eigenvalue and points up, so both theta and phi lie within a right angle; a body of revolution has no psi.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.diagnosis.shape import SHAPES, Principal, dyads
from trackmesh.services.emi.kernels import FloatArray

NAMES = ("theta", "phi", "psi")
GIMBAL = 0.999
"""Component of the axis along x above which roll and yaw are one."""
MOST_SD_RAD = np.pi / 6
"""An angle known worse than this is not told."""
WIDE_SD_RAD = np.pi / 2
TINY = 1e-12


class Attitudes(NamedTuple):
    """Where the axes of a stack of bodies point; whether that means anything, ``undefined_angles`` tells.

    Attributes:
        axis: (b, 3) unit vectors, up.
        axis_covariance: (b, 3, 3) of them, to first order, singular along the axis.
        axis_sd_rad: (b,) standard deviation of the direction: root of the sum of both variances, a right angle at most.
        angles_rad: (b, 3) theta, phi, psi.
        covariance: (b, 3, 3) of these.
    """

    axis: FloatArray
    axis_covariance: FloatArray
    axis_sd_rad: FloatArray
    angles_rad: FloatArray
    covariance: FloatArray


class Attitude(NamedTuple):
    """The angles of one body.

    Attributes:
        angles_rad: theta, phi and psi by name, those that are defined.
        covariance: (a, a) of these, in that order.
        undefined: why the others are not, by name.
    """

    angles_rad: dict[str, float]
    covariance: FloatArray
    undefined: dict[str, str]


def attitudes(principal: Principal, covariance: FloatArray) -> Attitudes:
    """Axes and angles of bodies whose tensors have the covariances (b, 6, 6)."""
    values, vectors = _ordered(principal.raw_m3, principal.vectors)
    turn = np.stack([_turn(values, vectors, column) for column in range(3)], 1)
    axis_covariance = _carried(turn[:, 2], covariance)
    angles, gradient = _angles(vectors, turn)
    spread = np.sqrt(np.maximum(np.trace(axis_covariance, axis1=1, axis2=2), 0.0))
    return Attitudes(
        vectors[:, :, 2], axis_covariance, np.minimum(spread, WIDE_SD_RAD), angles, _carried(gradient, covariance)
    )


def attitude(stack: Attitudes, principal: Principal, i: int) -> Attitude:
    """The angles of body ``i``."""
    sd = np.sqrt(np.maximum(np.diagonal(stack.covariance[i]), 0.0))
    undefined = undefined_angles(SHAPES[principal.shape[i]], float(stack.axis[i, 0]), sd)
    told = [n for n, name in enumerate(NAMES) if name not in undefined]
    angles = {NAMES[n]: float(stack.angles_rad[i, n]) for n in told}
    return Attitude(angles, stack.covariance[i][np.ix_(told, told)], undefined)


def undefined_angles(shape: str, axis_x: float, sd_rad: FloatArray) -> dict[str, str]:
    """Why angles are not told: ``isotropic``, ``axisymmetric``, ``gimbal`` or ``uncertain``, by name."""
    if shape == "isotropic":
        return dict.fromkeys(NAMES, "isotropic")
    found = {name: "uncertain" for name, sd in zip(NAMES, sd_rad, strict=True) if not sd <= MOST_SD_RAD}
    if abs(axis_x) > GIMBAL or ("phi" in found and "theta" not in found):
        found |= {"phi": "gimbal", "psi": "gimbal"}
    if shape == "axisymmetric":
        found["psi"] = "axisymmetric"
    return found


def _ordered(values: FloatArray, vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The larger transverse value first, its axis towards +x, the three a rotation."""
    swap = np.abs(values[:, 1]) > np.abs(values[:, 0])
    order = np.where(swap[:, None], np.array([1, 0, 2]), np.arange(3))
    values = np.take_along_axis(values, order, 1)
    first = np.where(swap[:, None], vectors[:, :, 1], vectors[:, :, 0])
    first = first * np.where(first[:, :1] < 0.0, -1.0, 1.0)
    axis = vectors[:, :, 2]
    return values, np.stack([first, np.cross(axis, first), axis], 2)


def _turn(values: FloatArray, vectors: FloatArray, column: int) -> FloatArray:
    """Derivative (b, 3, 6) of eigenvectors: dv_i = sum_j (v_j^T dM v_i) / (l_i - l_j) v_j."""
    least_gap = 1e-9 * np.maximum(np.abs(values).max(1), 1e-300)
    out = np.zeros((len(values), 3, 6))
    for j in range(3):
        if j != column:
            gap = values[:, column] - values[:, j]
            gap = np.where(np.abs(gap) > least_gap, gap, least_gap)
            by_elements = dyads(vectors[:, :, j], vectors[:, :, column]) / gap[:, None]
            out += vectors[:, :, j, None] * by_elements[:, None, :]
    return out


def _angles(vectors: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """theta, phi, psi (b, 3), and their derivatives (b, 3, 6) by the elements of the tensor."""
    x, y, z = vectors[:, :, 2].T
    level = np.maximum(np.hypot(y, z), TINY)
    u, v = vectors[:, 0, 0], vectors[:, 0, 1]
    angles = np.stack([np.arctan2(-x, level), np.arctan2(y, z), np.arctan2(v, u)], 1)
    theta = np.stack([-level, x * y / level, x * z / level], 1)
    phi = np.stack([np.zeros_like(x), z / level**2, -y / level**2], 1)
    by_axis = np.stack([theta, phi], 1) @ turn[:, 2]
    psi = (u[:, None] * turn[:, 1, 0] - v[:, None] * turn[:, 0, 0]) / np.maximum(u * u + v * v, TINY**2)[:, None]
    return angles, np.concatenate([by_axis, psi[:, None]], 1)


def _carried(gradient: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.asarray(gradient @ covariance @ gradient.transpose(0, 2, 1))
