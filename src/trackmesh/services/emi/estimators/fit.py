"""Targets fitted to one scan: windows, several starts, outliers, one target more.

The information is near the target: samples within two depths of it hold it all but a few per cent. So the search runs
on a window about the targets (roughly at first, on a part of its samples), and all samples are asked for the noise and
the goodness of fit. Outliers are weighed down by Huber's weights (P. J. Huber, 1964), if they are lonely: readings
that are wrong together with their neighbours are no outliers but what the model does not know.
"""

from __future__ import annotations

from math import inf, isfinite
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.estimators.residuals import (
    Residuals,
    huber_weights,
    is_structured,
    local_misfit,
    lonely_outliers,
    residuals,
)
from trackmesh.services.emi.estimators.several import information_criteria, one_more
from trackmesh.services.emi.estimators.start import power_map, spikes, start_points, without
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Ground, Local, inside
from trackmesh.services.emi.windows import fine_search, over_all, rough_search

MOST_TARGETS = 3
ROBUST_ROUNDS = 3
NO_EXCESS = np.empty((0, 0))


class Enough(NamedTuple):
    """When a fit over all samples needs no other start, and when none is worth refining.

    Attributes:
        rss: residual sum of squares that is good,
        share: or its share of the sum without a target,
        gain: where it is lower than that sum by at least this.
        hopeless: gain, in noise variances, of a fit that is not worth refining.
    """

    rss: float
    share: float
    gain: float
    hopeless: float


class Task(NamedTuple):
    """What an estimator is given.

    Attributes:
        sensor: geometry.
        y, w: (C, W, K) field in T, and one over its standard deviation (0 where there is no sample).
        ground: where targets may be, and what is known.
        enough: when to stop trying.
        robust: find spikes before the search, and weigh outliers down (Huber) after it.
        most: targets; one more is kept if the Bayesian information criterion falls.
    """

    sensor: Sensor
    y: FloatArray
    w: FloatArray
    ground: Ground
    enough: Enough
    robust: bool = True
    most: int = 1


class Fit(NamedTuple):
    """Targets fitted to one scan, in whitened units but for positions and tensors.

    Attributes:
        r_m: (T, 3).
        tensor_m3: (C, T, 6).
        reduced: (C, 9 T + 1, 9 T + 1) Gram matrix of [A D y] over the window, from which the Fisher matrix is read.
        explained: by how much the targets lower the residual sum of squares of all samples, beside the background.
        chi2: residual sum of squares of all samples, outliers left out.
        scale: robust standard deviation of the whitened residuals of all samples.
        local: mean square of the residuals, each weighed by the square of the signal there,
        n_local: and over how many numbers that is a mean.
        n_outliers: numbers left out of chi2 and weighed down in the fit.
        n_window: samples in the window.
        iterations: over all starts and passes.
        converged: whether the last search ended by a small step.
        bic: (4,) Bayesian information criterion of 0 to 3 targets; NaN for what was not tried.
        excess: (P, P) to be added to the covariance of positions and tensors; (0, 0) for none.
    """

    r_m: FloatArray
    tensor_m3: FloatArray
    reduced: FloatArray
    explained: float
    chi2: float
    scale: float
    local: float
    n_local: float
    n_outliers: int
    n_window: int
    iterations: int
    converged: bool
    bic: FloatArray
    excess: FloatArray = NO_EXCESS


def varpro(task: Task) -> Fit:
    """Separable least squares: the best targets of one scan."""
    power = power_map(task.sensor, task.y, task.w)
    first = without(task.sensor, task.w, spikes(task.sensor, power)) if task.robust else task.w
    if first is not task.w:
        power = power_map(task.sensor, task.y, first)
    best, hopeful = best_of_starts(task, first, start_points(task.sensor, power, task.ground))
    best, rest = refined(task, first, best)
    if task.most == 1 or not hopeful:
        return appraised(task.w, best, rest)
    return with_others(task, first, best, rest)


def best_of_starts(task: Task, w: FloatArray, starts: FloatArray) -> tuple[Local, bool]:
    """The best search, and whether it may be a target; one that cannot be is not refined."""
    sensor, y, ground, enough = task.sensor, task.y, task.ground, task.enough
    best, least, total, iterations = None, inf, 0.0, 0
    for start in starts:
        rough = rough_search(sensor, y, w, ground, start[None])
        rss, total = over_all(sensor, y, w, ground, rough)
        iterations += rough.iterations
        if best is None or rss < least:
            best, least = rough, rss
        if (least <= enough.rss or least <= enough.share * total) and total - least >= enough.gain:
            break
    assert best is not None
    best = best._replace(iterations=iterations, converged=False)
    if (total - least) * float((w > 0.0).sum()) < enough.hopeless * least:
        return best, False
    return fine_search(sensor, y, w, ground, best), True


def refined(task: Task, first: FloatArray, best: Local) -> tuple[Local, Residuals]:
    """A fit with the weights ``first``, its outliers weighed down if they are lonely; and its residuals."""
    sensor, y, w = task.sensor, task.y, task.w
    rest = residuals(sensor, y, w, first, best, task.robust)
    if not isfinite(rest.limit):
        return best, rest
    if is_structured(sensor, rest):
        return best, rest._replace(limit=inf)
    for _ in range(ROBUST_ROUNDS):
        weights = huber_weights(rest, w)
        best = fine_search(sensor, y, weights, task.ground, best)
        rest = residuals(sensor, y, w, weights, best, task.robust)
    return best, rest


def with_others(task: Task, first: FloatArray, best: Local, rest: Residuals) -> Fit:
    """As many targets as the Bayesian information criterion wants, from a fit of one."""
    sensor, y, ground = task.sensor, task.y, task.ground
    bic, iterations = np.full(MOST_TARGETS + 1, np.nan), best.iterations
    for n_targets in range(2, task.most + 1):
        # A target more must not be what an outlier needs: both numbers of targets are judged without them.
        cut = np.where(lonely_outliers(sensor, rest), 0.0, first) if task.robust else first
        bic[0], bic[n_targets - 1] = information_criteria(sensor, y, cut, ground, best)
        more = one_more(sensor, y, cut, ground, best, rest)
        iterations += more.iterations
        _, bic[n_targets] = information_criteria(sensor, y, cut, ground, more)
        # At the wall of the search a target is what else is wrong, and none that the data show.
        if not bic[n_targets] < bic[n_targets - 1] or not inside(more.r_m, ground.bounds):
            break
        best, rest = refined(task, first, more)
        iterations += best.iterations - more.iterations
    return appraised(task.w, best._replace(iterations=iterations), rest, bic)


def appraised(w: FloatArray, best: Local, rest: Residuals, bic: FloatArray | None = None) -> Fit:
    """What is told of a fit."""
    kept = np.abs(rest.e) <= rest.limit
    local, n_local = local_misfit(rest, kept)
    return Fit(
        best.r_m,
        best.tensor_m3,
        best.reduced,
        rest.explained,
        float((rest.e[kept] ** 2).sum()),
        rest.scale,
        local,
        n_local,
        int(kept.size - kept.sum()),
        best.n_window,
        best.iterations,
        best.converged,
        np.full(MOST_TARGETS + 1, np.nan) if bic is None else bic,
    )
