"""One filter through one instant: predict, take its ranges one after the other, weigh the models, adapt."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.imm import reweigh
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags import measurement, printed
from trackmesh.services.tags.adaptation import adapt
from trackmesh.services.tags.prediction import moments, predict
from trackmesh.services.tags.records import BIAS, PRINTED, SCALE, Filter, Range, Records, Rules, Work

FloatArray = npt.NDArray[np.float64]

_FIT_GAIN = 0.05


@kernel
def begin(rules: Rules, f: Filter, t_s: float, east_m: float, north_m: float, R: FloatArray) -> None:
    """Start a filter at a position with covariance R (3,) [ee, en, nn], at rest as far as is known."""
    r, d = f.x.shape
    for j in range(r):
        for a in range(d):
            f.x[j, a] = 0.0
            for b in range(d):
                f.P[j, a, b] = 0.0
        f.x[j, 0], f.x[j, 1] = east_m, north_m
        f.P[j, 0, 0], f.P[j, 1, 1] = R[0], R[2]
        f.P[j, 0, 1] = f.P[j, 1, 0] = R[1]
        for axis in range(2):
            f.P[j, 2 + axis, 2 + axis] = rules.speed_variance
            f.P[j, 4 + axis, 4 + axis] = rules.variance
        if d > BIAS:
            f.P[j, BIAS, BIAS], f.P[j, SCALE, SCALE] = rules.bias_variance, rules.scale_variance
        f.mu[j] = 1.0 / r
    for axis in range(2):
        f.alpha[axis], f.variance[axis] = rules.alpha, rules.variance
        f.r0[axis] = f.r1[axis] = f.last_a[axis] = 0.0
    f.lag_s, f.instants, f.doubts, f.fit, f.t_s = 0.0, 0, 0, 1.0, t_s


@kernel
def filter_instant(rules: Rules, f: Filter, readers: FloatArray, z: Records, w: Work) -> float:
    """Predict a filter to the time of ranges (m,), all of one instant, and update it with them in place.

    Returns:
        Their log-likelihood.
    """
    dt_s = z[0].t_s - f.t_s
    predict(rules, f, z[0].t_s, w)
    total = 0.0
    if rules.update == PRINTED:
        if not printed.update_instant(f.x[0], f.P[0], readers, z):
            w.discarded += 1
    else:
        for k in range(len(z)):
            total += update_range(rules, f, readers[z[k].reader], z[k], w)
    adapt(rules, f, dt_s)
    return total


@kernel
def update_range(rules: Rules, f: Filter, place: FloatArray, z: Range, w: Work) -> float:
    """Update all models of a filter with one range in place, and count whether it is doubted; its log-likelihood."""
    doubt = 0.0
    r = len(f.mu)
    for j in range(r):
        w.log_likelihood[j] = measurement.update(rules, f.x[j], f.P[j], place, z, w)
        doubt += f.mu[j] * w.doubt
    good = -rules.doubt_short <= doubt <= rules.doubt_long
    f.doubts = 0 if good else f.doubts + 1
    f.fit += _FIT_GAIN * ((1.0 if good else 0.0) - f.fit)
    if r == 1:
        return float(w.log_likelihood[0])
    return float(reweigh(f.mu, w.log_likelihood, 0, r))


@kernel
def filter_ranges(rules: Rules, filters: Records, readers: FloatArray, z: Records, w: Work) -> None:
    """Take ranges (n,), sorted by row and then by time, each group of one row and time as an instant of that filter."""
    first = 0
    while first < len(z):
        end = group_end(z, first)
        filter_instant(rules, filters[z[first].row], readers, z[first:end], w)
        first = end


@kernel
def group_end(z: Records, first: int) -> int:
    """The index behind the last range of the same row and time as ``z[first]``."""
    end = first + 1
    while end < len(z) and z[end].row == z[first].row and z[end].t_s == z[first].t_s:
        end += 1
    return end


@kernel
def estimates(rules: Rules, filters: Records, t_s: float, w: Work, mean: FloatArray, covariance: FloatArray) -> None:
    """Write the moment-matched states of all filters, predicted to ``t_s``: (n, k), (n, k, k); filters are changed."""
    for row in range(len(filters)):
        predict(rules, filters[row], t_s, w)
        moments(filters[row].x, filters[row].P, filters[row].mu, mean[row], covariance[row])
