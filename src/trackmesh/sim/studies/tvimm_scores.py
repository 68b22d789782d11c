"""The runs of the TV-IMM study: errors and consistency of four filters in two scenarios, measured four ways.

``own`` is the paper's way: each model has a measurement of its own. The others tell where its gain comes from, on the
same noise: ``shared`` gives model 1 the position out of the measurement of model 2, ``stacked`` gives both measurements
to both models. ``fitted`` is ``own`` with two values chosen to come near the printed tables; it is not the paper's
setting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.sim.studies.tvimm_filters import FloatArray, Model, Track, imm, kalman, squared_distance, tvimm
from trackmesh.sim.studies.tvimm_setting import (
    FILTERS,
    PAPER_RUNS,
    SCENARIOS,
    Draw,
    Scenario,
    fitted_models,
    printed_models,
    simulate,
    stacked,
)

Pair = tuple[FloatArray, FloatArray]

BATCH = 250
"""Runs that are simulated at once: enough for numpy, little enough for the cache."""

SEED = 2021


class Score(NamedTuple):
    """How one filter did: the distance to the true position in the plane, and whether it knew that distance.

    Attributes:
        per_run: mean over time of each run (n,).
        over_time: mean over the runs after each measurement (t,).
        example: the first run (t,).
        nees: squared position error under the filter's own covariance, mean over all; 2 if that is right.
    """

    per_run: FloatArray
    over_time: FloatArray
    example: FloatArray
    nees: float

    @property
    def mean(self) -> float:
        """Mean error over time and runs."""
        return float(self.per_run.mean())

    @property
    def std(self) -> float:
        """Standard deviation over the runs of their mean error."""
        return float(self.per_run.std())

    @property
    def scatter(self) -> dict[str, float]:
        """Standard deviations of mean and of std when the experiment is repeated with as many runs as in the paper."""
        return {"mean": self.std / PAPER_RUNS**0.5, "std": self.std / (2 * PAPER_RUNS) ** 0.5}


Scores = dict[tuple[str, str, str], Score]
"""By table ("1", "2"), way of measuring ("own", "shared", "stacked", "fitted") and filter."""


def simulate_scores(runs: int, progress: Callable[[float], None]) -> Scores:
    """Scores of ``runs`` runs of both scenarios; the same run has the same noise, however many there are."""
    sizes = [min(BATCH, runs - done) for done in range(0, runs, BATCH)]
    found: dict[tuple[str, str, str], list[Score]] = {}
    for t, (table, scenario) in enumerate(SCENARIOS.items()):
        for b, size in enumerate(sizes):
            draw = simulate(scenario, size, np.random.default_rng([SEED, t, b]))
            for (way, name), score in _batch(scenario, draw):
                found.setdefault((table, way, name), []).append(score)
            progress((t * len(sizes) + b + 1) / (len(SCENARIOS) * len(sizes)))
    return {key: joined(parts) for key, parts in found.items()}


def scored(truth: FloatArray, track: Track) -> Score:
    """Score of a track beside true states (t, n, 4)."""
    apart = track.x[..., :2] - truth[..., :2]
    error = np.hypot(apart[..., 0], apart[..., 1])
    nees = squared_distance(apart, track.P[..., :2, :2]).mean()
    return Score(error.mean(axis=0), error.mean(axis=1), error[:, 0], float(nees))


def joined(parts: list[Score]) -> Score:
    """The score of all runs of several batches."""
    runs = [len(p.per_run) for p in parts]
    over_time = np.average([p.over_time for p in parts], axis=0, weights=runs)
    nees = float(np.average([p.nees for p in parts], weights=runs))
    return Score(np.concatenate([p.per_run for p in parts]), over_time, parts[0].example, nees)


def tracks(models: tuple[Model, Model], z: Pair, start: FloatArray) -> dict[str, Track]:
    """What the four filters make of the measurements ``z`` of the two models."""
    single = (kalman(model, z_j, start) for model, z_j in zip(models, z, strict=True))
    return dict(zip(FILTERS, (*single, tvimm(models, z, start), imm(models, z, start)), strict=True))


def ways(scenario: Scenario, draw: Draw) -> dict[str, tuple[tuple[Model, Model], Pair]]:
    """Models and their measurements in each way of measuring."""
    printed, fitted = printed_models(scenario), fitted_models(scenario)
    own = draw.measured(printed)
    both = np.concatenate(own, axis=-1)
    return {
        "own": (printed, own),
        "shared": (printed, draw.measured_once(printed)),
        "stacked": (stacked(printed), (both, both)),
        "fitted": (fitted, draw.measured(fitted)),
    }


def _batch(scenario: Scenario, draw: Draw) -> Iterator[tuple[tuple[str, str], Score]]:
    for way, (models, z) in ways(scenario, draw).items():
        for name, track in tracks(models, z, scenario.start).items():
            yield (way, name), scored(draw.truth, track)
