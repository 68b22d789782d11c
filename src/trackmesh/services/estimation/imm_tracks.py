"""The filters of a layer of tracks: interacting multiple models with rings, row by row (see ``tracks``)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import tracks
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.gating import Mixture, Strength, make_mixture
from trackmesh.services.estimation.joint import NO_ODDS, Odds
from trackmesh.services.estimation.motion import TURN
from trackmesh.services.estimation.plots import Move, Plots, make_plots

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_SHARED = ("models", "work", "scratch")


def strength(models: Models) -> Strength:
    """What the target of these models can do, two sigma of each model's own parameters."""
    turns = models.kind == TURN
    own = np.abs(models.numbers[:, 1]) + 2.0 * models.numbers[:, 2]
    return Strength(
        float(models.numbers[:, 0].max()), float(max(own[~turns], default=0.0)), float(max(own[turns], default=0.0))
    )


class ImmTracks:
    """The filters of a layer of tracks: interacting multiple models with rings."""

    def __init__(self, models: Models, rows: int, ring: int, sigma_v_mps: float, joint: bool = False) -> None:
        self.models = models
        self.filters = tracks.make_filters(models, rows, ring)
        self._ring = ring
        self._sigma_v_mps = sigma_v_mps
        self._strength = strength(models)
        self._joint = joint
        self._tally = np.zeros(2, np.int64)

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
        return int(self.filters.work["repairs"][0])

    def figures(self) -> dict[str, int]:
        """How many clusters of close tracks were associated jointly, and how many were too large for that."""
        if not self._joint:
            return {}
        return dict(zip(("joint_clusters", "joint_too_large"), self._tally.tolist(), strict=True))

    def begin(self, rows: IntArray, plots: Plots) -> None:
        """Start tracks in rows, from one plot each."""
        tracks.begin(self.filters, rows, plots, self._sigma_v_mps)

    def begin_at(self, rows: IntArray, x: FloatArray, P: FloatArray, t_s: float) -> None:
        """Start tracks in rows, each from a state (4,) and a covariance (4, 4) at a time."""
        R = np.stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]], axis=1)
        tracks.begin(self.filters, rows, make_plots(x[:, :2], R, t_s), self._sigma_v_mps)
        tracks.begin_at(self.filters, rows, x, P)

    def feed(self, rows: IntArray, plots: Plots) -> BoolArray:
        """Feed plot k to row k; False where it comes too late."""
        return tracks.feed(self.filters, rows, plots)

    def feed_from(self, source: int, target: int) -> None:
        """Feed the plots that row ``source`` remembers to row ``target``."""
        plots = self.remembered(source)
        tracks.feed(self.filters, np.full(len(plots), target), plots)

    def remembered(self, row: int) -> Plots:
        """The last plots of a row, in order of time."""
        return self.filters.ring[row, : self.filters.ring_n[row]].copy()

    def move_plots(self, sensor: int, move: Move, later_s: float = 0.0) -> None:
        """Move the remembered plots of a sensor in the plane and in time, and filter all again from the base.

        Args:
            sensor: whose plots.
            move: where they belong instead.
            later_s: added to their times; what falls before the base is forgotten.
        """
        f = self.filters
        there = np.arange(f.ring.shape[1]) < f.ring_n[:, None]
        ours = there & (f.ring["sensor"] == sensor)
        if not ours.any():
            return
        f.ring["z"][ours] = move(f.ring[ours])
        f.ring["t_s"][ours] += later_s
        rows = np.flatnonzero(ours.any(axis=1))
        row, place = np.nonzero(there[rows])
        plots = f.ring[rows[row], place]
        f.head[rows] = f.base[rows]
        f.ring_n[rows] = f.mid_n[rows] = 0
        tracks.feed(f, rows[row], plots)

    def associate(
        self, rows: IntArray, first: BoolArray, plots: Plots, limit: float, odds: Odds = NO_ODDS
    ) -> tuple[IntArray, FloatArray, BoolArray]:
        """Give plots to rows, one to one: (m,) row of each plot or -1, cost, and whether it was not too late.

        Of a ``joint`` layer, rows of ``first`` that are close are fed weighted means of plots (see ``joint``).
        """
        odds = odds if self._joint else NO_ODDS
        return tracks.associate(self.filters, rows, first, plots, limit, self._strength, odds, self._tally)

    def predict(self, rows: IntArray, t_s: FloatArray) -> tuple[Mixture, BoolArray]:
        """Predictions of rows to their times, and which of them are known."""
        out = make_mixture(len(rows), len(self.models.kind))
        known = tracks.predict(self.filters, rows, t_s, out)
        return out, known

    def estimate(self, rows: IntArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predictions of rows to their times: means (m, 4), covariances (m, 4, 4), model probabilities (m, r)."""
        return tracks.estimate(self.filters, rows, t_s)

    def estimates(self, mixture: Mixture) -> tuple[FloatArray, FloatArray]:
        """One mean (m, 4) and covariance (m, 4, 4) of each mixture."""
        return tracks.estimates(self.models, mixture)

    def refined(self, rows: IntArray, lag: int) -> tuple[Mixture, FloatArray]:
        """What is now known of rows ``lag`` plots ago, and when that was."""
        out = make_mixture(len(rows), len(self.models.kind))
        t_s = tracks.refined(self.filters, rows, lag, out)
        return out, t_s

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All that rows hold, by name, row by row: to be read and, in rows, to be written."""
        return {name: getattr(self.filters, name) for name in self.filters._fields if name not in _SHARED}

    def grow(self, rows: int) -> None:
        """Add empty rows."""
        self.filters = tracks.with_more_rows(self.filters, rows)
