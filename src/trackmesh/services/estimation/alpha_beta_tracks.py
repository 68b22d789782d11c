"""Many tracks by the alpha-beta filter: a fifth of the cost of the cheapest IMM, for very many local tracks.

Gains are those of ``alpha_beta.combined_gains``, by the manoeuvring index of the plot at hand, the same in both
coordinates. The covariance is the exact one of these gains for the model they suppose, with the full covariance of each
plot. Plots must come in order of time: a late one is refused.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import gating
from trackmesh.services.estimation.alpha_beta import combined_gains, manoeuvring_index
from trackmesh.services.estimation.gating import Mixture, Strength, make_mixture
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.joint import NO_ODDS, Odds
from trackmesh.services.estimation.plots import Move, Plot, Plots, empty_plots, make_plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Rows(NamedTuple):
    """Tracks at their last plots: x (n, 4), P (n, 4, 4), number of plots k (n,), t_s (n,), spread (n, 3)."""

    x: FloatArray
    P: FloatArray
    k: IntArray
    t_s: FloatArray
    spread: FloatArray


def make_rows(n: int) -> Rows:
    """Empty rows."""
    return Rows(np.zeros((n, 4)), np.zeros((n, 4, 4)), np.zeros(n, np.int64), np.zeros(n), np.zeros((n, 3)))


@kernel
def predict(rows: Rows, i: int, dt_s: float, sigma_v_mps2: float, x: FloatArray, P: FloatArray) -> None:
    """Write the prediction of a row over ``dt_s`` >= 0: x (4,), P (4, 4).

    Constant velocity with an acceleration that is constant over the interval: Q = sigma_v^2 G G^T, G = [T^2/2, T].
    """
    q = sigma_v_mps2 * sigma_v_mps2 * dt_s * dt_s
    for a in range(2):
        x[a], x[a + 2] = rows.x[i, a] + dt_s * rows.x[i, a + 2], rows.x[i, a + 2]
        for b in range(2):
            same = 1.0 if a == b else 0.0
            vv = rows.P[i, a + 2, b + 2]
            P[a, b] = (
                rows.P[i, a, b]
                + dt_s * (rows.P[i, a, b + 2] + rows.P[i, a + 2, b])
                + dt_s * dt_s * (vv + same * q / 4.0)
            )
            P[a, b + 2] = rows.P[i, a, b + 2] + dt_s * (vv + same * q / 2.0)
            P[a + 2, b] = rows.P[i, a + 2, b] + dt_s * (vv + same * q / 2.0)
            P[a + 2, b + 2] = vv + same * q


@kernel
def update(rows: Rows, i: int, plot: Plot, alpha: float, rate: float, x: FloatArray, P: FloatArray) -> None:
    """Update a row from its prediction x, P: x + K (z - H x), (I - K H) P (I - K H)^T + K R K^T, K = [alpha I, rate I].

    Args:
        rate: beta / T.
    """
    for a in range(2):
        rows.x[i, a] = x[a] + alpha * (plot.z[a] - x[a])
        rows.x[i, a + 2] = x[a + 2] + rate * (plot.z[a] - x[a])
    keep = 1.0 - alpha
    for a in range(2):
        for b in range(2):
            r = plot.R[a + b]
            rows.P[i, a, b] = keep * keep * P[a, b] + alpha * alpha * r
            rows.P[i, a, b + 2] = keep * (P[a, b + 2] - rate * P[a, b]) + alpha * rate * r
            rows.P[i, b + 2, a] = rows.P[i, a, b + 2]
            cross = rate * (P[a, b + 2] + P[b, a + 2])
            rows.P[i, a + 2, b + 2] = P[a + 2, b + 2] - cross + rate * rate * (P[a, b] + r)


@kernel
def _summarise(rows: Rows, i: int) -> None:
    P = rows.P[i]
    rows.spread[i, 0] = P[0, 0] + P[1, 1]
    rows.spread[i, 1] = abs(P[0, 2]) + abs(P[1, 3])
    rows.spread[i, 2] = P[2, 2] + P[3, 3]


@kernel
def _begin(rows: Rows, where: IntArray, plots: Plots, sigma_v_mps: float) -> None:
    for k in range(len(where)):
        i, plot = where[k], plots[k]
        for a in range(2):
            rows.x[i, a], rows.x[i, a + 2] = plot.z[a], 0.0
            for b in range(2):
                rows.P[i, a, b] = plot.R[a + b]
                rows.P[i, a, b + 2] = rows.P[i, a + 2, b] = 0.0
                rows.P[i, a + 2, b + 2] = sigma_v_mps * sigma_v_mps if a == b else 0.0
        rows.k[i], rows.t_s[i] = 1, plot.t_s
        _summarise(rows, i)


@kernel
def _feed(rows: Rows, where: IntArray, plots: Plots, alpha: FloatArray, beta: FloatArray, sigma: float) -> BoolArray:
    taken = np.ones(len(where), np.bool_)
    x, P = np.empty(4), np.empty((4, 4))
    for k in range(len(where)):
        i, plot = where[k], plots[k]
        dt_s = plot.t_s - rows.t_s[i]
        if dt_s < 0.0:
            taken[k] = False
            continue
        predict(rows, i, dt_s, sigma, x, P)
        update(rows, i, plot, alpha[k], beta[k] / dt_s if dt_s > 0.0 else 0.0, x, P)
        rows.t_s[i] = plot.t_s
        rows.k[i] += 1 if dt_s > 0.0 else 0
        _summarise(rows, i)
    return taken


@kernel
def _predict(rows: Rows, where: IntArray, t_s: FloatArray, sigma: float, out: Mixture) -> BoolArray:
    known = np.ones(len(where), np.bool_)
    for k in range(len(where)):
        i = where[k]
        known[k] = t_s[k] >= rows.t_s[i]
        out.mu[k, 0] = 1.0
        predict(rows, i, max(t_s[k] - rows.t_s[i], 0.0), sigma, out.x[k, 0], out.P[k, 0])
    return known


class AlphaBetaTracks:
    """The filters of a layer of tracks: alpha-beta, one model, no memory of plots."""

    repairs = 0

    def __init__(self, rows: int, sigma_v_mps: float, acceleration_mps2: float) -> None:
        self._rows = make_rows(rows)
        self._sigma_v_mps = sigma_v_mps
        self._acceleration_mps2 = acceleration_mps2
        self._strength = Strength(0.0, 3.0 * acceleration_mps2, 0.0)

    @property
    def t_s(self) -> FloatArray:
        """(n,) times of the last plots."""
        return self._rows.t_s

    @property
    def oldest_s(self) -> FloatArray:
        """(n,) times back to which a row can answer: those of the last plots."""
        return self.t_s

    @property
    def mean(self) -> FloatArray:
        """(n, 4) states at the last plots."""
        return self._rows.x

    def figures(self) -> dict[str, int]:
        """Nothing to tell."""
        return {}

    def begin(self, rows: IntArray, plots: Plots) -> None:
        """Start tracks in rows, from one plot each."""
        _begin(self._rows, rows, plots, self._sigma_v_mps)

    def begin_at(self, rows: IntArray, x: FloatArray, P: FloatArray, t_s: float) -> None:
        """Start tracks in rows, each from a state (4,) and a covariance (4, 4) at a time."""
        R = np.stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]], axis=1)
        self.begin(rows, make_plots(x[:, :2], R, t_s))
        own = self._rows
        own.x[rows], own.P[rows] = x, P
        own.spread[rows, 1] = np.abs(P[:, 0, 2]) + np.abs(P[:, 1, 3])
        own.spread[rows, 2] = P[:, 2, 2] + P[:, 3, 3]

    def feed(self, rows: IntArray, plots: Plots) -> BoolArray:
        """Feed plot k to row k, no row twice; False where it comes too late."""
        dt_s = np.maximum(plots["t_s"] - self._rows.t_s[rows], 0.0)
        R, P = plots["R"], self._rows.P[rows]
        sigma_m = np.sqrt((R[:, 0] + R[:, 2]) / 2.0)
        index = manoeuvring_index(dt_s, self._acceleration_mps2, sigma_m)
        alpha, beta = combined_gains(self._rows.k[rows] + 1, index)
        # A second plot of one time is weighed by what is known, whatever the age of the track.
        own = P[:, 0, 0] + P[:, 1, 1]
        alpha = np.where(dt_s > 0.0, alpha, own / (own + R[:, 0] + R[:, 2]))
        return _feed(self._rows, rows, plots, alpha, beta, self._acceleration_mps2)

    def feed_from(self, source: int, target: int) -> None:
        """Nothing: no plots are remembered."""

    def remembered(self, row: int) -> Plots:
        """None."""
        return empty_plots((0,))

    def move_plots(self, sensor: int, move: Move, later_s: float = 0.0) -> None:
        """Nothing: no plots are remembered."""

    def associate(
        self, rows: IntArray, first: BoolArray, plots: Plots, limit: float, odds: Odds = NO_ODDS
    ) -> tuple[IntArray, FloatArray, BoolArray]:
        """Give plots to rows, one to one: (m,) row of each plot or -1, cost, and whether it was not too late.

        Never jointly, whatever the odds.
        """
        m = len(plots)
        row, cost, fed = np.full(m, -1, np.int64), np.zeros(m), np.zeros(m, np.bool_)
        own = self._rows
        near = gating.near(own.x, own.spread, own.t_s, rows, plots, limit, self._strength)
        times = gating.nearest_times(own.x[near], own.t_s[near], plots)
        ahead, known = self.predict(near, times)
        near, times, ahead = near[known], times[known], Mixture(*(part[known] for part in ahead))
        chosen = gating.choose(ahead, times, first[near], plots, limit, cost)
        taken = np.flatnonzero(chosen >= 0)
        row[taken] = near[chosen[taken]]
        fed[taken] = self.feed(row[taken], plots[taken])
        return row, cost, fed

    def predict(self, rows: IntArray, t_s: FloatArray) -> tuple[Mixture, BoolArray]:
        """Predictions of rows to their times, and which of them are known."""
        out = make_mixture(len(rows), 1)
        known = _predict(self._rows, rows, t_s, self._acceleration_mps2, out)
        return out, known

    def estimate(self, rows: IntArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predictions of rows to their times: means (m, 4), covariances (m, 4, 4), model probabilities (m, 1)."""
        ahead, _ = self.predict(rows, t_s)
        return ahead.x[:, 0], ahead.P[:, 0], ahead.mu

    def estimates(self, mixture: Mixture) -> tuple[FloatArray, FloatArray]:
        """The only model's mean (m, 4) and covariance (m, 4, 4)."""
        return mixture.x[:, 0], mixture.P[:, 0]

    def refined(self, rows: IntArray, lag: int) -> tuple[Mixture, FloatArray]:
        """Not kept by this filter.

        Raises:
            NotImplementedError: always; settings that ask for it are refused.
        """
        raise NotImplementedError

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that rows hold, by name, row by row: to be read and, in rows, to be written."""
        return self._rows._asdict()

    def grow(self, rows: int) -> None:
        """Add empty rows."""
        self._rows = Rows(*(np.concatenate(both) for both in zip(self._rows, make_rows(rows), strict=True)))
