"""The sequential test between the local tracks of one pair of sensors, cycle by cycle."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import assignment, gating
from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.estimation.pairs import (
    PairRules,
    chi2_upper,
    local_density,
    log_ratio,
    state_distances,
)
from trackmesh.services.estimation.plots import make_plots

FloatArray = npt.NDArray[np.float64]
Blur = Callable[[FloatArray, FloatArray], FloatArray]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NUMBER_MASK = 2**31 - 1
"""Tracks are told apart by the low bits of their uid: no two that live together share them."""

_CANDIDATE_GATE = 25.0
_CONFIRM = 3.0
_HYSTERESIS = 0.5


class LocalTracks(NamedTuple):
    """Local tracks of one sensor at one time, in its raw frame.

    Attributes:
        number: (n,) below 2^31. row: (n,) in its layer.
        x, P: (n, 4), (n, 4, 4).
        shift, blur: (n, 2), (n, 2, 2) what the sensor's bias does to the position, as far as it is known.
    """

    number: IntArray
    row: IntArray
    x: FloatArray
    P: FloatArray
    shift: FloatArray
    blur: FloatArray

    def corrected(self) -> FloatArray:
        """States (n, 4) without the shift."""
        return np.concatenate([self.x[:, :2] - self.shift, self.x[:, 2:]], axis=1)


class DeclaredPairs(NamedTuple):
    """Pairs declared one target: indices into the two sets of local tracks, and the log-likelihood ratio."""

    a: IntArray
    b: IntArray
    ratio: FloatArray


class _Pairs(NamedTuple):
    """Pairs under test, sorted by key = number of a << 31 | number of b."""

    key: IntArray
    ratio: FloatArray
    weight: FloatArray
    misfit: FloatArray
    against: FloatArray
    t_s: FloatArray
    declared: npt.NDArray[np.bool_]


class Candidates(NamedTuple):
    """Pairs to look at, sorted by key: indices into both sets of tracks, and which are close in position."""

    key: IntArray
    a: IntArray
    b: IntArray
    near: BoolArray


def candidates(a: LocalTracks, b: LocalTracks, stored: IntArray) -> Candidates:
    """Pairs close in position, and pairs whose keys are ``stored`` and whose tracks both live."""
    near = np.empty(0, np.int64)
    if len(a.number) and len(b.number):
        R = b.P[:, :2, :2] + b.blur
        plots = make_plots(b.corrected()[:, :2], np.stack([R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]], axis=1), 0.0)
        P = a.P.copy()
        P[:, :2, :2] += a.blur
        tracks = Mixture(np.ascontiguousarray(a.corrected()[:, None]), P[:, None], np.ones((len(P), 1)))
        i, j, _ = gating.gate(tracks, np.zeros(len(P)), plots, _CANDIDATE_GATE)
        near = (a.number[i] << 31) | b.number[j]
    key = np.union1d(near, stored)
    ia, ib = index_of(a.number, key >> 31), index_of(b.number, key & NUMBER_MASK)
    alive = (ia >= 0) & (ib >= 0)
    return Candidates(key[alive], ia[alive], ib[alive], np.isin(key[alive], near))


class SequentialTest:
    """SeqLLR between two sensors. State: one sum a pair; pairs die with their tracks."""

    def __init__(self, rules: PairRules) -> None:
        self.rules = rules
        self._pairs = _blank(0)

    def cycle(self, a: LocalTracks, b: LocalTracks, t_s: float, blur: Blur | None = None) -> DeclaredPairs:
        """Add the evidence of this moment and declare pairs, one to one.

        Args:
            a, b: the tracks of the two sensors.
            t_s: now.
            blur: gives, for pairs of raw states, the covariance (n, 2, 2) of the difference of the sensors' shifts.
        """
        key, ia, ib, near = candidates(a, b, self._pairs.key)
        old, known = self._recall(key)
        unknown = blur(a.x[ia], b.x[ib]) if blur else np.zeros((len(ia), 2, 2))
        distance, logdet = state_distances(a.corrected(), a.P, b.corrected(), b.P, ia, ib, unknown)
        density = local_density(a.x, b.x, self.rules.radius_m)[ia]
        pairs = self._add(key, old, known, distance, log_ratio(self.rules, distance, logdet, density), t_s)
        barred = pairs.misfit > self.rules.fit_limit * chi2_upper(4.0 * np.maximum(pairs.weight, 1.0))
        score = np.where(barred, -1.0, pairs.ratio + _HYSTERESIS * old.declared)
        usable = np.flatnonzero(score > 0.0)
        chosen = assignment.assign(ia[usable], ib[usable], score[usable], len(a.number), len(b.number))
        best = chosen[ib] == ia
        declared = best & ~barred & (pairs.ratio > np.where(old.declared, 0.0, _CONFIRM))
        # Pairs that are neither near nor likely are forgotten, so that crossings of long ago take no room.
        keep = near | (pairs.ratio > 0.0)
        self._pairs = _Pairs(**{name: v[keep] for name, v in pairs._replace(declared=declared)._asdict().items()})
        return DeclaredPairs(ia[declared], ib[declared], pairs.ratio[declared])

    def _recall(self, key: IntArray) -> tuple[_Pairs, npt.NDArray[np.bool_]]:
        """The stored sums of these keys (zeros for new pairs), and which were stored."""
        where = index_of(self._pairs.key, key)
        known = where >= 0
        safe = np.where(known, where, 0)

        stored = self._pairs if len(self._pairs.key) else _blank(1)
        return _Pairs(key, *(np.where(known, v[safe], np.zeros_like(v[:1])) for v in stored[1:])), known

    def _add(
        self,
        key: IntArray,
        old: _Pairs,
        known: npt.NDArray[np.bool_],
        distance: FloatArray,
        increment: FloatArray,
        t_s: float,
    ) -> _Pairs:
        rules = self.rules
        dt = np.where(known, t_s - old.t_s, np.inf)
        w = np.minimum(1.0, dt / rules.correlation_s)
        fade, fit_fade = np.exp(-dt / rules.memory_s), np.exp(-dt / rules.fit_memory_s)
        ratio = np.maximum(fade * old.ratio + w * increment, rules.floor)
        against = np.maximum(0.0, old.against - w * (increment + 0.5))
        broken = against > rules.break_at
        ratio, against = np.where(broken, np.minimum(ratio, 0.0), ratio), np.where(broken, 0.0, against)
        # An infinite distance bars for a while, but must not stay infinite.
        misfit = fit_fade * old.misfit + w * np.minimum(distance, 1e6)
        return _Pairs(key, ratio, fit_fade * old.weight + w, misfit, against, np.full(len(key), t_s), old.declared)


def _blank(n: int) -> _Pairs:
    real = np.zeros(n)
    return _Pairs(np.full(n, -1, np.int64), real, real, real, real, real, np.zeros(n, np.bool_))
