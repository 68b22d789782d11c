"""How near estimators come to the Cramer-Rao bound, and how well the default knows its own error."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.emi.estimators import EstimatorName
from trackmesh.sim.emi import Buried
from trackmesh.sim.studies.emi.claims import SNRS_DB, runs_of
from trackmesh.sim.studies.emi.setting import World, bound, clean_t, draws, estimates, noise_t, results, rod, sphere

ESTIMATED: tuple[EstimatorName, ...] = ("varpro", "ekf9", "kf-ekf-thesis", "initial")
TARGETS: dict[str, Buried] = {
    "sphere 1 m": sphere(),
    **{f"cylinder {pitch}/{roll}": rod(pitch, roll) for pitch, roll in
       ((0, 0), (30, 0), (45, 45), (60, 0), (90, 0), (0, 90))},
    "sphere 0.4 m": sphere(0.4),
    "sphere 0.6 m": sphere(0.6),
    "sphere 1.5 m": sphere(1.5),
    "sphere 2 m": sphere(2.0),
}  # fmt: skip
COVERED = 0.95


class Efficiency(NamedTuple):
    """One target at one SNR, by one estimator.

    Attributes:
        target, snr_db, estimator, n: what was measured, and with how many draws.
        bound_cm: root of the trace of the bound of the position.
        ratio: root mean square error of the position by it.
        coverage: share of the draws whose 95 % ellipsoid of position and tensor holds the truth; None where none is
            told.
    """

    target: str
    snr_db: float
    estimator: EstimatorName
    n: int
    bound_cm: float
    ratio: float
    coverage: float | None


def measured(here: World, runs: int, say: Callable[[float], None]) -> list[Efficiency]:
    """Every target at every SNR, by every estimator."""
    done = []
    for i, (target, body) in enumerate(TARGETS.items()):
        for snr in SNRS_DB:
            done += [_one(here, target, body, snr, name, runs) for name in ESTIMATED]
        say((i + 1) / len(TARGETS))
    return done


def _one(here: World, target: str, body: Buried, snr_db: float, name: EstimatorName, runs: int) -> Efficiency:
    field = clean_t(here.geometry, body)
    sigma, n = noise_t(field, snr_db), runs_of(name, runs)
    least = np.sqrt(np.trace(bound(here, body, sigma)[:3, :3]))
    fields = draws(field, sigma, n, seed=int(snr_db))
    coverage = None
    if name == "varpro":
        position, coverage = _default(here, body, fields, sigma)
    else:
        position = estimates(name, here, fields, sigma).position_m
    rms = np.sqrt(((position - body.position_m[0]) ** 2).sum(1).mean())
    return Efficiency(target, snr_db, name, n, float(100.0 * least), float(rms / least), coverage)


def _default(here: World, body: Buried, fields: FloatArray, sigma: float) -> tuple[FloatArray, float]:
    """Positions as they are answered, and how often the truth lies within the ellipsoid."""
    limit, places, covered = chi2.ppf(COVERED, 9), [], []
    for result in results(here, fields, sigma):
        for target in result.targets[:1]:
            error = np.concatenate([target.position_m - body.position_m[0], target.tensor_m3[0] - body.elements_m3[0]])
            places.append(target.position_m)
            covered.append(error @ np.linalg.solve(target.covariance, error) < limit)
    return np.array(places), float(np.mean(covered))
