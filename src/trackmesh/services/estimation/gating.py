"""Which plots can belong to which tracks: a circle around each for a first look, then the ellipses of its models."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.assignment import assign
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_SCORE_AT_ZERO = 60.0
_CHOOSES_FIRST = 200.0
_LEAST_SCORE = 0.01


class Mixture(NamedTuple):
    """Position and velocity of m tracks, model by model: (m, r, 4), (m, r, 4, 4), probabilities (m, r)."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray


def make_mixture(m: int, r: int) -> Mixture:
    """Room for m mixtures of r models."""
    return Mixture(np.empty((m, r, 4)), np.empty((m, r, 4, 4)), np.empty((m, r)))


class Strength(NamedTuple):
    """What a target can do: acceleration noise q in m^2/s^3, acceleration, turn rate."""

    q: float
    acceleration_mps2: float
    turn_rate_radps: float


@kernel
def near(
    mean: FloatArray,
    spread: FloatArray,
    t_s: FloatArray,
    rows: IntArray,
    plots: Plots,
    limit: float,
    strength: Strength,
) -> IntArray:
    """The rows that may have a plot in their gate: a generous circle around each touches the plots' bounding box.

    Args:
        mean, t_s: (n, 4), (n,) of all tracks, at their last plots.
        spread: (n, 3) greatest variance of position, its covariance with velocity, and variance of velocity.
        rows: those asked for.
    """
    east0 = north0 = early = np.inf
    east1 = north1 = late = -np.inf
    r_max = 0.0
    for j in range(len(plots)):
        plot = plots[j]
        east0, east1 = min(east0, plot.z[0]), max(east1, plot.z[0])
        north0, north1 = min(north0, plot.z[1]), max(north1, plot.z[1])
        early, late = min(early, plot.t_s), max(late, plot.t_s)
        r_max = max(r_max, plot.R[0] + plot.R[2])
    chosen = np.empty(len(rows), np.int64)
    n = 0
    for i in rows:
        dt = (early + late) / 2.0 - t_s[i]
        span = abs(dt) + (late - early) / 2.0
        speed = np.hypot(mean[i, 2], mean[i, 3])
        drift = 0.5 * span * span * max(strength.acceleration_mps2, strength.turn_rate_radps * speed)
        variance = spread[i, 0] + 2.0 * span * spread[i, 1] + span * span * spread[i, 2] + strength.q * span**3
        variance += drift * drift
        reach = np.sqrt(limit * (variance + r_max)) + speed * (late - early) / 2.0
        if dt < 0.0:
            reach += speed * -dt
        e, north = mean[i, 0] + dt * mean[i, 2], mean[i, 1] + dt * mean[i, 3]
        if east0 - reach <= e <= east1 + reach and north0 - reach <= north <= north1 + reach:
            chosen[n] = i
            n += 1
    return chosen[:n]


