"""Many filters without rings: one cycle of each, for studies, benchmarks and whoever keeps the rest himself."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import imm
from trackmesh.services.estimation.bank import Models, States, as_array, make_states, make_work
from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FloatArray = npt.NDArray[np.float64]


class Bank(NamedTuple):
    """Filters of n tracks: their states, and the models and the scratch that they share (arrays of one record)."""

    models: npt.NDArray[Any]
    work: npt.NDArray[Any]
    states: States


def make_bank(models: Models, n: int) -> Bank:
    """A bank of n empty filters."""
    return Bank(as_array(models), as_array(make_work(models)), make_states(models, n))


@kernel
def begin(bank: Bank, plots: Plots, sigma_v_mps: float) -> None:
    """Start filter k from plot k, see ``imm.begin``."""
    models = bank.models[0]
    for k in range(len(bank.states)):
        imm.begin(models, bank.states[k], plots[k], sigma_v_mps)


@kernel
def filter_plots(bank: Bank, plots: Plots) -> None:
    """One cycle of each filter: filter k is predicted to the time of plot k, not before its own, and updated by it."""
    models, work = bank.models[0], bank.work[0]
    for k in range(len(bank.states)):
        imm.filter_plot(models, bank.states[k], plots[k], work)


@kernel
def step(bank: Bank, plots: Plots, mean: FloatArray, covariance: FloatArray) -> None:
    """As ``filter_plots``; the moment-matched estimates after it are written: (n, 4) and (n, 4, 4)."""
    models, work = bank.models[0], bank.work[0]
    for k in range(len(bank.states)):
        state = bank.states[k]
        imm.filter_plot(models, state, plots[k], work)
        imm.probabilities(models, state, work.before)
        imm.moment_match(state.x, state.P, work.before, mean[k], covariance[k])


@kernel
def predict(bank: Bank, t_s: FloatArray) -> None:
    """Predict filter k to time t_s[k], in place."""
    models, work = bank.models[0], bank.work[0]
    for k in range(len(bank.states)):
        imm.interact(models, bank.states[k], t_s[k], work)


@kernel
def mixtures(bank: Bank, out: Mixture) -> None:
    """Write position and velocity of all filters, model by model."""
    for k in range(len(bank.states)):
        state = bank.states[k]
        imm.write_mixture(bank.models[0], state, state.x, state.P, out, k)


@kernel
def lagged(bank: Bank, lag: int, out: Mixture) -> None:
    """Write what is now known of ``lag`` plots ago (1 to ``models.lags``)."""
    for k in range(len(bank.states)):
        state = bank.states[k]
        imm.write_mixture(bank.models[0], state, state.y[lag - 1], state.Y[lag - 1], out, k)
