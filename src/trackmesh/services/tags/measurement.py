"""What one range says of a state: predicted distance, gradient, and the update of one model.

z = (1 + s) d(p) + b + noise, d(p) = |p - reader|, which depends on two of the states in a way that is not linear. Both
forms replace it by d(p) ~ m + g (p - mean) + e, and go on as a linear update with e as further noise:

* EKF: m = d(mean), g its gradient, e = 0;
* two-dimensional unscented transform (n = 2, kappa = 1): sigma points mean + sqrt(3) L u for u = 0 and the unit
  vectors with both signs, L L^T the covariance of the position; weights 1/3 and 1/6, all positive. m and g are mean and
  regression of d over these points, e has the variance that the regression leaves. Since it cannot be negative,
  covariances stay covariances. (Julier and Uhlmann 1997; it matches moments as the six-dimensional transform with
  kappa = -3 does, without the weight of -1 of its centre.)

A range that is longer than predicted by r > c sigmas is doubted: S <- S (r/c)^2, which cuts its gain. What stands in
the way between tag and reader only lengthens ranges, so that shorter ones are trusted up to a larger c.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.tags.records import BIAS, EKF, SCALE, Range, Rules, Work

FloatArray = npt.NDArray[np.float64]

_ROOT3 = math.sqrt(3.0)
_NEAR_M = 1e-9
_FLAT = 1e-9


@inlined
def distance(e: float, n: float, place: FloatArray) -> float:
    """Distance of (e, n) from a reader at ``place`` [east, north, height above the tags]."""
    de, dn = e - place[0], n - place[1]
    return math.sqrt(de * de + dn * dn + place[2] * place[2])


@kernel
def linearise_at_mean(x: FloatArray, place: FloatArray, h: FloatArray) -> None:
    """Write distance, its gradient east and north, and 0 to h (4,)."""
    d = distance(x[0], x[1], place)
    h[0], h[3] = d, 0.0
    if d > _NEAR_M:
        h[1], h[2] = (x[0] - place[0]) / d, (x[1] - place[1]) / d
    else:
        h[1], h[2] = 1.0, 0.0


@kernel
def linearise_unscented(x: FloatArray, P: FloatArray, place: FloatArray, u: FloatArray, h: FloatArray) -> None:
    """Write mean distance, its regression on the position, and the variance left, to h (4,).

    Args:
        x, P: state and covariance, position first. place: (3,).
        u: (5,) scratch.
    """
    l00 = math.sqrt(max(P[0, 0], 0.0))
    l10 = P[0, 1] / l00 if l00 > 0.0 else 0.0
    l11 = math.sqrt(max(P[1, 1] - l10 * l10, 0.0))
    if l00 < _NEAR_M or l11 < _FLAT * l00:
        linearise_at_mean(x, place, h)
        return
    a, b, c = _ROOT3 * l00, _ROOT3 * l10, _ROOT3 * l11
    u[0] = distance(x[0], x[1], place)
    u[1], u[2] = distance(x[0] + a, x[1] + b, place), distance(x[0] - a, x[1] - b, place)
    u[3], u[4] = distance(x[0], x[1] + c, place), distance(x[0], x[1] - c, place)
    mean = u[0] / 3.0 + (u[1] + u[2] + u[3] + u[4]) / 6.0
    left = (u[0] - mean) ** 2 / 3.0
    for k in range(1, 5):
        left += (u[k] - mean) ** 2 / 6.0
    # Correlation of d with the two normalised coordinates.
    g0, g1 = _ROOT3 / 6.0 * (u[1] - u[2]), _ROOT3 / 6.0 * (u[3] - u[4])
    h[0] = mean
    h[2] = g1 / l11
    h[1] = (g0 - l10 * h[2]) / l00
    h[3] = max(left - g0 * g0 - g1 * g1, 0.0)


@kernel
def update(rules: Rules, x: FloatArray, P: FloatArray, place: FloatArray, z: Range, w: Work) -> float:
    """Update one model with one range in place; the log-likelihood of it, ln N(nu; 0, S) with the S that was used.

    ``w.doubt`` receives nu over the square root of the S that was expected.
    """
    h = w.h
    if rules.update == EKF:
        linearise_at_mean(x, place, h)
    else:
        linearise_unscented(x, P, place, w.u, h)
    shared = len(x) > BIAS
    slope = 1.0 + x[SCALE] if shared else 1.0
    nu = z.range_m - slope * h[0] - (x[BIAS] if shared else 0.0)
    variance = z.variance + (z.relative * h[0]) ** 2 + slope * slope * h[3]
    s = _project(P, slope * h[1], slope * h[2], h[0], w.gain) + variance
    if not s > 0.0:
        w.doubt = 0.0
        return -np.inf
    w.doubt = nu / math.sqrt(s)
    limit = rules.doubt_long if nu > 0.0 else rules.doubt_short
    if abs(w.doubt) > limit:
        s *= (w.doubt / limit) ** 2
    for a in range(len(x)):
        x[a] += w.gain[a] * nu / s
        for b in range(a, len(x)):
            P[a, b] -= w.gain[a] * w.gain[b] / s
            P[b, a] = P[a, b]
    return float(-0.5 * (math.log(2.0 * math.pi * s) + nu * nu / s))


@inlined
def _project(P: FloatArray, h_east: float, h_north: float, d: float, gain: FloatArray) -> float:
    """Write P h^T (d,) for h = [h_east, h_north, 0, 0, 0, 0, 1, d]; returns h P h^T."""
    n = len(gain)
    for a in range(n):
        gain[a] = P[a, 0] * h_east + P[a, 1] * h_north
        if n > BIAS:
            gain[a] += P[a, BIAS] + P[a, SCALE] * d
    total = h_east * gain[0] + h_north * gain[1]
    if n > BIAS:
        total += gain[BIAS] + d * gain[SCALE]
    return float(total)
