"""What the manoeuvre filter gains over the generic branch that it contains, on flights with turns and speed changes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from tests.services.estimation.makers import GENERIC, TVIMM, FloatArray

from trackmesh.services.estimation import imm, tracks
from trackmesh.services.estimation.bank import Models, make_models, make_state
from trackmesh.sim.studies.manoeuvre_targets import Measured, random_flights, three_manoeuvres

START_VELOCITY_SIGMA = 20.0
GENERIC_ONLY = make_models((GENERIC,))


class Errors(NamedTuple):
    """RMS errors of position (m) and velocity (m/s) over all scans and runs, and the mean of NEES / 4."""

    position: float
    velocity: float
    anees: float


def errors(models: Models, case: Measured) -> Errors:
    """Filter every run, started about the truth by an error that depends on the case alone."""
    runs, scans = case.plots.shape[:2]
    s, w = make_state(models, runs), imm.make_work(models, int(models.states.max()))
    R = np.array([case.sigma_m**2, 0.0, case.sigma_m**2])
    mu = np.empty((runs, len(models.kind)))
    start = _start(case)
    for i in range(runs):
        imm.begin(models, s, i, start[i, :2], R, 0.0, START_VELOCITY_SIGMA)
        s.x[i, :, 2:4] = start[i, 2:]
    off, nees = np.empty((scans, runs, 4)), np.empty((scans, runs))
    for k in range(scans):
        for i in range(runs):
            imm.filter_plot(models, s, i, case.plots[i, k], R, (k + 1) * case.period_s, w)
            imm.probabilities(models, s, i, mu[i])
        mean, P = tracks.estimates(models, s.x, s.P, mu)
        off[k] = mean - case.truth[:, k + 1]
        nees[k] = np.einsum("ni,ni->n", off[k], np.linalg.solve(P, off[k][..., None])[..., 0])
    position, velocity = (np.sqrt((part**2).sum(-1).mean()) for part in (off[..., :2], off[..., 2:]))
    return Errors(float(position), float(velocity), float(nees.mean() / 4.0))


def _start(case: Measured) -> FloatArray:
    sigma = np.array([case.sigma_m, case.sigma_m, START_VELOCITY_SIGMA, START_VELOCITY_SIGMA])
    rng = np.random.default_rng(99)
    return np.asarray(case.truth[:, 0] + sigma * rng.normal(size=(len(case.truth), 4)))


@pytest.mark.parametrize(
    ("case", "position", "velocity", "anees"),
    [
        (three_manoeuvres(40, 1.0, 20.0, seed=1), 0.93, 0.88, (0.9, 1.5)),
        (random_flights(30, 1.0, 30.0, 600.0, seed=7), 0.92, 0.85, (0.75, 1.05)),
    ],
    ids=["three manoeuvres", "random flights"],
)
def test_it_beats_its_generic_branch(
    case: Measured, position: float, velocity: float, anees: tuple[float, float]
) -> None:
    ours, generic = errors(TVIMM, case), errors(GENERIC_ONLY, case)
    assert ours.position <= position * generic.position
    assert ours.velocity <= velocity * generic.velocity
    assert anees[0] <= ours.anees <= anees[1]
