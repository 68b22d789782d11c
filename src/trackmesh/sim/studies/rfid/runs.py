"""One filter through many runs, and what its errors are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.tags.filtering import begin, estimates, filter_ranges
from trackmesh.services.tags.records import Describe, make_filters, make_rules, make_work, sizes
from trackmesh.sim.studies.rfid.worlds import Data

FloatArray = npt.NDArray[np.float64]

FIRST_VARIANCE = 10.0
DIVERGED_M = 40.0
LOST_M = 30.0
_END_TICKS = 20


class Outcome(NamedTuple):
    """What a filter made of the runs.

    Attributes:
        variance: (2,) mean squared error east and north at the instants of ranges. rms_m: of both together.
        all_rms_m: at all ticks. nees: mean normalised squared error over its dimension, at the instants.
        diverged: share of the runs with an error above ``DIVERGED_M`` at any time.
        lost: share of the runs whose error over the last two seconds is above ``LOST_M``.
        discarded: updates given up, of all runs. acceleration: final variance of the Singer model's acceleration.
        path: (ticks + 1, 2) estimates of the first run.
        spread: (2,) standard deviation over the runs of each one's mean squared error east and north.
    """

    variance: FloatArray
    rms_m: float
    all_rms_m: float
    nees: float
    diverged: float
    lost: float
    discarded: int
    acceleration: float
    path: FloatArray
    spread: FloatArray


def follow(description: Describe, data: Data, first: FloatArray | None = None) -> Outcome:
    """Run a filter, begun as the slides do: at the first place, or at ``first`` (runs, 2), with variance 10 in all."""
    runs = data.truth.shape[1]
    rules = make_rules(description)
    filters, work = make_filters(rules, runs), make_work(rules)
    places = data.truth[0] if first is None else first
    for run, (east, north) in enumerate(places.tolist()):
        begin(rules[0], filters[run], 0.0, east, north, np.array([FIRST_VARIANCE, 0.0, FIRST_VARIANCE]))
    if first is None:
        for state in range(2, 6):
            filters["P"][:, :, state, state] = FIRST_VARIANCE
    d = sizes(rules)[1]
    mean, covariance = np.zeros((runs, d)), np.zeros((runs, d, d))
    errors, nees, heard, path = [], [], [], [places[0]]
    for tick, z in enumerate(data.ranges, 1):
        filter_ranges(rules[0], filters, data.readers, z, work[0])
        # Of a copy: the filters themselves move from instant to instant of ranges only.
        estimates(rules[0], filters.copy(), tick * data.tick_s, work[0], mean, covariance)
        e = mean[:, :2] - data.truth[tick]
        errors.append(e)
        nees.append(_normalised(e, covariance[:, :2, :2]))
        heard.append(np.isin(np.arange(runs), z["row"]))
        path.append(mean[0, :2].copy())
    acceleration = float(filters["variance"].mean())
    return _outcome(
        np.array(errors), np.array(nees), np.array(heard), int(work[0]["discarded"]), acceleration, np.array(path)
    )


def _normalised(e: FloatArray, P: FloatArray) -> FloatArray:
    """e^T P^-1 e / 2 of errors (n, 2)."""
    determinant = P[:, 0, 0] * P[:, 1, 1] - P[:, 0, 1] ** 2
    quadratic = P[:, 1, 1] * e[:, 0] ** 2 - 2.0 * P[:, 0, 1] * e[:, 0] * e[:, 1] + P[:, 0, 0] * e[:, 1] ** 2
    return np.asarray(0.5 * quadratic / np.maximum(determinant, 1e-300))


def _outcome(
    e: FloatArray,
    nees: FloatArray,
    heard: npt.NDArray[np.bool_],
    discarded: int,
    acceleration: float,
    path: FloatArray,
) -> Outcome:
    squared = (e**2).sum(-1)
    weight = heard[..., None]
    of_run = (e**2 * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1)
    variance = (e[heard] ** 2).mean(axis=0)
    return Outcome(
        variance=variance,
        rms_m=float(np.sqrt(variance.sum())),
        all_rms_m=float(np.sqrt(squared.mean())),
        nees=float(nees[heard].mean()),
        diverged=float((squared.max(axis=0) > DIVERGED_M**2).mean()),
        lost=float((np.sqrt(squared[-_END_TICKS:].mean(axis=0)) > LOST_M).mean()),
        discarded=discarded,
        acceleration=acceleration,
        path=path,
        spread=of_run.std(axis=0),
    )
