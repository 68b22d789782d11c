"""The local tracks of the two radars at the times of the association cycle.

Every track is filtered by the filter that the service uses for local tracks. It is told once it has had three plots,
ends when it has had none for three turns of its radar, and has another number when it starts again.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.services.estimation import batch
from trackmesh.services.estimation.bank import make_models
from trackmesh.services.estimation.filters import velocity_models
from trackmesh.services.estimation.gating import make_mixture
from trackmesh.services.estimation.plots import Plots
from trackmesh.sim.studies.association.stress.carried import Carried
from trackmesh.sim.studies.association.stress.cases import CYCLE_S, WARM_UP_S, Case
from trackmesh.sim.studies.association.stress.radars import Sensor, simulate

MODELS = make_models((velocity_models([1.0, 50.0, 500.0], [50.0, 15.0, 15.0]),))
START_VELOCITY_MPS = 150.0
LEAST_PLOTS, LIVES_TURNS = 3, 3.2


class Seen(NamedTuple):
    """The tracks of one radar at one time.

    Attributes:
        number, target: (n,) which track, and of which target.
        x, P: (n, 4), (n, 4, 4), in the raw frame of the radar.
        A, B: (n, 4, 4), (n, 4, 12) what became of its error since the last cycle, see ``carried``.
    """

    number: IntArray
    target: IntArray
    x: FloatArray
    P: FloatArray
    A: FloatArray
    B: FloatArray


class Moment(NamedTuple):
    """What an association cycle is given."""

    t_s: float
    a: Seen
    b: Seen


class Recording(NamedTuple):
    """One run of a case: where the radars stand, and all moments."""

    case: Case
    sites_m: tuple[FloatArray, FloatArray]
    moments: list[Moment]


def record(case: Case, seed: int) -> Recording:
    """Simulate a run and filter its tracks."""
    sensors = simulate(case, seed)
    times = np.arange(CYCLE_S, WARM_UP_S + case.duration_s + 1e-9, CYCLE_S).tolist()
    of_a, of_b = (_tracks(sensor, times) for sensor in sensors)
    moments = [Moment(t_s, a, b) for t_s, a, b in zip(times, of_a, of_b, strict=True)]
    return Recording(case, (sensors[0].site_m, sensors[1].site_m), moments)


def _tracks(sensor: Sensor, times: list[float]) -> Iterator[Seen]:
    filters = LocalFilters(sensor)
    for t_s in times:
        yield filters.advance(t_s)


class LocalFilters:
    """The filters of one radar, one row a target."""

    def __init__(self, sensor: Sensor) -> None:
        n = sensor.seen.shape[1]
        self._sensor = sensor
        self._bank = batch.make_bank(MODELS, n)
        self._carried = Carried(n)
        self._plots_had, self._lives = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._last_s = np.full(n, -np.inf)
        self._t_s = -np.inf

    def advance(self, t_s: float) -> Seen:
        """Filter the plots after the last time and up to this one, and tell the tracks then."""
        self._carried.renew()
        plots = self._sensor.plots
        there = self._sensor.seen & (plots["t_s"] > self._t_s) & (plots["t_s"] <= t_s)
        for turn in np.flatnonzero(there.any(axis=1)).tolist():
            self._take(np.flatnonzero(there[turn]), plots[turn])
        self._t_s = t_s
        self._plots_had[t_s - self._last_s > LIVES_TURNS * self._sensor.period_s] = 0
        rows = np.flatnonzero(self._plots_had)
        now = np.full(len(rows), t_s)
        x, P = self._predicted(rows, now)
        self._carried.predict(rows, now, P)
        told = self._plots_had[rows] >= LEAST_PLOTS
        rows = rows[told]
        number = rows + len(self._last_s) * self._lives[rows]
        return Seen(number, rows, x[told], P[told], self._carried.A[rows], self._carried.B[rows])

    def _take(self, rows: IntArray, plots: Plots) -> None:
        """Give each row its plot of a turn."""
        t_s = np.ascontiguousarray(plots["t_s"][rows])
        new = self._plots_had[rows] == 0
        self._begin(rows[new], plots[rows[new]], t_s[new])
        self._update(rows[~new], plots[rows[~new]], t_s[~new])
        self._plots_had[rows] += 1
        self._last_s[rows] = t_s

    def _begin(self, rows: IntArray, plots: Plots, t_s: FloatArray) -> None:
        states = self._bank.states[rows]
        batch.begin(self._bank._replace(states=states), plots, START_VELOCITY_MPS)
        self._bank.states[rows] = states
        self._lives[rows] += 1
        self._carried.begin(rows, t_s, self._predicted(rows, t_s)[1])

    def _update(self, rows: IntArray, plots: Plots, t_s: FloatArray) -> None:
        self._carried.predict(rows, t_s, self._predicted(rows, t_s)[1])
        states = self._bank.states[rows]
        batch.filter_plots(self._bank._replace(states=states), plots)
        self._bank.states[rows] = states
        self._carried.update(rows, self._predicted(rows, t_s)[1])

    def _predicted(self, rows: IntArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Moment-matched means (n, 4) and covariances (n, 4, 4) of rows at their times."""
        bank = self._bank._replace(states=self._bank.states[rows])
        batch.predict(bank, t_s)
        mixture = make_mixture(len(rows), len(MODELS.kind))
        batch.mixtures(bank, mixture)
        mean = np.einsum("nr,nra->na", mixture.mu, mixture.x)
        apart = mixture.x - mean[:, None]
        spread = mixture.P + apart[..., :, None] * apart[..., None, :]
        return mean, np.einsum("nr,nrab->nab", mixture.mu, spread)
