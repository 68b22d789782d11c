"""The Markov chain of motion models in continuous time.

Models are held for exponentially distributed sojourn times and then left for another one; the transition probability
matrix over dt is Pi(dt) = expm(G dt) with the generator G = diag(1/tau) (J - I), J_ij the probability that model i is
left for model j. Row i, column j of Pi is the probability of going from model i to model j. Pi(dt) belongs to the
interval that it predicts over: a matrix given for a step is used in that very step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

_SERIES_OF = 0.5
_MIXED = 1e15
_SMALLEST_TERM = 1e-18


def generator(sojourn_s: FloatArray, jumps: FloatArray | None = None) -> FloatArray:
    """Generator G (r, r) of a chain, 1/s.

    Args:
        sojourn_s: (r,) mean sojourn times in seconds, positive.
        jumps: (r, r) J, rows summing to one with a zero diagonal; default: every other model alike.

    Raises:
        ValueError: a sojourn time is not positive, or J is no jump matrix.
    """
    tau = np.asarray(sojourn_s, float)
    r = len(tau)
    if not np.all(tau > 0):
        raise ValueError("sojourn times must be positive")
    if r == 1:
        return np.zeros((1, 1))
    J = (np.ones((r, r)) - np.eye(r)) / (r - 1) if jumps is None else np.asarray(jumps, float)
    if J.shape != (r, r) or (J < 0).any() or np.diag(J).any() or abs(J.sum(axis=1) - 1).max() > 1e-9:
        raise ValueError("jumps must be an (r, r) matrix with rows that sum to one and a zero diagonal")
    return np.asarray((J - np.eye(r)) / tau[:, None])


def stationary(G: FloatArray) -> FloatArray:
    """Long-run model probabilities p (r,): p G = 0, summing to one."""
    r = len(G)
    balance = np.vstack([G.T / max(abs(G).max(), 1e-300), np.ones(r)])
    p, *_ = np.linalg.lstsq(balance, np.append(np.zeros(r), 1.0), rcond=None)
    return np.asarray(np.maximum(p, 0.0) / np.maximum(p, 0.0).sum())


@kernel
def transition_matrix(G: FloatArray, dt_s: float, out: FloatArray) -> None:
    """Write Pi(dt) = expm(G dt) into ``out`` (r, r); rows sum to one, entries are not negative.

    Uniformisation (Jensen 1953) and squaring: with g = max -G_ii, U = I + G/g and h = dt/2^m so short that g h <= 0.5,
    expm(G h) ~ sum_k (g h)^k/k! U^k, of which nothing is negative; it needs no eigenvectors, which a chain may lack.
    """
    r = len(G)
    fastest = 0.0
    for i in range(r):
        fastest = max(fastest, -G[i, i])
        for j in range(r):
            out[i, j] = 1.0 if i == j else 0.0
    if not (fastest > 0.0 and dt_s > 0.0):
        return
    power, halvings = min(fastest * dt_s, _MIXED), 0
    while power > _SERIES_OF:
        power, halvings = 0.5 * power, halvings + 1
    term, product = np.empty((r, r)), np.empty((r, r))
    term[:, :] = out
    k, weight = 1, power
    while weight > _SMALLEST_TERM:
        for i in range(r):
            for j in range(r):
                value = term[i, j]
                for a in range(r):
                    value += term[i, a] * G[a, j] / fastest
                product[i, j] = max(value, 0.0) * power / k
        for i in range(r):
            for j in range(r):
                term[i, j] = product[i, j]
                out[i, j] += product[i, j]
        k += 1
        weight *= power / k
    _normalise_rows(out)
    for _ in range(halvings):
        for i in range(r):
            for j in range(r):
                value = 0.0
                for a in range(r):
                    value += out[i, a] * out[a, j]
                product[i, j] = value
        out[:, :] = product
        _normalise_rows(out)


@kernel
def _normalise_rows(matrix: FloatArray) -> None:
    for i in range(len(matrix)):
        total = 0.0
        for j in range(len(matrix)):
            total += matrix[i, j]
        for j in range(len(matrix)):
            matrix[i, j] /= total
