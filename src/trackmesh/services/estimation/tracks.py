"""Many tracks: filters with a short memory of plots, so that late plots replay exactly.

Each row holds one track: the head (the filter at its last plot), the same filter some plots ago (the base), the ring of
plots in between, in time order, and the filter half way (mid). Stored state moves only when a plot is fed; prediction
is read-only, to any time, per track. A late plot is put into the ring at its place and the head is filtered again from
the last stored state before it: the result is what filtering in order would have given. A full ring loses its older
half, and mid becomes the base; so at least half a ring of plots can always be replayed, and no plot is filtered twice
unless one came late. A plot older than the base is refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import gating, imm, lags, printed
from trackmesh.services.estimation.bank import Models, States, as_array, make_states, make_work
from trackmesh.services.estimation.gating import Mixture, Strength
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.joint import Odds, Pairs, soften
from trackmesh.services.estimation.plots import Plot, Plots, empty_plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Filters(NamedTuple):
    """The filters of n rows with rings of k plots; a row means nothing before ``begin``.

    Attributes:
        models, work: (1,) the models and the scratch of the kernels, as arrays of one record, which compiled functions
            take faster than a record.
        head: at the last plot. base: before the plots of the ring. mid: after the first ``mid_n`` plots of the ring;
            it means nothing where that is 0.
        ring, ring_n: (n, k) the plots; (n,) how many there are, always less than k.
        t_s, mean: (n,), (n, 4) time of the head, mean position and velocity.
        spread: (n, 3) greatest variance of position, its covariance with velocity, and variance of velocity, for a
            quick bound of where the track can be.
        scratch: some states that mean nothing between two calls.
    """

    models: npt.NDArray[Any]
    work: npt.NDArray[Any]
    head: States
    mid: States
    base: States
    ring: Plots
    ring_n: IntArray
    mid_n: IntArray
    t_s: FloatArray
    mean: FloatArray
    spread: FloatArray
    scratch: States


SCRATCH_ROWS = 4096
"""So many predictions are kept until their plots are chosen; those of more tracks are made twice."""


def make_filters(models: Models, n: int, k: int) -> Filters:
    """Filters with n empty rows and rings of k plots."""
    return Filters(
        models=as_array(models),
        work=as_array(make_work(models)),
        head=make_states(models, n),
        mid=make_states(models, n),
        base=make_states(models, n),
        ring=empty_plots((n, k)),
        ring_n=np.zeros(n, np.int64),
        mid_n=np.zeros(n, np.int64),
        t_s=np.zeros(n),
        mean=np.zeros((n, 4)),
        spread=np.zeros((n, 3)),
        scratch=make_states(models, min(n, SCRATCH_ROWS)),
    )


def with_more_rows(f: Filters, more: int) -> Filters:
    """Filters with so many empty rows behind those there are; the models and the work are shared.

    Only pages that hold something are touched: among a thousand tracks, zeros that nobody needs yet would cost more
    than a batch.
    """
    names = [name for name in Filters._fields if name not in ("models", "work", "scratch")]
    rows: dict[str, Any] = {name: _longer(getattr(f, name), more) for name in names}
    scratch = f.scratch[:SCRATCH_ROWS]
    rows["scratch"] = _longer(scratch, min(more, SCRATCH_ROWS - len(scratch)))
    return f._replace(**rows)


def _longer(array: npt.NDArray[Any], more: int) -> npt.NDArray[Any]:
    longer = np.zeros((len(array) + more, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


@kernel
def begin(f: Filters, rows: IntArray, plots: Plots, sigma_v_mps: float) -> None:
    """Start tracks in ``rows`` from single plots, see ``imm.begin``."""
    for k in range(len(rows)):
        i = rows[k]
        imm.begin(f.models[0], f.head[i], plots[k], sigma_v_mps)
        f.base[i] = f.head[i]
        f.ring_n[i] = f.mid_n[i] = 0
        _summarise(f, i)


@kernel
def begin_at(f: Filters, rows: IntArray, x: FloatArray, P: FloatArray) -> None:
    """Let filters that ``begin`` has just started stand at known states x (n, 4), P (n, 4, 4) in every model."""
    for k in range(len(rows)):
        i = rows[k]
        for j in range(len(f.models[0].kind)):
            for a in range(4):
                f.head[i].x[j, a] = x[k, a]
                for b in range(4):
                    f.head[i].P[j, a, b] = P[k, a, b]
        lags.renew(f.head[i])
        f.base[i] = f.head[i]
        _summarise(f, i)


@kernel
def feed(f: Filters, rows: IntArray, plots: Plots) -> BoolArray:
    """Feed plot k to row ``rows[k]``, in order or late; False where the plot is older than the row's base."""
    taken = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        taken[k] = _feed_one(f, rows[k], plots[k])
    return taken


