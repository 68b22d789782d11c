"""The Markov chain of motion models in continuous time.

Models are held for exponentially distributed sojourn times and then left for another one; the transition probability
matrix over dt is Pi(dt) = expm(G dt) with the generator G = diag(1/tau) (J - I), J_ij the probability that model i is
left for model j. Row i, column j of Pi is the probability of going from model i to model j. Pi(dt) belongs to the
interval that it predicts over: a matrix given for a step is used in that very step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel

FloatArray = npt.NDArray[np.float64]

_LARGEST_STEP = 1.0 / 16.0
_MIXED = 1e15
_WELL_APART = 1e3


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


def uniformised(G: FloatArray, size: int) -> tuple[FloatArray, float]:
    """The chain of generator G as jumps of one rate: U = I + G / rate with rate = max -G_ii (Jensen 1953).

    Returns:
        U, U^2, U^3 (3, size, size), whose rows are probabilities; states beyond those of G are never left. The rate,
        1/s.
    """
    rate = max(float(-np.diag(G).min()), 1e-300)
    U = np.eye(size)
    U[: len(G), : len(G)] += G / rate
    U = np.maximum(U, 0.0)
    return np.stack([U, U @ U, U @ U @ U]), rate


class Modes(NamedTuple):
    """A generator G = left diag(rate) right, where it has real eigenvalues and eigenvectors that are well apart.

    Attributes:
        usable: whether it has; else the rest means nothing.
        rate: (r,) eigenvalues, 1/s, none positive. left, right: (r, r), each the other's inverse.
    """

    usable: bool
    rate: FloatArray
    left: FloatArray
    right: FloatArray


def modes(G: FloatArray, size: int) -> Modes:
    """Eigenvalues and eigenvectors of a generator, padded to ``size`` with states that are never left."""
    r = len(G)
    rate, left, right = np.zeros(size), np.eye(size), np.eye(size)
    value, vector = np.linalg.eig(G)
    if np.iscomplexobj(value) or np.linalg.cond(vector) > _WELL_APART:
        return Modes(False, rate, left, right)
    # One eigenvalue of a generator is zero, and rounding must not make it grow.
    value[np.argmax(value)] = 0.0
    rate[:r], left[:r, :r], right[:r, :r] = np.minimum(value, 0.0), vector, np.linalg.inv(vector)
    return Modes(True, rate, left, right)


@kernel
def transition_by_modes(
    rate: FloatArray, left: FloatArray, right: FloatArray, dt_s: float, out: FloatArray, work: FloatArray
) -> None:
    """Write Pi(dt) = left diag(exp(rate dt)) right into ``out`` (r, r); rows sum to one, nothing is negative.

    Several times as fast as ``transition_matrix``, for chains that have such a form (see ``Modes``).

    Args:
        rate, left, right: of ``Modes``, the matrices at least (r, r). dt_s: >= 0.
        work: (>= r, >= r) scratch.
    """
    r = len(rate)
    for k in range(r):
        decay = np.exp(rate[k] * dt_s)
        for i in range(r):
            work[i, k] = left[i, k] * decay
    for i in range(r):
        total = 0.0
        for j in range(r):
            value = 0.0
            for k in range(r):
                value += work[i, k] * right[k, j]
            out[i, j] = max(value, 0.0)
            total += out[i, j]
        scale = 1.0 / total
        for j in range(r):
            out[i, j] *= scale


@kernel
def transition_matrix(jumps: FloatArray, rate: float, dt_s: float, out: FloatArray, work: FloatArray) -> None:
    """Write Pi(dt) = expm(G dt) of a uniformised chain into ``out`` (r, r); rows sum to one, nothing is negative.

    With p = rate dt / 2^m <= 1/16, expm(G dt / 2^m) ~ sum_k p^k/k! U^k up to k = 8, the sum being grouped by powers of
    U^3 (Paterson and Stockmeyer 1973), its rows normalised, then squared m times. The rest is below 1e-16.
    It needs no eigenvectors, which a chain may lack.

    Args:
        jumps: (3, r, r) U, U^2, U^3. rate: 1/s. dt_s: >= 0.
        work: (r, r) scratch.
    """
    U, U2, U3 = jumps[0], jumps[1], jumps[2]
    r = len(U)
    p, halvings = min(rate * dt_s, _MIXED), 0
    while p > _LARGEST_STEP:
        p, halvings = 0.5 * p, halvings + 1
    c2 = p * p / 2.0
    c3 = c2 * p / 3.0
    c4 = c3 * p / 4.0
    c5 = c4 * p / 5.0
    c6 = c5 * p / 6.0
    c7 = c6 * p / 7.0
    c8 = c7 * p / 8.0
    _combine(c6, c7, c8, U, U2, work)
    _multiply(U3, work, out)
    _combine(c3, c4, c5, U, U2, work)
    for i in range(r):
        for j in range(r):
            work[i, j] += out[i, j]
    _multiply(U3, work, out)
    _combine(1.0, p, c2, U, U2, work)
    for i in range(r):
        for j in range(r):
            out[i, j] += work[i, j]
    _normalise_rows(out)
    for _ in range(halvings):
        _multiply(out, out, work)
        for i in range(r):
            for j in range(r):
                out[i, j] = work[i, j]
        _normalise_rows(out)


@inlined
def _multiply(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    r = len(A)
    for i in range(r):
        for j in range(r):
            value = 0.0
            for k in range(r):
                value += A[i, k] * B[k, j]
            out[i, j] = value


@inlined
def _combine(a: float, b: float, c: float, U: FloatArray, U2: FloatArray, out: FloatArray) -> None:
    """Write a I + b U + c U^2."""
    r = len(U)
    for i in range(r):
        for j in range(r):
            out[i, j] = b * U[i, j] + c * U2[i, j]
        out[i, i] += a


@inlined
def _normalise_rows(matrix: FloatArray) -> None:
    for i in range(len(matrix)):
        total = 0.0
        for j in range(len(matrix)):
            total += matrix[i, j]
        for j in range(len(matrix)):
            matrix[i, j] /= total
