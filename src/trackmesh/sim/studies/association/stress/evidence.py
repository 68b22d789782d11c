"""What the statistic of eq. (28) does over time for true and for wrong pairs, and why chi-square is not its limit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.services.estimation.track_distances import acceptance_limit
from trackmesh.sim.studies.association.stress.cases import CASES, CYCLE_S, Case
from trackmesh.sim.studies.association.stress.local_tracks import Seen, record

SEED = 900
RUNS = 4
NOMINAL, BIASED, FORMATIONS, UNTOLD = (
    next(case for case in CASES if case.name.startswith(name))
    for name in ("nominal, 80", "bias, 80", "formations of 500", "interference not in R")
)
ALPHAS = (0.05, 0.001)
LAGS = 12


class Pairs(NamedTuple):
    """Differences of the tracks of pairs, whitened by their covariance, (looks, pairs, 4); NaN while one is missing."""

    whitened: FloatArray

    @property
    def distance(self) -> FloatArray:
        """T (looks, pairs) of the weighted method."""
        return np.asarray((self.whitened**2).sum(axis=-1))

    @property
    def statistic(self) -> FloatArray:
        """Lambda (looks, pairs)."""
        return np.asarray(np.nancumsum(self.distance, axis=0))

    @property
    def looks(self) -> FloatArray:
        """How many distances were added, (looks, pairs)."""
        return np.asarray(np.isfinite(self.distance).cumsum(axis=0).astype(float))

    def per_freedom(self) -> FloatArray:
        """Lambda over its degrees of freedom, 1 where covariances are honest; NaN before the first look."""
        looks = self.looks
        return np.asarray(np.where(looks > 0, self.statistic / np.maximum(4.0 * looks, 1.0), np.nan))

    def rejected(self, alpha: float, scale: float = 1.0) -> FloatArray:
        """Share of the pairs that chi-square rejects after each look, (looks,), with lambda divided by ``scale``."""
        limit = acceptance_limit(np.maximum(self.looks, 1.0), 4, alpha)
        return np.asarray((self.statistic / scale > limit).mean(axis=1))

    def autocorrelation(self, lags: int = LAGS) -> FloatArray:
        """Of the whitened differences, at lags of 0, 1, ... cycles, over all pairs and components."""
        y = self.whitened
        products = np.array([float(np.nanmean(y[lag:] * y[: len(y) - lag])) for lag in range(lags + 1)])
        return np.asarray(products / products[0])


def true_pairs(case: Case, runs: int = RUNS) -> Pairs:
    """Of each target, the tracks of both radars."""
    return _pairs(case, runs, 0)


def wrong_pairs(case: Case, runs: int = RUNS) -> Pairs:
    """Of each target in a formation, its track by the first radar and the other target's by the second."""
    return _pairs(case, runs, case.targets // 2)


def repeats(autocorrelation: FloatArray) -> float:
    """How much larger the variance of a sum of squares is than that of as many independent ones: 1 + 2 sum rho^2."""
    return float(1.0 + 2.0 * (autocorrelation[1:] ** 2).sum())


def times_s(pairs: Pairs) -> FloatArray:
    """Times of the looks, seconds since the first cycle."""
    return np.asarray(CYCLE_S * np.arange(1.0, len(pairs.whitened) + 1.0))


def _pairs(case: Case, runs: int, ahead: int) -> Pairs:
    parts = []
    for k in range(runs):
        moments = record(case, SEED + k).moments
        partner: IntArray = np.roll(np.arange(case.targets), -ahead)
        states = [[_dense(seen, case.targets) for seen in (m.a, m.b)] for m in moments]
        parts.append(np.array([_whitened(*a, *(part[partner] for part in b)) for a, b in states]))
    return Pairs(np.concatenate(parts, axis=1))


def _dense(seen: Seen, count: int) -> tuple[FloatArray, FloatArray]:
    """States and covariances by target, NaN where there is no track."""
    x, P = np.full((count, 4), np.nan), np.full((count, 4, 4), np.nan)
    x[seen.target], P[seen.target] = seen.x, seen.P
    return x, P


def _whitened(xa: FloatArray, Pa: FloatArray, xb: FloatArray, Pb: FloatArray) -> FloatArray:
    """L^-1 (x_a - x_b) with L L^T = P_a + P_b, (pairs, 4)."""
    out = np.full(xa.shape, np.nan)
    both = np.isfinite(xa[:, 0]) & np.isfinite(xb[:, 0])
    L = np.linalg.cholesky(Pa[both] + Pb[both])
    out[both] = np.linalg.solve(L, (xa - xb)[both][..., None])[..., 0]
    return out
