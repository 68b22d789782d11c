"""What the manoeuvre filter, and a look back, gain on flights with turns and speed changes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from tests.services.estimation.makers import GENERIC, LAGGED, TVIMM, TVIMM_LAGGED, FloatArray

from trackmesh.services.estimation import batch, tracks
from trackmesh.services.estimation.bank import Models, make_models
from trackmesh.services.estimation.batch import Bank
from trackmesh.services.estimation.gating import make_mixture
from trackmesh.services.estimation.plots import make_plots
from trackmesh.sim.studies.manoeuvre_targets import Measured, random_flights, three_manoeuvres

START_VELOCITY_SIGMA = 20.0
GENERIC_ONLY = make_models((GENERIC,))
CASES = {
    "three manoeuvres": three_manoeuvres(40, 1.0, 20.0, seed=1),
    "random flights": random_flights(30, 1.0, 30.0, 600.0, seed=7),
}


class Errors(NamedTuple):
    """RMS errors of position (m) and velocity (m/s) over all scans and runs, and the mean of NEES / 4."""

    position: float
    velocity: float
    anees: float


def filtered(models: Models, case: Measured) -> Iterator[tuple[int, Bank]]:
    """The filters of every run after each scan, started about the truth by an error that depends on the case alone."""
    bank = batch.make_bank(models, len(case.plots))
    R = np.array([case.sigma_m**2, 0.0, case.sigma_m**2])
    sigma = np.array([case.sigma_m, case.sigma_m, START_VELOCITY_SIGMA, START_VELOCITY_SIGMA])
    start = case.truth[:, 0] + sigma * np.random.default_rng(99).normal(size=(len(case.truth), 4))
    batch.begin(bank, make_plots(start[:, :2], R, 0.0), START_VELOCITY_SIGMA)
    bank.states["x"][..., 2:4] = start[:, None, 2:]
    for k in range(case.plots.shape[1]):
        batch.filter_plots(bank, make_plots(case.plots[:, k], R, (k + 1) * case.period_s))
        yield k + 1, bank


def errors(models: Models, case: Measured, lag: int = 0, until: int | None = None) -> Errors:
    """Errors of the present, or of what is known of some scans ago; those of scans after ``until`` left out."""
    mixture, off, nees = make_mixture(len(case.plots), len(models.kind)), [], []
    for k, bank in filtered(models, case):
        if not lag < k <= (until or np.inf) + lag:
            continue
        if lag:
            batch.lagged(bank, lag, mixture)
        else:
            batch.mixtures(bank, mixture)
        mean, P = tracks.estimates(models, mixture)
        off.append(mean - case.truth[:, k - lag])
        nees.append(np.einsum("ni,ni->n", off[-1], np.linalg.solve(P, off[-1][..., None])[..., 0]))
    position, velocity = (rms(np.array(off)[..., part]) for part in (slice(2), slice(2, 4)))
    return Errors(position, velocity, float(np.mean(nees) / 4.0))


def rms(off: FloatArray) -> float:
    return float(np.sqrt((off**2).sum(axis=-1).mean()))


@pytest.mark.parametrize(
    ("name", "position", "velocity", "anees"),
    [("three manoeuvres", 0.93, 0.88, (0.9, 1.5)), ("random flights", 0.92, 0.85, (0.75, 1.05))],
)
def test_it_beats_its_generic_branch(name: str, position: float, velocity: float, anees: tuple[float, float]) -> None:
    ours, generic = errors(TVIMM, CASES[name]), errors(GENERIC_ONLY, CASES[name])
    assert ours.position <= position * generic.position
    assert ours.velocity <= velocity * generic.velocity
    assert anees[0] <= ours.anees <= anees[1]


@pytest.mark.parametrize("models", [LAGGED, TVIMM_LAGGED], ids=["imm", "tvimm"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_later_plots_refine_where_a_target_was(models: Models, case: Measured) -> None:
    """At the same scans; and what is said of the errors is not too little."""
    until = case.plots.shape[1] - 2
    live, once, twice = (errors(models, case, lag, until) for lag in (0, 1, 2))
    assert once.position < 0.8 * live.position
    assert once.velocity < 0.75 * live.velocity
    assert twice.position < 0.7 * live.position
    assert twice.velocity < 0.55 * live.velocity
    assert 0.5 < twice.anees < once.anees < 1.1
