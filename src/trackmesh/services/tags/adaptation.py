"""Learning the acceleration's variance, and in the slides' form its rate too, from the estimated acceleration.

Slides on RFID tracking, (8-18) to (8-21), by Yule and Walker's equations for a first-order process, with the misprints
mended that make it run at all (r(0) averages a_i^2, and the driving variance is r(0) - beta r(1))::

    r(0) += g (a_i^2 - r(0)),  r(1) += g (a_i a_{i-1} - r(1)),  g = 1/i
    beta = r(1) / r(0),  sigma_w^2 = r(0) - beta r(1)
    alpha = -ln(beta) / dt,  sigma_a^2 = sigma_w^2 / (1 - beta^2)

So it collapses: a_i is an estimate, whose square is too small by its variance P_aa; a smaller variance makes the filter
stiffer and the estimate smaller still. The mends, each a flag: ``WITH_COVARIANCE`` averages a_i^2 + P_aa (this is the
cure), ``FORGET`` lets g fall no further than 1/window, ``MEAN_LAG`` uses the mean interval instead of the last one,
``LIMITS`` bounds what comes out. Since sigma_a^2 = r(0) identically, ``ADAPT_VARIANCE`` alone leaves alpha as it is:
r(1) lacks a covariance of its own, so that alpha is not identified.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import SINGER
from trackmesh.services.tags.records import (
    ADAPT_ALPHA,
    ADAPT_VARIANCE,
    FORGET,
    LIMITS,
    MEAN_LAG,
    WITH_COVARIANCE,
    Filter,
    Rules,
)

FloatArray = npt.NDArray[np.float64]

_BETA_LEAST, _BETA_MOST = 0.2, 0.995
_ALPHA_LEAST, _ALPHA_MOST = 0.02, 2.0
_FIRST_INSTANTS = 4


@kernel
def adapt(rules: Rules, f: Filter, dt_s: float) -> None:
    """Adapt the Singer model of a filter after the update of an instant that came ``dt_s`` after the one before."""
    if not rules.adapt or dt_s <= 0.0:
        return
    j = 0
    while rules.kind[j] != SINGER:
        j += 1
    f.instants += 1
    g = 1.0 / f.instants
    if rules.adapt & FORGET:
        g = max(g, 1.0 / rules.adapt_window)
    f.lag_s += g * (dt_s - f.lag_s)
    for axis in range(2):
        a = f.x[j, 4 + axis]
        extra = f.P[j, 4 + axis, 4 + axis] if rules.adapt & WITH_COVARIANCE else 0.0
        f.r0[axis] += g * (a * a + extra - f.r0[axis])
        f.r1[axis] += g * (a * f.last_a[axis] - f.r1[axis])
        f.last_a[axis] = a
        _set(rules, f, axis, dt_s)


@kernel
def _set(rules: Rules, f: Filter, axis: int, dt_s: float) -> None:
    limited = rules.adapt & LIMITS
    if limited and f.instants <= rules.adapt_after:
        return
    if not limited and f.instants <= _FIRST_INSTANTS:
        # The "current" model of the first steps: what is left of the largest acceleration.
        most = math.sqrt(rules.variance_most)
        f.variance[axis] = (4.0 - math.pi) / math.pi * (most - abs(f.last_a[axis])) ** 2
        return
    if rules.adapt & ADAPT_ALPHA:
        _set_alpha(rules, f, axis, dt_s)
    elif rules.adapt & ADAPT_VARIANCE:
        f.variance[axis] = f.r0[axis]
    if limited:
        f.variance[axis] = min(max(f.variance[axis], rules.variance_least), rules.variance_most)


@kernel
def _set_alpha(rules: Rules, f: Filter, axis: int, dt_s: float) -> None:
    beta = f.r1[axis] / f.r0[axis] if f.r0[axis] > 0.0 else -1.0
    if rules.adapt & LIMITS:
        beta = min(max(beta, _BETA_LEAST), _BETA_MOST)
    if not 0.0 < beta < 1.0:
        # No first-order process has such moments: what was found before stays.
        return
    f.alpha[axis] = -math.log(beta) / (f.lag_s if rules.adapt & MEAN_LAG else dt_s)
    if rules.adapt & LIMITS:
        f.alpha[axis] = min(max(f.alpha[axis], _ALPHA_LEAST), _ALPHA_MOST)
    driving = f.r0[axis] - beta * f.r1[axis]
    f.variance[axis] = driving / (1.0 - beta * beta)
