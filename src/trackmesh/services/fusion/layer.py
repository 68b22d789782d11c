"""One layer of tracks: a bank of rows and the one step that feeds it.

The same code keeps the local tracks of one sensor and the system tracks of all sensors.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.heights import HeightTracks
from trackmesh.services.estimation.joint import Odds
from trackmesh.services.estimation.plots import Move, Plots
from trackmesh.services.fusion import life as lives
from trackmesh.services.fusion.life import Life, Rules, make_life
from trackmesh.services.fusion.snapshot import Arrays, fill, named, under

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class TrackFilters(Protocol):
    """The filters of a layer, one a row: ``ImmTracks`` or ``AlphaBetaTracks``, whose methods tell more."""

    @property
    def t_s(self) -> FloatArray: ...  # noqa: D102
    @property
    def oldest_s(self) -> FloatArray: ...  # noqa: D102
    @property
    def mean(self) -> FloatArray: ...  # noqa: D102
    @property
    def repairs(self) -> int: ...  # noqa: D102
    def figures(self) -> dict[str, int]: ...  # noqa: D102

    def begin(self, rows: IntArray, plots: Plots) -> None: ...  # noqa: D102
    def begin_at(self, rows: IntArray, x: FloatArray, P: FloatArray, t_s: float) -> None: ...  # noqa: D102
    def feed(self, rows: IntArray, plots: Plots) -> BoolArray: ...  # noqa: D102
    def feed_from(self, source: int, target: int) -> None: ...  # noqa: D102
    def associate(  # noqa: D102
        self, rows: IntArray, first: BoolArray, plots: Plots, limit: float, odds: Odds
    ) -> tuple[IntArray, FloatArray, BoolArray]: ...
    def estimate(  # noqa: D102
        self, rows: IntArray, t_s: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]: ...
    def estimates(self, mixture: Mixture) -> tuple[FloatArray, FloatArray]: ...  # noqa: D102
    def refined(self, rows: IntArray, lag: int) -> tuple[Mixture, FloatArray]: ...  # noqa: D102
    def remembered(self, row: int) -> Plots: ...  # noqa: D102
    def move_plots(self, sensor: int, move: Move, later_s: float) -> None: ...  # noqa: D102
    def arrays(self) -> dict[str, npt.NDArray[Any]]: ...  # noqa: D102
    def grow(self, rows: int) -> None: ...  # noqa: D102


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
        clutter_density: (m,) false plots a look and square metre where each plot is, as estimated now.
        reference_density: the density that the log-likelihood of the picture is measured against.
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
    clutter_density: FloatArray
    reference_density: float

    @property
    def log_miss(self) -> float:
        """ln(1 - Pd), of a sensor that misses one in a thousand at least."""
        return float(np.log(max(1.0 - self.p_detect, 1e-3)))


class Step(NamedTuple):
    """What a step did.

    Attributes:
        row: (m,) the row that took each plot, new tentative ones included.
        by_confirmed: (m,) whether that track was confirmed before.
        confirmed: rows newly confirmed.
        ended: (row, uid, link) of the confirmed tracks that ended.
        late: plots that came too late for the filter of their track.
        log_likelihood: what the look adds to that of the picture against clutter alone.
    """

    row: IntArray
    by_confirmed: BoolArray
    confirmed: IntArray
    ended: list[tuple[int, int, int]]
    late: int
    log_likelihood: float


class Layer:
    """A bank of tracks; rows never move while their track lives, uids are never used twice.

    Attributes:
        heights: of the tracks, where this layer keeps them.
    """

    def __init__(
        self, filters: TrackFilters, rules: Rules, sensors: int, gate: float, heights: HeightTracks | None = None
    ) -> None:
        self.filters = filters
        self.heights = heights
        self.rules = rules
        self.gate = gate
        self._next_uid = 0
        rows = len(filters.t_s)
        self.life: Life = make_life(rows, sensors)
        self._free = list(range(rows - 1, -1, -1))

    @property
    def rows(self) -> IntArray:
        """Rows of living tracks."""
        return np.asarray(self.life.alive.nonzero()[0])

    def step(self, plots: Plots, look: Look, now_s: float) -> Step:
        """Take one batch: gate, assign, filter, score, start tentative tracks, judge misses, confirm and end.

        ``now_s`` is the time at which tracks are judged; with late plots it is after ``look.t_s``.
        """
        alive = self.rows
        row, by_confirmed = np.full(len(plots), -1, np.int64), np.zeros(len(plots), np.bool_)
        late, gained = 0, 0.0
        if len(plots):
            if len(alive):
                row, by_confirmed, late, gained = self._associate(alive, plots, look)
            self._start(plots, look, row)
            if self.heights is not None:
                self.heights.feed(row, self.life.uid[row], plots)
        lost = self._miss(alive, look)
        confirmed, ended = self.judge(now_s)
        return Step(row, by_confirmed, confirmed, ended, late, gained + lost)

    def predict(self, rows: IntArray, t_s: float | FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Moment-matched states (m, 4), covariances (m, 4, 4) and model probabilities (m, r) of rows at their times."""
        times = t_s if isinstance(t_s, np.ndarray) else np.full(len(rows), t_s)
        return self.filters.estimate(rows, times)

    def refined(self, rows: IntArray, lag: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States (m, 4) and covariances (m, 4, 4) of rows ``lag`` plots ago, and their times (m,)."""
        mixture, t_s = self.filters.refined(rows, lag)
        return *self.filters.estimates(mixture), t_s

    def judge(self, t_s: float) -> tuple[IntArray, list[tuple[int, int, int]]]:
        """Confirm, drop and end tracks at a time; returns rows newly confirmed, and (row, uid, link) of those ended."""
        rows = self.rows
        confirmed, ended = np.empty(len(rows), np.int64), np.empty(len(rows), np.int64)
        n_confirmed, n_ended = lives.judge(self.life, self.rules, rows, t_s, confirmed, ended)
        if not (n_confirmed or n_ended):
            return confirmed[:0], []
        gone = ended[:n_ended].tolist()
        told = [(i, int(self.life.uid[i]), int(self.life.link[i])) for i in gone if self.life.confirmed[i]]
        self._free += gone
        return confirmed[:n_confirmed], told

    def seed(self, x: FloatArray, P: FloatArray, t_s: float, first_s: FloatArray, score: float) -> IntArray:
        """Start confirmed tracks from states (n, 4), (n, 4, 4) at a time that somebody else knows; their rows."""
        rows = self._take(len(x))
        self.filters.begin_at(rows, x, P, t_s)
        lives.born(self.life, rows, self._next_uid, np.full(len(rows), t_s), 0)
        self._next_uid += len(rows)
        self.life.first_s[rows] = first_s
        self.life.score[rows] = self.life.best[rows] = score
        self.life.confirmed[rows] = True
        return rows

    def adopt(self, plots: list[Plots], score: FloatArray) -> IntArray:
        """Start confirmed tracks, each from the plots that are known of it, in order of time; their rows."""
        if not plots:
            return np.empty(0, np.int64)
        rows = self._take(len(plots))
        first = np.concatenate([one[:1] for one in plots])
        self.filters.begin(rows, first)
        t_s = np.ascontiguousarray(first["t_s"])
        lives.born(self.life, rows, self._next_uid, t_s, 0)
        self._next_uid += len(rows)
        for row, one, gain in zip(rows.tolist(), plots, score.tolist(), strict=True):
            rest = one[1:]
            self.filters.feed(np.full(len(rest), row), rest)
            if self.heights is not None:
                self.heights.feed(np.full(len(one), row), np.full(len(one), self.life.uid[row]), one)
            for k in range(len(one)):
                plot = one[k : k + 1]
                yes, nothing = np.ones(1, np.bool_), np.zeros(1)
                lives.hit(self.life, self.rules, np.array([row]), yes, plot, nothing, int(plot["sensor"][0]))
            self.life.score[row] = self.life.best[row] = gain
        self.life.confirmed[rows] = True
        return rows

    def join(self, young: int, old: int) -> None:
        """The plots that one row remembers are those of another as well."""
        self.filters.feed_from(young, old)
        if self.heights is not None:
            self.heights.feed_from(young, old, int(self.life.uid[young]), int(self.life.uid[old]))

    def drop(self, row: int) -> None:
        """End one track at once."""
        self.life.alive[row] = False
        self._free.append(row)

    def kept(self) -> Arrays:
        """All that is to be known of the living tracks after a restart, row by row."""
        rows = self.rows
        held = {name: value[rows] for name, value in self.filters.arrays().items()}
        alive = {name: value[rows] for name, value in self.life._asdict().items()}
        heights = (
            {name: value[rows] for name, value in self.heights.arrays(rows).items()} if self.heights is not None else {}
        )
        next_uid = {"next_uid": np.array(self._next_uid)}
        return named("filters", held) | named("life", alive) | named("heights", heights) | next_uid

    def restore(self, arrays: Arrays) -> None:
        """Go on with what ``kept`` gave, in a layer without tracks.

        Raises:
            TrackmeshError: it is of other filters.
        """
        held, alive = under("filters", arrays), under("life", arrays)
        rows = self._take(len(alive.get("uid", ())))
        for name, target in self.filters.arrays().items():
            fill(target, rows, held, name)
        for name, target in self.life._asdict().items():
            fill(target, rows, alive, name)
        if self.heights is not None:
            for name, target in self.heights.arrays(rows).items():
                fill(target, rows, under("heights", arrays), name)
        self._next_uid = int(arrays["next_uid"])

    def add_sensors(self, sensors: int) -> None:
        """Make room for more sensors."""
        have = self.life.seen_s.shape[1]
        if sensors > have:
            more = make_life(len(self.life.uid), sensors)
            for name in ("seen_s", "looked_s", "member"):
                getattr(more, name)[:, :have] = getattr(self.life, name)
            self.life = self.life._replace(seen_s=more.seen_s, looked_s=more.looked_s, member=more.member)

    def _associate(self, alive: IntArray, plots: Plots, look: Look) -> tuple[IntArray, BoolArray, int, float]:
        """Plots to tracks: row of each plot or -1, whether it was confirmed, how many came too late, what was gained.

        A plot is worth ln(Pd / (2 pi lambda)) - cost / 2 to its track.
        """
        found = np.log(look.p_detect / (2.0 * np.pi * look.clutter_density))
        odds = Odds(found, look.log_miss)
        row, cost, fed = self.filters.associate(alive, self.life.confirmed, plots, self.gate, odds)
        by_confirmed = (row >= 0) & self.life.confirmed[row]
        gain = found - 0.5 * cost
        lives.hit(self.life, self.rules, row, fed, plots, gain, look.sensor)
        gained = (gain + np.log(look.clutter_density / look.reference_density))[fed].sum()
        return row, by_confirmed, int((row >= 0).sum() - fed.sum()), float(gained)

    def _start(self, plots: Plots, look: Look, row: IntArray) -> None:
        unused = np.flatnonzero(row < 0)
        if not len(unused):
            return
        rows = self._take(len(unused))
        self.filters.begin(rows, plots[unused])
        t_s = np.ascontiguousarray(plots["t_s"][unused])
        lives.born(self.life, rows, self._next_uid, t_s, look.sensor)
        self._next_uid += len(rows)
        row[unused] = rows

    def _miss(self, rows: IntArray, look: Look) -> float:
        missed = lives.miss(
            self.life, rows, self.filters.mean, self.filters.t_s, look.t_s, look.sensor, look.site,
            look.max_range_m, look.lately_s, look.period_s, look.margin_s, look.whole, look.log_miss,
        )  # fmt: skip
        return missed * look.log_miss

    def _take(self, n: int) -> IntArray:
        while len(self._free) < n:
            self._grow()
        rows = self._free[len(self._free) - n :]
        del self._free[len(self._free) - n :]
        return np.array(rows[::-1], np.int64)

    def _grow(self) -> None:
        have = len(self.life.uid)
        self.filters.grow(have)
        more_life = make_life(have, self.life.seen_s.shape[1])
        self.life = Life(*(np.concatenate(pair) for pair in zip(self.life, more_life, strict=True)))
        self._free = list(range(2 * have - 1, have - 1, -1)) + self._free