@kernel
def _feed_one(f: Filters, i: int, plot: Plot) -> bool:
    if plot.t_s < f.base[i].t_s:
        return False
    in_order = plot.t_s >= f.head[i].t_s
    place = _insert(f, i, plot)
    if in_order:
        imm.filter_plot(f.models[0], f.head[i], plot, f.work[0])
    else:
        _replay(f, i, place)
    _after_feeding(f, i)
    return True


@kernel
def _replay(f: Filters, i: int, place: int) -> None:
    """Filter the head again, from the last stored state before the plot that was put into the ring at ``place``."""
    from_mid = place >= f.mid_n[i] > 0
    f.head[i] = f.mid[i] if from_mid else f.base[i]
    for h in range(f.mid_n[i] if from_mid else 0, f.ring_n[i]):
        imm.filter_plot(f.models[0], f.head[i], f.ring[i, h], f.work[0])
        if h == f.mid_n[i] - 1:
            f.mid[i] = f.head[i]


@kernel
def _after_feeding(f: Filters, i: int) -> None:
    """Keep the state half way, and move the base on where the ring is full."""
    size = f.ring.shape[1]
    if f.ring_n[i] == size:
        f.base[i] = f.mid[i]
        dropped = f.mid_n[i]
        for h in range(dropped, size):
            f.ring[i, h - dropped] = f.ring[i, h]
        f.ring_n[i] = size - dropped
        f.mid_n[i] = 0
    if f.mid_n[i] == 0 and f.ring_n[i] >= size // 2:
        f.mid[i] = f.head[i]
        f.mid_n[i] = f.ring_n[i]
    _summarise(f, i)


@kernel
def predict(f: Filters, rows: IntArray, t_s: FloatArray, out: Mixture) -> BoolArray:
    """Prediction of rows to their times, model by model, without changing them.

    A time before a row's last plot is answered by filtering its ring up to that time; before its base there is no
    answer.

    Args:
        rows: (m,) rows. t_s: (m,) times.
        out: of m rows and r models, written.

    Returns:
        (m,) whether there is an answer.
    """
    known = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        known[k] = _predict_one(f, rows[k], t_s[k], 0, out, k)
    return known


