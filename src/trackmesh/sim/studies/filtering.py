"""Runs the filters of the tracker over simulated targets, and tells their errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation import batch, tracks
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.gating import make_mixture
from trackmesh.services.estimation.plots import Plots, make_plots
from trackmesh.sim.studies.manoeuvre_targets import Measured

START_VELOCITY_SIGMA_MPS = 20.0
_START_SEED = 99


class Estimates(NamedTuple):
    """What a filter says at scans 1 to T of each run: mean (T, runs, 4), covariance (T, runs, 4, 4), model weights."""

    mean: FloatArray
    covariance: FloatArray
    mu: FloatArray


def plots_of(case: Measured) -> Plots:
    """The plots of a case, (T, runs)."""
    runs, scans = case.plots.shape[:2]
    R = np.tile([case.sigma_m**2, 0.0, case.sigma_m**2], (runs, 1))
    times = case.period_s * np.arange(1, scans + 1)
    return np.array([make_plots(case.plots[:, k], R, times[k]) for k in range(scans)])


def run_filter(
    models: Models, case: Measured, *, plots: Plots | None = None, detected: FloatArray | None = None, lag: int = 0
) -> Estimates:
    """Filter every run, started about the truth by an error that depends on the case alone.

    Args:
        plots: (T, runs), where they are others than the positions of the case.
        detected: (runs, T), below 0.5 where a scan has no plot: there the filter predicts.
        lag: tell the state of so many plots ago instead, at its scan; the last scans stay as they are known live. Only
            with every plot there.
    """
    runs, scans = case.plots.shape[:2]
    found = plots_of(case) if plots is None else plots
    bank = batch.make_bank(models, runs)
    batch.begin(bank, _start_plots(case), START_VELOCITY_SIGMA_MPS)
    states = bank.states
    states["x"][:, :, 2:4] = _start(case)[:, None, 2:]
    out = Estimates(
        np.empty((scans, runs, 4)), np.empty((scans, runs, 4, 4)), np.empty((scans, runs, len(models.kind)))
    )
    mixture = make_mixture(runs, len(models.kind))
    for k in range(scans):
        if detected is None:
            batch.filter_plots(bank, found[k])
        else:
            seen = detected[:, k] > 0.5
            # Records are copied by a mask: write them back.
            hit, missed = states[seen], states[~seen]
            batch.filter_plots(bank._replace(states=hit), found[k][seen])
            batch.predict(bank._replace(states=missed), np.full(len(missed), case.period_s * (k + 1)))
            states[seen], states[~seen] = hit, missed
        batch.mixtures(bank, mixture)
        out.mean[k], out.covariance[k] = tracks.estimates(models, mixture)
        out.mu[k] = mixture.mu
        if lag and k >= lag:
            batch.lagged(bank, lag, mixture)
            out.mean[k - lag], out.covariance[k - lag] = tracks.estimates(models, mixture)
    return out


def _start_plots(case: Measured) -> Plots:
    R = np.tile([case.sigma_m**2, 0.0, case.sigma_m**2], (len(case.truth), 1))
    return make_plots(_start(case)[:, :2], R, 0.0)


def _start(case: Measured) -> FloatArray:
    sigma = np.array([case.sigma_m, case.sigma_m, START_VELOCITY_SIGMA_MPS, START_VELOCITY_SIGMA_MPS])
    rng = np.random.default_rng(_START_SEED)
    return np.asarray(case.truth[:, 0] + sigma * rng.normal(size=(len(case.truth), 4)))


def errors(estimates: Estimates, case: Measured) -> FloatArray:
    """Estimate minus truth, (T, runs, 4)."""
    return np.asarray(estimates.mean - np.swapaxes(case.truth[:, 1:], 0, 1))


def nees(estimates: Estimates, case: Measured) -> FloatArray:
    """Normalised estimation error squared of position and velocity, (T, runs); 4 on average where P is right."""
    off = errors(estimates, case)
    return np.asarray(np.einsum("tri,tri->tr", off, np.linalg.solve(estimates.covariance, off[..., None])[..., 0]))
