"""The published TV-IMM (Luan, Yu, Gu and Zhao 2021, equations 14 to 21), for comparison; not for use.

Beside the usual mixing and filtering it takes, over the common block of position and velocity,

* as output the product of the models' Gaussians: P = (sum_j P_j^-1)^-1, x = P sum_j P_j^-1 x_j (14, 15);
* as model probabilities mu_j ~ N(x_j; x, P) (16 to 18), which do not see the plot;
* as the next transition matrix pi_ij ~ N(x_i; x_j, P_j), rows normalised (19 to 21).

Corrected against the print: the sums of (5) and (6) run over i; no noise in the mean of (8); the sign and transpose of
(9); the order of factors in (14). Densities are kept in logarithms, ``JITTER`` relative to the trace is added to every
covariance before it is inverted, and no probability falls below ``LEAST_PROBABILITY``, since a model that nothing comes
to has no mixed state. When all models see one plot, the product counts it once a model: the covariance is too small by
their number, and the estimate diverges in manoeuvres.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.bank import Models, State
from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

JITTER = 1e-9
LEAST_PROBABILITY = 1e-12
_COMMON = 4


@kernel
def product_of_gaussians(x: FloatArray, P: FloatArray, out_x: FloatArray, out_P: FloatArray) -> None:
    """Product of r Gaussians over position and velocity (14, 15): writes mean (4,) and covariance (4, 4)."""
    information, inverse = np.zeros((_COMMON, _COMMON)), np.empty((_COMMON, _COMMON))
    weighted = np.zeros(_COMMON)
    for j in range(len(x)):
        invert(P[j], inverse)
        for a in range(_COMMON):
            for b in range(_COMMON):
                information[a, b] += inverse[a, b]
                weighted[a] += inverse[a, b] * x[j, b]
    invert(information, out_P)
    for a in range(_COMMON):
        out_x[a] = 0.0
        for b in range(_COMMON):
            out_x[a] += out_P[a, b] * weighted[b]


@kernel
def after_update(models: Models, s: State) -> None:
    """Replace probabilities and next transition matrix by the printed ones."""
    r = len(models.kind)
    mean, P = np.empty(_COMMON), np.empty((_COMMON, _COMMON))
    product_of_gaussians(s.x, s.P, mean, P)
    log_density = np.empty(r)
    for j in range(r):
        log_density[j] = log_normal(s.x[j], mean, P)
    normalise(log_density, s.mu)
    for a in range(r):
        for b in range(r):
            log_density[b] = log_normal(s.x[a], s.x[b], s.P[b])
        normalise(log_density, s.counts[a])


@kernel
def normalise(log_weight: FloatArray, out: FloatArray) -> None:
    """Write exp(log_weight) / sum, floored."""
    top, total = log_weight.max(), 0.0
    for j in range(len(log_weight)):
        out[j] = max(math.exp(log_weight[j] - top), LEAST_PROBABILITY)
        total += out[j]
    for j in range(len(log_weight)):
        out[j] /= total


@kernel
def log_normal(x: FloatArray, mean: FloatArray, P: FloatArray) -> float:
    """Log-density of N(x; mean, P) over position and velocity, without the constant that all models share."""
    L, y = np.empty((_COMMON, _COMMON)), np.empty(_COMMON)
    cholesky(P, L)
    value = 0.0
    for a in range(_COMMON):
        y[a] = x[a] - mean[a]
        for c in range(a):
            y[a] -= L[a, c] * y[c]
        y[a] /= L[a, a]
        value -= 0.5 * y[a] * y[a] + math.log(L[a, a])
    return value


@kernel
def cholesky(P: FloatArray, L: FloatArray) -> None:
    """Lower triangle L of the common block of P plus jitter."""
    jitter = JITTER * (P[0, 0] + P[1, 1] + P[2, 2] + P[3, 3])
    for a in range(_COMMON):
        for b in range(a + 1):
            value = P[a, b]
            for c in range(b):
                value -= L[a, c] * L[b, c]
            if a == b:
                L[a, a] = math.sqrt(max(value + jitter, jitter + 1e-300))
            else:
                L[a, b] = value / L[b, b]


@kernel
def invert(P: FloatArray, out: FloatArray) -> None:
    """Inverse of the common block of P plus jitter, symmetric."""
    L, column = np.empty((_COMMON, _COMMON)), np.empty(_COMMON)
    cholesky(P, L)
    for k in range(_COMMON):
        for a in range(_COMMON):
            column[a] = 1.0 if a == k else 0.0
            for c in range(a):
                column[a] -= L[a, c] * column[c]
            column[a] /= L[a, a]
        for b in range(_COMMON - 1, -1, -1):
            for c in range(b + 1, _COMMON):
                column[b] -= L[c, b] * column[c]
            column[b] /= L[b, b]
        for a in range(_COMMON):
            out[a, k] = column[a]
    for a in range(_COMMON):
        for b in range(a + 1, _COMMON):
            out[b, a] = out[a, b]
