"""The Markov chain of motion models in continuous time.

Models are held for exponentially distributed sojourn times; the transition probability matrix over dt is
Pi(dt) = expm(G dt) with the generator G_ii = -1/tau_i and G_ij = 1/(tau_i (r - 1)). Row i, column j is the probability
of going from model i to model j. Pi(dt) belongs to the interval that it predicts over: a matrix given for a step is
used in that very step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]


class Chain(NamedTuple):
    """Eigen-decomposition of the generator: G = left @ diag(rate) @ right, all real.

    G satisfies detailed balance with weights tau_i, therefore its eigenvalues are real.
    """

    left: FloatArray
    rate_per_s: FloatArray
    right: FloatArray


def chain(sojourn_s: FloatArray) -> Chain:
    """Decompose the generator of a chain with the given mean sojourn times.

    Args:
        sojourn_s: (r,) mean sojourn times in seconds, positive.

    Raises:
        ValueError: a sojourn time is not positive.
    """
    tau = np.asarray(sojourn_s, float)
    if not np.all(tau > 0):
        raise ValueError("sojourn times must be positive")
    r = len(tau)
    if r == 1:
        return Chain(np.ones((1, 1)), np.zeros(1), np.ones((1, 1)))
    G = np.repeat(1.0 / (tau * (r - 1)), r).reshape(r, r)
    np.fill_diagonal(G, -1.0 / tau)
    # diag(sqrt tau) G diag(1/sqrt tau) is symmetric.
    root = np.sqrt(tau)
    rate, U = np.linalg.eigh(G * root[:, None] / root[None, :])
    return Chain(
        np.ascontiguousarray(U / root[:, None]), np.minimum(rate, 0.0), np.ascontiguousarray(U.T * root[None, :])
    )


def stationary(sojourn_s: FloatArray) -> FloatArray:
    """Long-run model probabilities (r,), proportional to the sojourn times."""
    tau = np.asarray(sojourn_s, float)
    return np.asarray(tau / tau.sum())


@kernel
def transition_matrix(chain: Chain, dt_s: float, out: FloatArray) -> None:
    """Write Pi(dt) = expm(G dt) into ``out`` (r, r); rows sum to one, entries are not negative."""
    r = len(chain.rate_per_s)
    for i in range(r):
        total = 0.0
        for j in range(r):
            value = 0.0
            for k in range(r):
                value += chain.left[i, k] * np.exp(chain.rate_per_s[k] * dt_s) * chain.right[k, j]
            out[i, j] = max(value, 0.0)
            total += out[i, j]
        for j in range(r):
            out[i, j] /= total