@kernel
def gate(
    tracks: Mixture,
    t_s: FloatArray,
    plots: Plots,
    limit: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """All pairs of track and plot within the gate of at least one model, with the cost of the pair.

    A pair is inside when D_j = nu_j^T S_j^-1 nu_j <= limit for some model j, S_j = P_j + R; a target that turns is then
    not lost because the quiet model is sure of itself. The cost is that of the whole mixture,
    -2 ln sum_j mu_j |S_j|^-1/2 exp(-D_j/2), which for one model is D + ln|S|. Plots are sorted by north and windowed.

    Each track is compared with a plot at the plot's own time, moved there by its velocity (the covariance is not: the
    times differ by less than a scan).

    Args:
        tracks: n predicted mixtures. t_s: (n,) their times.
        plots: (m,); their range rates are not looked at.
        limit: largest squared distance.

    Returns:
        track index, plot index, cost of each pair, in order of track, then north.
    """
    x, P, mu = tracks
    n, r = mu.shape
    m = len(plots)
    values = np.empty(m)
    r_max = 0.0
    late, early = -np.inf, np.inf
    for j in range(m):
        plot = plots[j]
        values[j] = plot.z[1]
        r_max = max(r_max, plot.R[0], plot.R[2])
        late, early = max(late, plot.t_s), min(early, plot.t_s)
    order = np.argsort(values)
    # Side by side in memory: the scan of a window touches nothing else.
    north = values[order]
    east = np.empty(m)
    for k in range(m):
        east[k] = plots[order[k]].z[0]
    size = 8 * (n + m) + 64
    ii: IntArray = np.empty(size, np.int64)
    jj: IntArray = np.empty(size, np.int64)
    cost: FloatArray = np.empty(size)
    count = 0
    for i in range(n):
        span = max(abs(late - t_s[i]), abs(early - t_s[i]))
        low = west = np.inf
        high = far_east = -np.inf
        for a in range(r):
            reach = np.sqrt(limit * (P[i, a, 1, 1] + r_max)) + span * abs(x[i, a, 3])
            low, high = min(low, x[i, a, 1] - reach), max(high, x[i, a, 1] + reach)
            reach = np.sqrt(limit * (P[i, a, 0, 0] + r_max)) + span * abs(x[i, a, 2])
            west, far_east = min(west, x[i, a, 0] - reach), max(far_east, x[i, a, 0] + reach)
        k = int(np.searchsorted(north, low))
        while k < m and north[k] <= high:
            if east[k] < west or east[k] > far_east:
                k += 1
                continue
            j = order[k]
            k += 1
            value = mixture_cost(x[i], P[i], mu[i], plots[j].z, plots[j].R, plots[j].t_s - t_s[i], limit)
            if np.isinf(value):
                continue
            if count == size:
                size *= 2
                ii, jj, cost = _grown(ii, size), _grown(jj, size), _grown(cost, size)
            ii[count], jj[count], cost[count] = i, j, value
            count += 1
    return ii[:count], jj[:count], cost[:count]


@kernel
def choose(
    tracks: Mixture, t_s: FloatArray, first: BoolArray, plots: Plots, limit: float, cost: FloatArray
) -> IntArray:
    """The track of each plot, or -1: one to one, the cheapest in sum, and as many pairs with ``first`` as there can be.

    Args:
        tracks: n predicted mixtures. t_s: (n,) their times. first: (n,) tracks that choose before the others.
        plots: (m,). limit: of the gate.
        cost: (m,) written: that of the chosen pairs.
    """
    i, j, pair_cost = gate(tracks, t_s, plots, limit)
    return choose_among(i, j, pair_cost, first, cost)


@kernel
def choose_among(i: IntArray, j: IntArray, pair_cost: FloatArray, first: BoolArray, cost: FloatArray) -> IntArray:
    """As ``choose``, among pairs that are known: track, plot and cost, each (k,), as ``gate`` gives them."""
    score = np.empty(len(i))
    for e in range(len(i)):
        score[e] = max(_SCORE_AT_ZERO - pair_cost[e], _LEAST_SCORE)
        if first[i[e]]:
            score[e] += _CHOOSES_FIRST
    chosen = assign(i, j, score, len(first), len(cost))
    for e in range(len(i)):
        if chosen[j[e]] == i[e]:
            cost[j[e]] = pair_cost[e]
    return chosen


@kernel
def mixture_cost(
    x: FloatArray, P: FloatArray, mu: FloatArray, z: FloatArray, R: FloatArray, dt_s: float, limit: float
) -> float:
    """Cost of one plot for one track (see ``gate``), infinite outside every model's gate."""
    r = len(mu)
    inside = False
    top, total = -np.inf, 0.0
    for a in range(r):
        v0 = z[0] - x[a, 0] - dt_s * x[a, 2]
        v1 = z[1] - x[a, 1] - dt_s * x[a, 3]
        s00, s01, s11 = P[a, 0, 0] + R[0], P[a, 0, 1] + R[1], P[a, 1, 1] + R[2]
        det = s00 * s11 - s01 * s01
        if not det > 0.0:
            continue
        distance = (v0 * v0 * s11 - 2.0 * v0 * v1 * s01 + v1 * v1 * s00) / det
        inside = inside or distance <= limit
        log_weight = np.log(max(mu[a], 1e-300)) - 0.5 * (distance + np.log(det))
        if log_weight > top:
            total = total * np.exp(top - log_weight) + 1.0
            top = log_weight
        else:
            total += np.exp(log_weight - top)
    return -2.0 * (top + np.log(total)) if inside else np.inf


@kernel
def nearest_times(mean: FloatArray, t_s: FloatArray, plots: Plots) -> FloatArray:
    """The time of the plot nearest to each row, with the row moved to the plot's time: when the sensor looked at it.

    Args:
        mean: (n, 4) states. t_s: (n,) their times.
    """
    out = np.empty(len(mean))
    together = True
    for j in range(len(plots)):
        together = together and plots[j].t_s == plots[0].t_s
    if together:
        out[:] = plots[0].t_s
        return out
    for i in range(len(mean)):
        best = np.inf
        for j in range(len(plots)):
            dt = plots[j].t_s - t_s[i]
            de = plots[j].z[0] - mean[i, 0] - dt * mean[i, 2]
            dn = plots[j].z[1] - mean[i, 1] - dt * mean[i, 3]
            if de * de + dn * dn < best:
                best, out[i] = de * de + dn * dn, plots[j].t_s
    return out


@kernel
def _grown(array: npt.NDArray[Any], size: int) -> npt.NDArray[Any]:
    out = np.empty(size, array.dtype)
    out[: len(array)] = array
    return out
