"""The thesis's filters in plain numpy, one sample at a time: what ours are compared with, in speed and in numbers.

After Liu Zhiyang, EMI detection by filter tracking (2018), table 4-1: field h = G(d) M G(d) z in m^-3 with M in m^3,
the constants left out, as the thesis has it. Coincident coils, a vertical dipole, three components.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def green(d: FloatArray) -> FloatArray:
    """G(d) = (3 d d^T / d^2 - I) / d^3."""
    length = np.linalg.norm(d)
    n = d / length
    return np.asarray((3.0 * np.outer(n, n) - np.eye(3)) / length**3)


def tensor_rows(u: FloatArray) -> FloatArray:
    """W (3, 6) with W m = M u."""
    x, y, z = u
    return np.array([[x, 0, 0, y, z, 0], [0, y, 0, x, 0, z], [0, 0, z, 0, x, y]])


def matrix(m: FloatArray) -> FloatArray:
    """M of its six elements."""
    return np.array([[m[0], m[3], m[4]], [m[3], m[1], m[5]], [m[4], m[5], m[2]]])


def gradient(d: FloatArray, m: FloatArray) -> FloatArray:
    """Derivative of G(d) m by d."""
    length = np.linalg.norm(d)
    n = d / length
    along = n @ m
    inner = along * (np.eye(3) - 5.0 * np.outer(n, n)) + np.outer(n, m) + np.outer(m, n)
    return np.asarray(3.0 / length**4 * inner)


def position_rows(d: FloatArray, m: FloatArray) -> FloatArray:
    """Derivative (3, 3) of h by the target's position."""
    g, up = green(d), np.array([0.0, 0.0, 1.0])
    M = matrix(m)
    return -(gradient(d, M @ g @ up) + g @ M @ gradient(d, up))


def separate_kf_ekf(
    positions_m: FloatArray, h: FloatArray, r: FloatArray, m: FloatArray, p0: float, q: float
) -> tuple[FloatArray, FloatArray]:
    """Table 4-1 over samples h (W, 3) with R = I; position and tensor elements."""
    P_r, P_m = p0 * np.eye(3), p0 * np.eye(6)
    for place, z in zip(positions_m, h, strict=True):
        P_m = P_m + q * np.eye(6)
        m, P_m = kalman(m, P_m, _tensor_part(place - r), z - _tensor_part(place - r) @ m)
        P_r = P_r + q * np.eye(3)
        r, P_r = kalman(r, P_r, position_rows(place - r, m), z - _tensor_part(place - r) @ m)
    return r, m


def joint_ekf(positions_m: FloatArray, h: FloatArray, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One covariance for all nine, R = I, no process noise; state and covariance."""
    for place, z in zip(positions_m, h, strict=True):
        rows = _tensor_part(place - x[:3])
        H = np.hstack([position_rows(place - x[:3], x[3:]), rows])
        x, P = kalman(x, P, H, z - rows @ x[3:])
    return x, P


def kalman(x: FloatArray, P: FloatArray, H: FloatArray, innovation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One update with R = I."""
    K = np.linalg.solve(H @ P @ H.T + np.eye(len(H)), H @ P).T
    return x + K @ innovation, P - K @ H @ P


def _tensor_part(d: FloatArray) -> FloatArray:
    g = green(d)
    return np.asarray(g @ tensor_rows(g[:, 2]))
