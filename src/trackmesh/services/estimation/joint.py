"""Joint probabilistic association: where tracks are close, each takes a weighted mean of the plots it may have made.

Which plot is of which track is not decided: the joint events (each plot of at most one track, each track at most one
plot) are weighed, and each track is updated by the marginal probabilities of its plots (Fortmann, Bar-Shalom and
Scheffe 1983; Bar-Shalom, Willett and Tian 2011, section 6.4). Summed over all events, two tracks that fly side by side
are drawn together; so of the events that differ only in who took which plot, the most probable alone counts (Blom and
Bloem 2000, track coalescence avoidance). Events are enumerated cluster by cluster; a cluster that is too large keeps
the one-to-one assignment.

A track takes the mean as one plot, whose covariance says how sure it is. So the ring of plots, exact replay and
registration need to know nothing of this. What is decided one to one stays so: which tracks took a plot at all, their
scores and their members.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.assignment import components
from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

MOST_TRACKS, MOST_PLOTS, MOST_EVENTS = 6, 10, 20_000
"""A cluster beyond any of these keeps the one-to-one assignment."""

NEARLY_ALL = 0.95
"""A plot with this share of the weight gives its range rate; else the mean has none."""

_LEAST_FOUND = 1e-6
_AS_GOOD = 1.0 - 1e-9


class Odds(NamedTuple):
    """What association is weighed against.

    Attributes:
        found: (m,) ln(Pd / (2 pi lambda)) of each plot, lambda the density of false plots where it is; empty where
            nothing is to be associated jointly.
        missed: ln(1 - Pd). A plot of a target is taken to be in its gate: the gate's own probability counts as one.
    """

    found: FloatArray
    missed: float


NO_ODDS = Odds(np.empty(0), 0.0)
"""Nothing is to be associated jointly."""


class Pairs(NamedTuple):
    """Gated pairs, as ``gating.gate`` gives them: track, plot and cost, each (k,)."""

    track: IntArray
    plot: IntArray
    cost: FloatArray


@kernel
def marginals(score: FloatArray, missed: float, most_events: int, permute: bool) -> FloatArray:
    """Probability of each plot for each track, over the joint events of a cluster.

    An event weighs the product of exp(score_ij) over its pairs and of exp(missed) over its tracks without a plot.

    Args:
        score: (n, m) ln(Pd / (2 pi lambda_j)) - cost_ij / 2, -inf where there is no pair; n + m not above 24.
        missed: ln(1 - Pd).
        most_events: so many are weighed at most.
        permute: all events count, as in the textbook; else, of those with the same tracks and the same plots, the one
            of greatest weight (and what equals it).

    Returns:
        (n, m + 1) rows that sum to one, first the probability of no plot; empty where there are more events.
    """
    n, m = score.shape
    weight = np.empty((n, m + 1))
    for a in range(n):
        top = missed
        for b in range(m):
            top = max(top, score[a, b])
        weight[a, 0] = np.exp(missed - top)
        for b in range(m):
            weight[a, b + 1] = np.exp(score[a, b] - top)
    beta = np.zeros((n, m + 1))
    least = np.zeros(1 if permute else 1 << (n + m))
    fits = _visit_events(weight, most_events, least, beta, False)
    if not fits:
        return beta[:0]
    _visit_events(weight, most_events, least, beta, True)
    return np.asarray(beta / beta[0].sum())


@kernel
def _visit_events(weight: FloatArray, most_events: int, least: FloatArray, beta: FloatArray, add: bool) -> bool:
    """Visit every event, depth first, a track a level; choice 0 is no plot, k the plot k - 1.

    First without ``add``: note in ``least`` what an event must weigh, by its tracks and plots. Then with it: add the
    weight of the others to ``beta`` (n, m + 1), choice by choice.

    Returns:
        False where there are more than ``most_events``.
    """
    n, choices = weight.shape
    choice, taken = np.full(n, -1), np.zeros(choices, np.bool_)
    product = np.ones(n + 1)
    events, a = 0, 0
    while a >= 0:
        if choice[a] > 0:
            taken[choice[a]] = False
        choice[a] += 1
        while choice[a] < choices and (taken[choice[a]] or weight[a, choice[a]] == 0.0):
            choice[a] += 1
        if choice[a] == choices:
            choice[a] = -1
            a -= 1
            continue
        product[a + 1] = product[a] * weight[a, choice[a]]
        if choice[a] > 0:
            taken[choice[a]] = True
        if a + 1 < n:
            a += 1
            continue
        events += 1
        if events > most_events:
            return False
        key = _tracks_and_plots(choice) if len(least) > 1 else 0
        if not add:
            if len(least) > 1:
                least[key] = max(least[key], product[n] * _AS_GOOD)
        elif product[n] >= least[key]:
            for b in range(n):
                beta[b, choice[b]] += product[n]
    return True


@kernel
def _tracks_and_plots(choice: IntArray) -> int:
    """Which tracks have a plot, and which plots are of a track, as bits of one number."""
    n, key = len(choice), 0
    for a in range(n):
        if choice[a] > 0:
            key |= (1 << a) | (1 << (n + choice[a] - 1))
    return key


@kernel
def soften(
    tracks: Mixture,
    t_s: FloatArray,
    pairs: Pairs,
    chosen: IntArray,
    first: BoolArray,
    plots: Plots,
    odds: Odds,
    tally: IntArray,
) -> Plots:
    """The plots as their tracks shall take them: in clusters of tracks that are ``first``, weighted means.

    A cluster is what hangs together by gated pairs. A track that is alone with its plot takes it as it is.

    Args:
        tracks: n predicted mixtures. t_s: (n,) their times. pairs: gated. first: (n,).
        chosen: (m,) track of each plot, one to one, or -1.
        plots: (m,). odds: of plots and misses.
        tally: (2,) counted up: clusters associated jointly, and clusters too large for that.
    """
    out = plots.copy()
    own = np.flatnonzero(first[pairs.track])
    if len(odds.found) == 0 or len(own) == 0:
        return out
    component = components(pairs.track[own], pairs.plot[own], len(t_s), len(plots))
    order = np.argsort(component, kind="mergesort")
    start = 0
    while start < len(order):
        stop = start + 1
        while stop < len(order) and component[order[stop]] == component[order[start]]:
            stop += 1
        if stop - start > 1:
            joined = _soften_cluster(tracks, t_s, pairs, own[order[start:stop]], chosen, plots, odds, out)
            tally[0 if joined else 1] += 1
        start = stop
    return out


@kernel
def _soften_cluster(
    tracks: Mixture,
    t_s: FloatArray,
    pairs: Pairs,
    cluster: IntArray,
    chosen: IntArray,
    plots: Plots,
    odds: Odds,
    out: Plots,
) -> bool:
    """Write the plots that the tracks of one cluster, given by its pairs, shall take; False where it is too large."""
    rows, columns = np.unique(pairs.track[cluster]), np.unique(pairs.plot[cluster])
    n, m = len(rows), len(columns)
    if n > MOST_TRACKS or m > MOST_PLOTS:
        return False
    score = np.full((n, m), -np.inf)
    for e in cluster:
        a, b = np.searchsorted(rows, pairs.track[e]), np.searchsorted(columns, pairs.plot[e])
        score[a, b] = odds.found[pairs.plot[e]] - 0.5 * pairs.cost[e]
    beta = marginals(score, odds.missed, MOST_EVENTS, False)
    if len(beta) == 0:
        return False
    near = plots[columns]
    for a in range(n):
        i = rows[a]
        for j in columns:
            if chosen[j] == i:
                dt_s = plots[j].t_s - t_s[i]
                write_mean(beta[a], near, tracks.x[i], tracks.P[i], tracks.mu[i], dt_s, out, j)
    return True


@kernel
def write_mean(
    beta: FloatArray, near: Plots, x: FloatArray, P: FloatArray, mu: FloatArray, dt_s: float, out: Plots, j: int
) -> None:
    """Write the plot that a track takes in place of several to ``out[j]``, at the time that stands there.

    It is such that the Kalman gain by it is that of probabilistic data association, and the covariance nearly so. With
    w_k = beta_k / (1 - beta_0), z = sum w_k z_k and m_2 = sum mu_h (P_h + (z - x_h)(z - x_h)^T),

        R = [sum w_k (R_k + (z_k - z)(z_k - z)^T) + beta_0 m_2] / (1 - beta_0):

    then S = P + R is (P + mean R + spread of the plots + beta_0 (z - x)(z - x)^T) / (1 - beta_0), one model taken.

    Args:
        beta: (m + 1,) of no plot and of each. near: (m,) plots.
        x, P, mu: (r, 4), (r, 4, 4), (r,) the track as predicted. dt_s: from then to the time in ``out[j]``.
    """
    t_s, found = out[j].t_s, max(1.0 - beta[0], _LEAST_FOUND)
    weight = beta[1:] / found
    place = _at_one_time(near, t_s, mu, x)
    e, n = (weight * place[:, 0]).sum(), (weight * place[:, 1]).sum()
    ee = en = nn = 0.0
    for k in range(len(near)):
        w, de, dn = weight[k], place[k, 0] - e, place[k, 1] - n
        ee += w * (near[k].R[0] + de * de)
        en += w * (near[k].R[1] + de * dn)
        nn += w * (near[k].R[2] + dn * dn)
    for h in range(len(mu)):
        w, de, dn = beta[0] * mu[h], e - x[h, 0] - dt_s * x[h, 2], n - x[h, 1] - dt_s * x[h, 3]
        ee += w * (P[h, 0, 0] + de * de)
        en += w * (P[h, 0, 1] + de * dn)
        nn += w * (P[h, 1, 1] + dn * dn)
    best = np.argmax(weight)
    out[j] = near[best]
    out[j].t_s = t_s
    out[j].z[0], out[j].z[1] = e, n
    out[j].R[0], out[j].R[1], out[j].R[2] = ee / found, en / found, nn / found
    out[j].range_rate_variance = near[best].range_rate_variance / found if weight[best] > NEARLY_ALL else np.inf


@kernel
def _at_one_time(plots: Plots, t_s: float, mu: FloatArray, x: FloatArray) -> FloatArray:
    """Positions (m, 2) of plots of one target, moved to a time: those of one look are not made at one moment."""
    place = np.empty((len(plots), 2))
    for k in range(len(plots)):
        place[k, 0], place[k, 1] = plots[k].z[0], plots[k].z[1]
        for h in range(len(mu)):
            for c in range(2):
                place[k, c] += (t_s - plots[k].t_s) * mu[h] * x[h, c + 2]
    return place
