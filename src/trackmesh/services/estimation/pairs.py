"""The sequential test of whether two tracks of two sensors are one target, as kernels over pairs.

Each cycle adds, to the log-likelihood ratio of a pair,
l = ln t_4(d; 0, S, nu) - ln rho + ln(4 pi s_v^2): the Student-t density of the difference of states against that of an
unrelated track (rho tracks a square metre, velocities spread by s_v per axis), weighted by min(1, dt/tau_c) since
differences are correlated in time, and forgets with exp(-dt/tau_f). The sum of squared distances, the statistic of
Long, Cai, Li and Qiu (2022), bars pairs whose fit is absolutely bad.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class PairRules(NamedTuple):
    """Constants of the test.

    Attributes:
        nu: degrees of freedom of the Student-t density; infinite for the Gaussian one.
        speed_mps, radius_m: spread of unrelated velocities per axis; radius in which tracks are counted for rho.
        correlation_s, memory_s, fit_memory_s: tau_c, tau_f, and the memory of the sum of squared distances.
        low, high: clip of one increment.
        floor: least value of the sum.
        fit_limit: the pair is barred above this multiple of the 1e-4 quantile.
        break_at: threshold of the cumulative sum that breaks a pair.
    """

    nu: float = 8.0
    speed_mps: float = 250.0
    radius_m: float = 10_000.0
    correlation_s: float = 4.0
    memory_s: float = 60.0
    fit_memory_s: float = 30.0
    low: float = -20.0
    high: float = 15.0
    floor: float = -20.0
    fit_limit: float = 1.3
    break_at: float = 20.0


@kernel
def state_distances(
    xa: FloatArray, Pa: FloatArray, xb: FloatArray, Pb: FloatArray, ia: IntArray, ib: IntArray, blur: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """d^T S^-1 d and ln|S| of pairs, d = xa[ia] - xb[ib], S = Pa[ia] + Pb[ib], 4 states, by Cholesky.

    ``blur`` (n, 2, 2) is added to the position block of S: what the difference of the sensors' biases is not known
    better than. A pair whose S is not positive definite gets an infinite distance.
    """
    n = len(ia)
    distance, logdet = np.empty(n), np.empty(n)
    L, y = np.empty((4, 4)), np.empty(4)
    for k in range(n):
        i, j = ia[k], ib[k]
        distance[k] = logdet[k] = 0.0
        for a in range(4):
            for b in range(a + 1):
                value = Pa[i, a, b] + Pb[j, a, b]
                if a < 2:
                    value += blur[k, a, b]
                for c in range(b):
                    value -= L[a, c] * L[b, c]
                if a == b:
                    if not value > 0.0:
                        distance[k] = np.inf
                        value = 1.0
                    L[a, a] = np.sqrt(value)
                    logdet[k] += np.log(value)
                else:
                    L[a, b] = value / L[b, b]
            y[a] = xa[i, a] - xb[j, a]
            for c in range(a):
                y[a] -= L[a, c] * y[c]
            y[a] /= L[a, a]
            distance[k] += y[a] * y[a]
    return distance, logdet


@kernel
def local_density(x: FloatArray, others: FloatArray, radius_m: float) -> FloatArray:
    """Other tracks a square metre around each of x (n, >= 2): those within ``radius_m``, at least one."""
    rho = np.empty(len(x))
    n = len(others)
    order = np.argsort(others[:, 0])
    east, north = np.empty(n), np.empty(n)
    for j in range(n):
        east[j], north[j] = others[order[j], 0], others[order[j], 1]
    for i in range(len(x)):
        count = 0
        j = int(np.searchsorted(east, x[i, 0] - radius_m))
        while j < n and east[j] <= x[i, 0] + radius_m:
            de, dn = x[i, 0] - east[j], x[i, 1] - north[j]
            count += de * de + dn * dn < radius_m * radius_m
            j += 1
        rho[i] = max(count, 1) / (np.pi * radius_m * radius_m)
    return rho


def log_ratio(rules: PairRules, distance: FloatArray, logdet: FloatArray, density: FloatArray) -> FloatArray:
    """The increment l of pairs, clipped."""
    nu = rules.nu
    if math.isinf(nu):
        log_t = -2 * math.log(2 * math.pi) - 0.5 * logdet - 0.5 * distance
    else:
        constant = math.lgamma((nu + 4) / 2) - math.lgamma(nu / 2) - 2 * math.log(nu * math.pi)
        log_t = constant - 0.5 * logdet - 0.5 * (nu + 4) * np.log1p(distance / nu)
    l_new = log_t - np.log(density) + math.log(4 * math.pi * rules.speed_mps**2)
    return np.asarray(np.clip(l_new, rules.low, rules.high))


def chi2_upper(dof: FloatArray, z: float = 3.719) -> FloatArray:
    """Upper quantile of chi-square for a normal quantile z (3.719: 1e-4), by Wilson and Hilferty (1931)."""
    c = 2.0 / (9.0 * dof)
    return np.asarray(dof * (1.0 - c + z * np.sqrt(c)) ** 3)
