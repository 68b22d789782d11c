"""Who is given to whom in the paper's experiment, and how often that is right."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.track_distances import (
    all_distances,
    modified_covariance,
    sequential_statistic,
    weighted_covariance,
)
from trackmesh.services.estimation.uncertain import NOISE_MODELS, NoiseModel
from trackmesh.sim.studies.association import targets as flown
from trackmesh.sim.studies.association.filters import Scan, filtered, make_model
from trackmesh.sim.studies.association.setting import COUNTS, METHODS, SETTING, Method, Setting

BATCH = 50
"""Runs that are simulated at once."""


class Key(NamedTuple):
    """A cell of the tables."""

    method: Method
    noise: NoiseModel
    targets: int


Shares = dict[Key, FloatArray]
"""Correct per cent of each run, (runs,)."""


def statistics(scan: Scan, before: FloatArray | float) -> dict[Method, FloatArray]:
    """The three statistics (runs, count, count) after a scan, the last one added to what it was ``before``."""
    weighted = all_distances(scan.x[0], scan.x[1], weighted_covariance(scan.P, scan.P))
    modified = all_distances(scan.x[0], scan.x[1], modified_covariance(scan.P, scan.P, scan.Pab))
    return {
        "weighted": weighted,
        "modified": modified,
        "sequential": sequential_statistic(np.asarray(before), weighted),
    }


def correct(statistic: FloatArray) -> FloatArray:
    """Share (runs,) of the tracks (runs, count, count) whose nearest partner is the right one."""
    right = statistic.argmin(axis=-1) == np.arange(statistic.shape[-1])
    return np.asarray(right.mean(axis=-1))


def decide(setting: Setting, plots: FloatArray, noise: NoiseModel) -> dict[Method, FloatArray]:
    """Correct share (scans with a decision, runs) of each method over plots (scans, 2, runs, count, 2)."""
    found: dict[Method, list[FloatArray]] = {method: [] for method in METHODS}
    before: FloatArray | float = 0.0
    for k, scan in enumerate(filtered(make_model(setting, noise), plots)):
        by_method = statistics(scan, before)
        before = by_method["sequential"]
        if k >= setting.first:
            for method, statistic in by_method.items():
                found[method].append(correct(statistic))
    return {method: np.array(shares) for method, shares in found.items()}


def simulate(
    runs: int,
    seed: int,
    *,
    counts: tuple[int, ...] = COUNTS,
    setting: Setting = SETTING,
    progress: Callable[[float], None] = lambda _: None,
) -> Shares:
    """Correct per cent of all cells; whole batches of a seed are the same, however many runs there are."""
    sizes = [min(BATCH, runs - done) for done in range(0, runs, BATCH)]
    parts: dict[Key, list[FloatArray]] = {}
    for c, count in enumerate(counts):
        for b, size in enumerate(sizes):
            rng = np.random.default_rng([seed, count, b])
            plots = flown.plots(setting, flown.positions(setting, size, count, rng), rng)
            for noise in NOISE_MODELS:
                for method, shares in decide(setting, plots, noise).items():
                    parts.setdefault(Key(method, noise, count), []).append(100.0 * shares.mean(axis=0))
            progress((c + (b + 1) / len(sizes)) / len(counts))
    return {key: np.concatenate(found) for key, found in parts.items()}
