"""The posterior Cramer-Rao bound of a tag's position: no filter can have a smaller mean squared error.

Tichavsky, Muravchik and Nehorai (1998), for linear motion: J <- (Q + F J^-1 F^T)^-1 + sum_i p_d E[u_i u_i^T] / sigma^2
with u_i the direction from reader i, averaged over the paths and over whether a reader hears. Information is averaged,
not its inverse, so the bound is a little too small where few readers hear.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.tags import singer
from trackmesh.sim.scenario import Tags
from trackmesh.sim.studies.rfid.worlds import Data

FloatArray = npt.NDArray[np.float64]


def posterior_bound(tags: Tags, truth: FloatArray, alpha: float, variance: float, first: FloatArray) -> float:
    """Least RMS error of the position in metres over all ticks.

    Args:
        truth: (ticks + 1, runs, 2) paths of Singer's model with this ``alpha`` and ``variance``.
        first: (6,) variances of the first state.
    """
    F, noise = _model(alpha, variance, tags.tick_s)
    readers = np.array([reader.site_enu_m for reader in tags.readers], float)
    P, squared = np.diag(first), []
    for at in truth[1:]:
        J = np.linalg.inv(F @ P @ F.T + noise)
        J[:2, :2] += _information(tags, readers, at)
        P = np.asarray(np.linalg.inv(J))
        squared.append(P[0, 0] + P[1, 1])
    return float(np.sqrt(np.mean(squared)))


def bound_given(data: Data, alpha: float, variance: float, first: FloatArray) -> float:
    """As ``posterior_bound``, with the information of the readings that there were in each run, then averaged.

    No filter is below it either, but for what it gains by chance: it is the larger, since few readings cost more than
    as many more readings gain.
    """
    F, noise = _model(alpha, variance, data.tick_s)
    P = np.broadcast_to(np.diag(first), (data.truth.shape[1], 6, 6))
    squared = []
    for at, z in zip(data.truth[1:], data.ranges, strict=True):
        J = np.linalg.inv(F @ P @ F.T + noise)
        apart = at[z["row"]] - data.readers[z["reader"], :2]
        u = apart / np.hypot(*apart.T)[:, None]
        np.add.at(J[:, :2, :2], z["row"], u[:, :, None] * u[:, None, :] / z["variance"][:, None, None])
        P = np.asarray(np.linalg.inv(J))
        squared.append(P[:, 0, 0] + P[:, 1, 1])
    return float(np.sqrt(np.mean(squared)))


def _model(alpha: float, variance: float, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (6, 6) of Singer's model over a tick."""
    step, block = np.empty(3), np.empty(6)
    singer.transition(alpha, dt_s, step)
    singer.noise(alpha, variance, dt_s, block)
    A = np.array([[1.0, dt_s, step[0]], [0.0, 1.0, step[1]], [0.0, 0.0, step[2]]])
    Q = np.zeros((3, 3))
    Q[np.triu_indices(3)] = block
    F, noise = np.kron(A, np.eye(2)), np.kron(Q + np.triu(Q, 1).T, np.eye(2))
    return np.asarray(F, np.float64), np.asarray(noise, np.float64)


def _information(tags: Tags, readers: FloatArray, at: FloatArray) -> FloatArray:
    """Mean information (2, 2) of one tick about the position."""
    apart = at[:, None] - readers
    d = np.hypot(apart[..., 0], apart[..., 1])
    u = apart / np.maximum(d, 1e-9)[..., None]
    heard = tags.p_detect * (d <= tags.max_range_m) / tags.sigma_range_m**2
    return np.asarray(np.einsum("kr,kra,krb->ab", heard, u, u) / len(at))
