"""One layer of tracks: a bank of rows and the one step that feeds it.

The same code keeps the local tracks of one sensor and the system tracks of all sensors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import assignment, gating, tracks
from trackmesh.services.estimation.bank import Models, State, make_state
from trackmesh.services.estimation.tracks import Filters, join_rows, make_filters
from trackmesh.services.fusion import life as lives
from trackmesh.services.fusion.life import Life, Rules, make_life

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_SCORE_AT_ZERO = 60.0
_CONFIRMED_FIRST = 200.0
_LEAST_SCORE = 0.01


class Plots(NamedTuple):
    """Plots in the plane: z (m, 2) metres east and north, R (m, 3) covariance [ee, en, nn], t_s (m,)."""

    z: FloatArray
    R: FloatArray
    t_s: FloatArray


class Look(NamedTuple):
    """How a sensor looked when it sent a batch.

    Attributes:
        sensor: its index in this layer.
        t_s: time up to which it has looked.
        site, max_range_m, period_s, p_detect: the sensor.
        whole: the batch is a whole look, not a sector.
        margin_s: how long after its period a sector look is judged.
        lately_s: a sensor without coverage counts misses only where it saw the track within this time; infinite for a
            radar, whose coverage is its range.
        clutter_density: false plots a look and square metre.
    """

    sensor: int
    t_s: float
    site: FloatArray
    max_range_m: float
    period_s: float
    p_detect: float
    whole: bool
    margin_s: float
    lately_s: float
    clutter_density: float


class Step(NamedTuple):
    """What a step did.

    Attributes:
        row: (m,) the row that took each plot, new tentative ones included.
        by_confirmed: (m,) whether that track was confirmed before.
        confirmed: rows newly confirmed.
        ended: (row, uid, link) of the confirmed tracks that ended.
        late: plots that came too late for the filter of their track.
    """

    row: IntArray
    by_confirmed: npt.NDArray[np.bool_]
    confirmed: IntArray
    ended: list[tuple[int, int, int]]
    late: int


class Layer:
    """A bank of tracks; rows never move while their track lives, uids are never used twice."""

    def __init__(
        self, models: Models, rules: Rules, ring: int, sensors: int, gate: float, sigma_v_mps: float, rows: int = 64
    ) -> None:
        self.models = models
        self.rules = rules
        self.gate = gate
        self.sigma_v_mps = sigma_v_mps
        self._ring = ring
        self._next_uid = 0
        self.filters: Filters = make_filters(models, rows, ring)
        self.life: Life = make_life(rows, sensors)
        self._free = list(range(rows - 1, -1, -1))

    @property
    def rows(self) -> IntArray:
        """Rows of living tracks."""
        return np.flatnonzero(self.life.alive)

    def step(self, plots: Plots, look: Look, now_s: float) -> Step:
        """Take one batch: gate, assign, filter, score, start tentative tracks, judge misses, confirm and end.

        ``now_s`` is the time at which tracks are judged; with late plots it is after ``look.t_s``.
        """
        alive = self.rows
        row = np.full(len(plots.t_s), -1, np.int64)
        by_confirmed = np.zeros(len(row), np.bool_)
        late = 0
        if len(row):
            if len(alive):
                late = self._associate(alive, plots, look, row, by_confirmed)
            self._start(plots, look, row)
        self._miss(alive, look)
        confirmed, ended = self.judge(now_s)
        return Step(row, by_confirmed, confirmed, ended, late)

    def predict(self, rows: IntArray, t_s: float | FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Moment-matched states (m, 4), covariances (m, 4, 4) and model probabilities (m, r) of rows at their times."""
        state, mu, _ = self._predict(rows, np.broadcast_to(np.asarray(t_s, float), len(rows)))
        mean, covariance = tracks.estimates(self.models, state.x, state.P, mu)
        return mean, covariance, mu

    def judge(self, t_s: float) -> tuple[IntArray, list[tuple[int, int, int]]]:
        """Confirm, drop and end tracks at a time; returns rows newly confirmed, and (row, uid, link) of those ended."""
        rows = self.rows
        confirmed, ended = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
        n_confirmed, n_ended = lives.judge(self.life, self.rules, rows, t_s, confirmed, ended)
        gone = ended[:n_ended].tolist()
        told = [(i, int(self.life.uid[i]), int(self.life.link[i])) for i in gone if self.life.confirmed[i]]
        self._free += gone
        return confirmed[:n_confirmed], told

    def drop(self, row: int) -> None:
        """End one track at once."""
        self.life.alive[row] = False
        self._free.append(row)

    def add_sensors(self, sensors: int) -> None:
        """Make room for more sensors."""
        have = self.life.seen_s.shape[1]
        if sensors > have:
            more = make_life(len(self.life.uid), sensors)
            for name in ("seen_s", "looked_s", "member"):
                getattr(more, name)[:, :have] = getattr(self.life, name)
            self.life = self.life._replace(seen_s=more.seen_s, looked_s=more.looked_s, member=more.member)

    def _associate(
        self, alive: IntArray, plots: Plots, look: Look, row: IntArray, by_confirmed: npt.NDArray[np.bool_]
    ) -> int:
        near = tracks.near(self.models, self.filters, alive, plots.z, plots.R, plots.t_s, self.gate)
        if not len(near):
            return 0
        times = self._times(near, plots)
        state, mu, known = self._predict(near, times)
        x, P = state.x, state.P
        if not known.all():
            near, times, x, P, mu = near[known], times[known], x[known], P[known], mu[known]
        i, j, cost = gating.gate(x, P, mu, times, plots.z, plots.R, plots.t_s, self.gate)
        if not len(i):
            return 0
        confirmed = self.life.confirmed[near]
        score = np.maximum(_SCORE_AT_ZERO - cost, _LEAST_SCORE) + _CONFIRMED_FIRST * confirmed[i]
        chosen = assignment.assign(i, j, score, len(near), len(row))
        taken = np.flatnonzero(chosen >= 0)
        rows = near[chosen[taken]]
        z, R, t_s = plots.z[taken], plots.R[taken], plots.t_s[taken]
        fed = tracks.feed(self.models, self.filters, rows, z, R, t_s, look.sensor)
        gain = self._gain(i, j, cost, chosen, look)
        lives.hit(self.life, self.rules, rows[fed], t_s[fed], gain[fed], look.sensor)
        row[taken] = rows
        by_confirmed[taken] = confirmed[chosen[taken]]
        return int(len(fed) - fed.sum())

    def _times(self, rows: IntArray, plots: Plots) -> FloatArray:
        """When the sensor looked at each row: the time of the plot nearest to it in the plane."""
        t = plots.t_s
        if (t == t[0]).all():
            return np.full(len(rows), t[0])
        return tracks.nearest_times(self.filters, rows, plots.z, t)

    def _gain(self, i: IntArray, j: IntArray, cost: FloatArray, chosen: IntArray, look: Look) -> FloatArray:
        """Log-likelihood ratio of each chosen pair, in order of plots: ln(Pd / (2 pi lambda)) - cost / 2."""
        pair = np.flatnonzero(chosen[j] == i)
        order = pair[np.argsort(j[pair])]
        return np.asarray(np.log(look.p_detect / (2.0 * np.pi * look.clutter_density)) - 0.5 * cost[order])

    def _start(self, plots: Plots, look: Look, row: IntArray) -> None:
        unused = np.flatnonzero(row < 0)
        if not len(unused):
            return
        rows = self._take(len(unused))
        z, R, t_s = plots.z[unused], plots.R[unused], plots.t_s[unused]
        tracks.begin(self.models, self.filters, rows, z, R, t_s, self.sigma_v_mps)
        lives.born(self.life, rows, self._next_uid, t_s, look.sensor)
        self._next_uid += len(rows)
        row[unused] = rows

    def _miss(self, rows: IntArray, look: Look) -> None:
        log_miss = np.log(max(1.0 - look.p_detect, 1e-3))
        lives.miss(
            self.life, rows, self.filters.mean, self.filters.head.t_s, look.t_s, look.sensor, look.site,
            look.max_range_m, look.lately_s, look.period_s, look.margin_s, look.whole, log_miss,
        )  # fmt: skip

    def _predict(self, rows: IntArray, t_s: FloatArray) -> tuple[State, FloatArray, npt.NDArray[np.bool_]]:
        state, mu = make_state(self.models, len(rows)), np.zeros((len(rows), len(self.models.kind)))
        known = tracks.predict(self.models, self.filters, rows, np.ascontiguousarray(t_s), state, mu)
        return state, mu, known

    def _take(self, n: int) -> IntArray:
        while len(self._free) < n:
            self._grow()
        rows = self._free[len(self._free) - n :]
        del self._free[len(self._free) - n :]
        return np.array(rows[::-1], np.int64)

    def _grow(self) -> None:
        have = len(self.life.uid)
        more_filters = make_filters(self.models, have, self._ring)
        more_life = make_life(have, self.life.seen_s.shape[1])
        self.filters = join_rows(self.filters, more_filters)
        self.life = Life(*(np.concatenate(pair) for pair in zip(self.life, more_life, strict=True)))
        self._free = list(range(2 * have - 1, have - 1, -1)) + self._free
