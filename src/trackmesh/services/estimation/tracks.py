"""Many tracks: filters with a short memory of plots, so that late plots replay exactly.

Each row holds one track: the head (the filter at its last plot), the same filter some plots ago (the base), and the
ring of plots in between, in time order. Stored state moves only when a plot is fed; prediction is read-only, to any
time, per track. A late plot is put into the ring at its place and the head is filtered again from the base: the result
is what filtering in order would have given. A plot older than the base is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import imm, printed
from trackmesh.services.estimation.bank import Models, States, Work, make_states, make_work
from trackmesh.services.estimation.gating import Mixture, Strength, make_mixture, near
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import TURN
from trackmesh.services.estimation.plots import Plot, Plots, empty_plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Filters(NamedTuple):
    """The filters of n rows with rings of k plots; a row means nothing before ``begin``.

    Attributes:
        head: at the last plot. base: before the plots of the ring.
        ring, ring_n: (n, k) the plots; (n,) how many there are.
        t_s, mean: (n,), (n, 4) time of the head, mean position and velocity.
        spread: (n, 3) greatest variance of position, its covariance with velocity, and variance of velocity, for a
            quick bound of where the track can be.
        scratch, work: one state and the scratch of the kernels.
    """

    head: States
    base: States
    ring: Plots
    ring_n: IntArray
    t_s: FloatArray
    mean: FloatArray
    spread: FloatArray
    scratch: States
    work: Work


def make_filters(models: Models, n: int, k: int) -> Filters:
    """Filters with n empty rows and rings of k plots."""
    return Filters(
        head=make_states(models, n),
        base=make_states(models, n),
        ring=empty_plots((n, k)),
        ring_n=np.zeros(n, np.int64),
        t_s=np.zeros(n),
        mean=np.zeros((n, 4)),
        spread=np.zeros((n, 3)),
        scratch=make_states(models, 1),
        work=make_work(models),
    )


def join_rows(first: Filters, second: Filters) -> Filters:
    """The rows of both, with the scratch of the first."""
    rows: dict[str, Any] = {
        name: np.concatenate((getattr(first, name), getattr(second, name))) for name in Filters._fields[:7]
    }
    return first._replace(**rows)


@kernel
def begin(models: Models, f: Filters, rows: IntArray, plots: Plots, sigma_v_mps: float) -> None:
    """Start tracks in ``rows`` from single plots, see ``imm.begin``."""
    for k in range(len(rows)):
        i = rows[k]
        imm.begin(models, f.head[i], plots[k], sigma_v_mps)
        f.base[i] = f.head[i]
        f.ring_n[i] = 0
        _summarise(models, f, i)


@kernel
def feed(models: Models, f: Filters, rows: IntArray, plots: Plots) -> BoolArray:
    """Feed plot k to row ``rows[k]``, in order or late; False where the plot is older than the row's base."""
    taken = np.ones(len(rows), np.bool_)
    for k in range(len(rows)):
        i = rows[k]
        if plots[k].t_s < f.base[i].t_s:
            taken[k] = False
            continue
        in_order = plots[k].t_s >= f.head[i].t_s
        if f.ring_n[i] == f.ring.shape[1]:
            # The ring is full: its oldest plot moves into the base, or the new one where that is older still.
            oldest = plots[k] if plots[k].t_s < f.ring[i, 0].t_s else f.ring[i, 0]
            imm.filter_plot(models, f.base[i], oldest, f.work)
            if plots[k].t_s >= f.ring[i, 0].t_s:
                _drop_oldest(f, i)
                _insert(f, i, plots[k])
        else:
            _insert(f, i, plots[k])
        first = f.ring_n[i] - 1 if in_order else 0
        if not in_order:
            f.head[i] = f.base[i]
        for h in range(first, f.ring_n[i]):
            imm.filter_plot(models, f.head[i], f.ring[i, h], f.work)
        _summarise(models, f, i)
    return taken


@kernel
def predict(models: Models, f: Filters, rows: IntArray, t_s: FloatArray, out: Mixture) -> BoolArray:
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
    state = f.scratch[0]
    for k in range(len(rows)):
        i = rows[k]
        if t_s[k] >= f.head[i].t_s:
            f.scratch[0] = f.head[i]
        elif t_s[k] >= f.base[i].t_s:
            f.scratch[0] = f.base[i]
            for h in range(f.ring_n[i]):
                if f.ring[i, h].t_s > t_s[k]:
                    break
                imm.filter_plot(models, state, f.ring[i, h], f.work)
        else:
            known[k] = False
            continue
        imm.interact(models, state, t_s[k], f.work)
        imm.write_mixture(models, state, state.x, state.P, out, k)
    return known


