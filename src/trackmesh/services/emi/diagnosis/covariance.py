"""Fisher matrices of positions and tensors, and their inverses.

Parameters are x, y, z of each target, then for each channel the six tensor elements of each target.
"""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, PER_TARGET
from trackmesh.services.emi.kernels import BoolArray, FloatArray, IntArray

MIN_INFORMATION = 1e-9
"""Least eigenvalue of the unit-diagonal Fisher matrix of a fit that is determined."""


def fisher_matrix(reduced: FloatArray) -> FloatArray:
    """Fisher matrices (b, P, P), P = 3 T + 6 T C, from the reduced matrices (b, C, 9 T + 1, 9 T + 1)."""
    b, n_c, last = reduced.shape[0], reduced.shape[1], reduced.shape[2] - 1
    n_t = last // PER_TARGET
    n_a, n_d = N_TENSOR * n_t, 3 * n_t
    fisher = np.zeros((b, n_d + n_a * n_c, n_d + n_a * n_c))
    a, d = slice(0, n_a), slice(n_a, last)
    for c in range(n_c):
        m = slice(n_d + n_a * c, n_d + n_a * (c + 1))
        fisher[:, :n_d, :n_d] += reduced[:, c, d, d]
        fisher[:, :n_d, m] = reduced[:, c, d, a]
        fisher[:, m, :n_d] = reduced[:, c, a, d]
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


def parameters_of(target: int, n_targets: int, n_channels: int) -> IntArray:
    """Which parameters are those of one target: x, y, z, then six elements a channel."""
    place = 3 * target + np.arange(3)
    first = 3 * n_targets + N_TENSOR * (n_targets * np.arange(n_channels) + target)
    return np.concatenate([place, (first[:, None] + np.arange(N_TENSOR)).ravel()])