@kernel
def estimate(f: Filters, rows: IntArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Predictions as ``estimates`` gives them: means (m, 4), covariances (m, 4, 4), model probabilities (m, r).

    A row that has no answer at its time is all zeros.
    """
    m, r = len(rows), len(f.models[0].kind)
    mean, covariance, probability = np.zeros((m, 4)), np.zeros((m, 4, 4)), np.zeros((m, r))
    for k in range(m):
        if not _predict_state(f, rows[k], t_s[k], 0):
            continue
        state = f.scratch[0]
        imm.probabilities(f.models[0], state, probability[k])
        if f.models[0].printed:
            printed.product_of_gaussians(state.x, state.P, mean[k], covariance[k])
        else:
            imm.moment_match(state.x, state.P, probability[k], mean[k], covariance[k])
    return mean, covariance, probability


@kernel
def _predict_one(f: Filters, i: int, t_s: float, place: int, out: Mixture, k: int) -> bool:
    """As ``_predict_state``, and write it as mixture ``k``."""
    if not _predict_state(f, i, t_s, place):
        return False
    state = f.scratch[place]
    imm.write_mixture(f.models[0], state, state.x, state.P, out, k)
    return True


@kernel
def _predict_state(f: Filters, i: int, t_s: float, place: int) -> bool:
    """Predict row ``i`` to a time into ``scratch[place]``; False before its base."""
    if t_s >= f.head[i].t_s:
        f.scratch[place] = f.head[i]
    elif t_s >= f.base[i].t_s:
        from_mid = f.mid_n[i] > 0 and t_s >= f.mid[i].t_s
        f.scratch[place] = f.mid[i] if from_mid else f.base[i]
        for h in range(f.mid_n[i] if from_mid else 0, f.ring_n[i]):
            if f.ring[i, h].t_s > t_s:
                break
            imm.filter_plot(f.models[0], f.scratch[place], f.ring[i, h], f.work[0])
    else:
        return False
    imm.interact(f.models[0], f.scratch[place], t_s, f.work[0])
    return True


@kernel
def associate(
    f: Filters,
    rows: IntArray,
    first: BoolArray,
    plots: Plots,
    limit: float,
    strength: Strength,
    odds: Odds,
    tally: IntArray,
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Find out which row each plot is of, one to one, and feed it to that row.

    Args:
        rows: rows to choose from. first: (all rows,) those that choose before the others.
        plots: (m,). limit: of the gate. strength: of the targets.
        odds: unless empty, rows of ``first`` that are close are fed weighted means of plots (see ``joint``).
        tally: (2,) counted up by ``joint.soften``.

    Returns:
        (m,) the row of each plot or -1, the cost of the pair (see ``gating.gate``), and whether the row could still
        take the plot.
    """
    m = len(plots)
    row, cost, fed = np.full(m, -1, np.int64), np.zeros(m), np.zeros(m, np.bool_)
    near = gating.near(f.mean, f.spread, f.t_s, rows, plots, limit, strength)
    times = gating.nearest_times(f.mean[near], f.t_s[near], plots)
    r = len(f.models[0].kind)
    n = len(near)
    out = Mixture(np.empty((n, r, 4)), np.empty((n, r, 4, 4)), np.empty((n, r)))
    count = 0
    for k in range(n):
        place = count if count < len(f.scratch) else 0
        if _predict_one(f, near[k], times[k], place, out, count):
            near[count], times[count] = near[k], times[k]
            count += 1
    near, times = near[:count], times[:count]
    ahead = Mixture(out.x[:count], out.P[:count], out.mu[:count])
    pairs = Pairs(*gating.gate(ahead, times, plots, limit))
    chosen = gating.choose_among(pairs.track, pairs.plot, pairs.cost, first[near], cost)
    plots = soften(ahead, times, pairs, chosen, first[near], plots, odds, tally)
    # Where a transition matrix is learnt from, or the past refined, an update needs more than the predicted state.
    direct = _predicted_state_is_enough(f)
    for j in range(m):
        k = chosen[j]
        if k < 0:
            continue
        i = near[k]
        row[j] = i
        same = plots[j].t_s == times[k] and times[k] >= f.head[i].t_s
        if direct and same and k < len(f.scratch) and count <= len(f.scratch):
            dt_s = plots[j].t_s - f.head[i].t_s
            _insert(f, i, plots[j])
            f.head[i] = f.scratch[k]
            imm.update(f.models[0], f.head[i], plots[j], dt_s, f.work[0])
            _after_feeding(f, i)
            fed[j] = True
        else:
            fed[j] = _feed_one(f, i, plots[j])
    return row, cost, fed


@kernel
def _predicted_state_is_enough(f: Filters) -> bool:
    models = f.models[0]
    return models.printed == 0 and models.lags == 0 and bool(np.isinf(models.prior_count).all())


@kernel
def refined(f: Filters, rows: IntArray, lag: int, out: Mixture) -> FloatArray:
    """What is now known of rows ``lag`` plots ago (1 to ``models.lags``), written to ``out``; returns times (m,)."""
    t_s = np.empty(len(rows))
    for k in range(len(rows)):
        state = f.head[rows[k]]
        t_s[k] = state.y_t_s[lag - 1]
        imm.write_mixture(f.models[0], state, state.y[lag - 1], state.Y[lag - 1], out, k)
    return t_s


@kernel
def estimates(models: Models, m: Mixture) -> tuple[FloatArray, FloatArray]:
    """One estimate of each mixture over position and velocity: means (m, 4) and covariances (m, 4, 4).

    Moment-matched; the printed TV-IMM takes the product of its models instead.
    """
    n = len(m.mu)
    mean, covariance = np.empty((n, 4)), np.empty((n, 4, 4))
    for k in range(n):
        if models.printed:
            printed.product_of_gaussians(m.x[k], m.P[k], mean[k], covariance[k])
        else:
            imm.moment_match(m.x[k], m.P[k], m.mu[k], mean[k], covariance[k])
    return mean, covariance


@kernel
def _insert(f: Filters, i: int, plot: Plot) -> int:
    """Put a plot into the ring in time order, behind those of its time; its place."""
    h = int(f.ring_n[i])
    while h > 0 and f.ring[i, h - 1].t_s > plot.t_s:
        f.ring[i, h] = f.ring[i, h - 1]
        h -= 1
    f.ring[i, h] = plot
    f.ring_n[i] += 1
    return h


@kernel
def _summarise(f: Filters, i: int) -> None:
    """Mean state and greatest variances of the head, for ``near``."""
    head, mu = f.head[i], f.work[0].log_likelihood
    f.t_s[i] = head.t_s
    imm.probabilities(f.models[0], head, mu)
    r = len(f.models[0].kind)
    for a in range(4):
        f.mean[i, a] = 0.0
        for j in range(r):
            f.mean[i, a] += mu[j] * head.x[j, a]
    position = cross = velocity = 0.0
    for j in range(r):
        de, dn = head.x[j, 0] - f.mean[i, 0], head.x[j, 1] - f.mean[i, 1]
        dve, dvn = head.x[j, 2] - f.mean[i, 2], head.x[j, 3] - f.mean[i, 3]
        P = head.P[j]
        position = max(position, P[0, 0] + P[1, 1] + de * de + dn * dn)
        cross = max(cross, abs(P[0, 2]) + abs(P[1, 3]))
        velocity = max(velocity, P[2, 2] + P[3, 3] + dve * dve + dvn * dvn)
    f.spread[i, 0], f.spread[i, 1], f.spread[i, 2] = position, cross, velocity