@kernel
def refined(models: Models, f: Filters, rows: IntArray, lag: int, out: Mixture) -> FloatArray:
    """What is now known of rows ``lag`` plots ago (1 to ``models.lags``), written to ``out``; returns times (m,)."""
    t_s = np.empty(len(rows))
    for k in range(len(rows)):
        state = f.head[rows[k]]
        t_s[k] = state.y_t_s[lag - 1]
        imm.write_mixture(models, state, state.y[lag - 1], state.Y[lag - 1], out, k)
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
def _insert(f: Filters, i: int, plot: Plot) -> None:
    """Put a plot into the ring in time order; there must be room."""
    h = f.ring_n[i]
    while h > 0 and f.ring[i, h - 1].t_s > plot.t_s:
        f.ring[i, h] = f.ring[i, h - 1]
        h -= 1
    f.ring[i, h] = plot
    f.ring_n[i] += 1


@kernel
def _drop_oldest(f: Filters, i: int) -> None:
    for h in range(1, f.ring_n[i]):
        f.ring[i, h - 1] = f.ring[i, h]
    f.ring_n[i] -= 1


@kernel
def _summarise(models: Models, f: Filters, i: int) -> None:
    """Mean state and greatest variances of the head, for ``near``."""
    head, mu = f.head[i], f.work.log_likelihood
    f.t_s[i] = head.t_s
    imm.probabilities(models, head, mu)
    r = len(models.kind)
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


def strength(models: Models) -> Strength:
    """What the target of these models can do, two sigma of each model's own parameters."""
    turns = models.kind == TURN
    own = np.abs(models.numbers[:, 1]) + 2.0 * models.numbers[:, 2]
    return Strength(
        float(models.numbers[:, 0].max()), float(max(own[~turns], default=0.0)), float(max(own[turns], default=0.0))
    )


class ImmTracks:
    """The filters of a layer of tracks: interacting multiple models with rings."""

    def __init__(self, models: Models, rows: int, ring: int, sigma_v_mps: float) -> None:
        self.models = models
        self.filters = make_filters(models, rows, ring)
        self._ring = ring
        self._sigma_v_mps = sigma_v_mps
        self._strength = strength(models)

    @property
    def t_s(self) -> FloatArray:
        """(n,) times of the last plots."""
        return self.filters.t_s

    @property
    def oldest_s(self) -> FloatArray:
        """(n,) times back to which a row can answer and take late plots."""
        return np.asarray(self.filters.base["t_s"])

    @property
    def mean(self) -> FloatArray:
        """(n, 4) states at the last plots."""
        return self.filters.mean

    @property
    def repairs(self) -> int:
        """How often a covariance that was none had to be replaced."""
        return int(self.filters.work.repairs)

    def begin(self, rows: IntArray, plots: Plots) -> None:
        """Start tracks in rows, from one plot each."""
        begin(self.models, self.filters, rows, plots, self._sigma_v_mps)

    def feed(self, rows: IntArray, plots: Plots) -> BoolArray:
        """Feed plot k to row k; False where it comes too late."""
        return feed(self.models, self.filters, rows, plots)

    def feed_from(self, source: int, target: int) -> None:
        """Feed the plots that row ``source`` remembers to row ``target``."""
        plots = self.remembered(source)
        feed(self.models, self.filters, np.full(len(plots), target), plots)

    def remembered(self, row: int) -> Plots:
        """The last plots of a row, in order of time."""
        return self.filters.ring[row, : self.filters.ring_n[row]].copy()

    def move_plots(self, sensor: int, move: Callable[[FloatArray], FloatArray]) -> None:
        """Move the remembered plots of a sensor, positions (m, 2) to (m, 2), and filter them again from the base."""
        f = self.filters
        there = np.arange(f.ring.shape[1]) < f.ring_n[:, None]
        ours = there & (f.ring["sensor"] == sensor)
        if not ours.any():
            return
        f.ring["z"][ours] = move(f.ring["z"][ours])
        rows = np.flatnonzero(ours.any(axis=1))
        row, place = np.nonzero(there[rows])
        plots = f.ring[rows[row], place]
        f.head[rows] = f.base[rows]
        f.ring_n[rows] = 0
        feed(self.models, f, rows[row], plots)

    def near(self, rows: IntArray, plots: Plots, limit: float) -> IntArray:
        """The rows that may have a plot in their gate."""
        f = self.filters
        return near(f.mean, f.spread, f.t_s, rows, plots, limit, self._strength)

    def predict(self, rows: IntArray, t_s: FloatArray) -> tuple[Mixture, BoolArray]:
        """Predictions of rows to their times, and which of them are known."""
        out = make_mixture(len(rows), len(self.models.kind))
        known = predict(self.models, self.filters, rows, t_s, out)
        return out, known

    def estimates(self, mixture: Mixture) -> tuple[FloatArray, FloatArray]:
        """One mean (m, 4) and covariance (m, 4, 4) of each mixture."""
        return estimates(self.models, mixture)

    def refined(self, rows: IntArray, lag: int) -> tuple[Mixture, FloatArray]:
        """What is now known of rows ``lag`` plots ago, and when that was."""
        out = make_mixture(len(rows), len(self.models.kind))
        t_s = refined(self.models, self.filters, rows, lag, out)
        return out, t_s

    def grow(self, rows: int) -> None:
        """Add empty rows."""
        self.filters = join_rows(self.filters, make_filters(self.models, rows, self._ring))
