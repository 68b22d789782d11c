"""Covariance intersection: one estimate of two whose errors are correlated nobody knows how.

P^-1 = w Pa^-1 + (1 - w) Pb^-1, x = P (w Pa^-1 xa + (1 - w) Pb^-1 xb), 0 <= w <= 1 (Julier and Uhlmann 1997). Whatever
the correlation, P is not below the covariance of the error of x if Pa and Pb are not below theirs. w makes det P least,
which does not depend on the units of the state.

No covariance is inverted. With S(w) = w Pb + (1 - w) Pa,

    P = Pa S^-1 Pb,    x = xa + (1 - w) Pa S^-1 (xb - xa),    ln det P = ln det Pa + ln det Pb - ln det S(w),

and ln det S is concave in w: its derivative tr(S^-1 (Pb - Pa)) falls, and has one zero, or w is 0 or 1.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]

_STEPS = 60
_ACCURACY = 1e-10


@kernel
def intersect(
    xa: FloatArray, Pa: FloatArray, xb: FloatArray, Pb: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariance intersection of n pairs of estimates.

    Args:
        xa, xb: (n, d) states. Pa, Pb: (n, d, d) symmetric covariances.

    Returns:
        states (n, d), covariances (n, d, d), and the weight w (n,) of a. Where Pa <= Pb that is a itself, and likewise
        b. A pair with a covariance that is not positive definite gives a.
    """
    n, d = xa.shape
    x, P, weight = xa.copy(), Pa.copy(), np.ones(n)
    L, M = np.empty((d, d)), np.empty((d, d))
    for k in range(n):
        w = weight[k] = _weight(Pa[k], Pb[k], L, M)
        if w == 1.0:
            continue
        if w == 0.0:
            x[k], P[k] = xb[k], Pb[k]
            continue
        # L is the root of S(w); M = S^-1 Pa.
        for j in range(d):
            for i in range(d):
                M[i, j] = Pa[k, i, j]
            _solve(L, M, j)
        for i in range(d):
            for j in range(d):
                x[k, i] += (1.0 - w) * M[j, i] * (xb[k, j] - xa[k, j])
            for j in range(i, d):
                value = 0.0
                for h in range(d):
                    value += M[h, i] * Pb[k, h, j]
                P[k, i, j] = P[k, j, i] = value
    return x, P, weight


@kernel
def _weight(Pa: FloatArray, Pb: FloatArray, L: FloatArray, M: FloatArray) -> float:
    """The w that makes det P least, by Newton's method between bounds; L becomes the Cholesky root of S(w).

    Exactly 1 where a alone is best, exactly 0 where b is.
    """
    steep, _ = _slope(Pa, Pb, 1.0, L, M)
    if not steep < 0.0:
        return 1.0
    steep, bend = _slope(Pa, Pb, 0.0, L, M)
    if steep <= 0.0:
        return 0.0
    if math.isnan(steep):
        return 1.0
    low, high, w = 0.0, 1.0, 0.0
    for _ in range(_STEPS):
        if steep > 0.0:
            low = w
        else:
            high = w
        step = w + steep / bend
        if not low < step < high:
            step = 0.5 * (low + high)
        done = abs(step - w) < _ACCURACY
        w = step
        steep, bend = _slope(Pa, Pb, w, L, M)
        if done or steep == 0.0:
            break
    return w


@kernel
def _slope(Pa: FloatArray, Pb: FloatArray, w: float, L: FloatArray, M: FloatArray) -> tuple[float, float]:
    """Derivative of ln det S at w, and minus the second one; not a number where S is not positive definite.

    With S = L L^T and M = L^-1 (Pb - Pa) L^-T they are tr M and the sum of the squares of M.
    """
    d = len(Pa)
    for i in range(d):
        for j in range(i + 1):
            value = w * Pb[i, j] + (1.0 - w) * Pa[i, j]
            for h in range(j):
                value -= L[i, h] * L[j, h]
            if i > j:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = math.sqrt(value)
            else:
                return math.nan, math.nan
    for i in range(d):
        for j in range(d):
            value = Pb[i, j] - Pa[i, j]
            for h in range(i):
                value -= L[i, h] * M[h, j]
            M[i, j] = value / L[i, i]
    slope = bend = 0.0
    for i in range(d):
        for j in range(d):
            value = M[i, j]
            for h in range(j):
                value -= M[i, h] * L[j, h]
            M[i, j] = value / L[j, j]
            bend += M[i, j] * M[i, j]
        slope += M[i, i]
    return slope, bend


@kernel
def _solve(L: FloatArray, M: FloatArray, j: int) -> None:
    """Replace column j of M by (L L^T)^-1 of it."""
    d = len(L)
    for i in range(d):
        for h in range(i):
            M[i, j] -= L[i, h] * M[h, j]
        M[i, j] /= L[i, i]
    for i in range(d - 1, -1, -1):
        for h in range(i + 1, d):
            M[i, j] -= L[h, i] * M[h, j]
        M[i, j] /= L[i, i]
