"""What is measured of a filter in a cell, and how much it scatters from run to run."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.bank import Models
from trackmesh.sim.studies.filtering import Estimates, errors, nees
from trackmesh.sim.studies.manoeuvre.cells import Simulated

ONSET_S = 30.0
"""So long after the begin of a manoeuvre errors are followed."""

NEES_95 = 9.487729
"""Below it the normalised error squared of four components is in 95 of 100 cases (chi-square)."""

_REPEATS = 400


class Mean(NamedTuple):
    """A mean over scans, kept as sums over the scans of each run and their numbers, (runs,) or (runs, m)."""

    total: FloatArray
    scans: FloatArray

    def over(self, weight: FloatArray) -> FloatArray:
        """The mean over runs that count ``weight`` (b, runs) times, (b,) or (b, m); NaN where there is no scan."""
        n = weight @ self.scans
        return np.asarray(np.divide(weight @ self.total, n, out=np.full(n.shape, np.nan), where=n > 0))


class Score(NamedTuple):
    """One filter in one cell.

    Attributes:
        position, velocity: squared errors. nees: normalised error squared over four. covered: whether it is below
            ``NEES_95``.
        quiet_position, manoeuvre_position, manoeuvre_nees: the same, without and within manoeuvres.
        onset: (runs, m) squared position error at scans 0, 1, ... since the last begin of a manoeuvre.
        weight: of the first branch.
    """

    position: Mean
    velocity: Mean
    nees: Mean
    covered: Mean
    quiet_position: Mean
    manoeuvre_position: Mean
    manoeuvre_nees: Mean
    onset: Mean
    weight: Mean


Metric = Callable[[Score, FloatArray], FloatArray]

METRICS: dict[str, Metric] = {
    "position": lambda score, weight: np.sqrt(score.position.over(weight)),
    "velocity": lambda score, weight: np.sqrt(score.velocity.over(weight)),
    "peak": lambda score, weight: _largest(np.sqrt(score.onset.over(weight))),
    "anees": lambda score, weight: score.nees.over(weight),
    "anees in manoeuvre": lambda score, weight: score.manoeuvre_nees.over(weight),
    "cov95": lambda score, weight: score.covered.over(weight),
    "quiet": lambda score, weight: np.sqrt(score.quiet_position.over(weight)),
    "manoeuvre": lambda score, weight: np.sqrt(score.manoeuvre_position.over(weight)),
}
"""RMS errors in m and m/s, ANEES (1 where the filter knows its error), coverage; from a score and weights (b, runs)."""


class Value(NamedTuple):
    """A number and its standard error over the runs; NaN and None where there is none."""

    value: float
    std: float | None

    @property
    def known(self) -> bool:
        """Whether there is a number."""
        return bool(np.isfinite(self.value))


def score(models: Models, estimates: Estimates, simulated: Simulated) -> Score:
    """Score estimates at all scans, those without a plot among them."""
    off, flights = errors(estimates, simulated.case), simulated.flights
    position, velocity = ((off[..., part] ** 2).sum(axis=-1) for part in (slice(0, 2), slice(2, 4)))
    normal, busy = nees(estimates, simulated.case), flights.manoeuvring
    every = np.ones(busy.shape, bool)
    steps = np.arange(round(ONSET_S / simulated.case.period_s) + 1)
    since = [_mean(position, flights.since_onset == step) for step in steps]
    return Score(
        position=_mean(position, every),
        velocity=_mean(velocity, every),
        nees=_mean(normal / 4.0, every),
        covered=_mean((normal < NEES_95).astype(float), every),
        quiet_position=_mean(position, ~busy),
        manoeuvre_position=_mean(position, busy),
        manoeuvre_nees=_mean(normal / 4.0, busy),
        onset=Mean(*(np.stack(part, axis=1) for part in zip(*since, strict=True))),
        weight=_mean(estimates.mu[..., : models.first[1]].sum(axis=-1), every),
    )


def _mean(values: FloatArray, use: npt.NDArray[np.bool_]) -> Mean:
    """Mean of values (T, runs) where they are to be used."""
    return Mean(np.where(use, values, 0.0).sum(axis=0), use.sum(axis=0).astype(float))


def measured(metric: str, score: Score) -> Value:
    """A metric over all runs."""
    return _value(METRICS[metric], len(score.position.total), score)


def ratio(metric: str, score: Score, reference: Score) -> Value:
    """A metric over that of another filter on the same runs, which scatter together."""
    return _value(METRICS[metric], len(score.position.total), score, reference)


def _value(metric: Metric, runs: int, *scores: Score) -> Value:
    """The first score's metric, over that of the second where there is one; its standard error by the bootstrap."""
    weight = _resampled(runs)
    values = metric(scores[0], weight)
    if len(scores) > 1:
        values = values / metric(scores[1], weight)
    spread = values[1:][np.isfinite(values[1:])]
    return Value(float(values[0]), float(spread.std()) if runs > 1 and len(spread) else None)


@functools.cache
def _resampled(runs: int) -> FloatArray:
    """How often each run counts: once, then as often as it is drawn when all are drawn anew, (1 + repeats, runs)."""
    again = np.random.default_rng(runs).multinomial(runs, np.full(runs, 1.0 / runs), _REPEATS)
    return np.concatenate([np.ones((1, runs)), again])


def _largest(profile: FloatArray) -> FloatArray:
    """The largest of each row (b, m), NaN only where all is."""
    return np.asarray(np.where(np.isnan(profile).all(axis=1), np.nan, np.nan_to_num(profile).max(axis=1)))


def geometric_mean(values: list[Value]) -> Value:
    """Of ratios of independent cells."""
    logs = [np.log(v.value) for v in values]
    relative = [(v.std or 0.0) / v.value for v in values]
    mean = float(np.exp(np.mean(logs)))
    return Value(mean, mean * float(np.sqrt(np.sum(np.square(relative)))) / len(values))
