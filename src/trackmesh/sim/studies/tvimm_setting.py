"""The two scenarios of Luan, Yu, Gu and Zhao (2021), section 2.1, and their models, as the print is read here.

A manoeuvring target moves with constant velocity under a random acceleration, a disturbed static one is pushed about
(22). Model 1 measures the position and moves like the target of the scenario; model 2 measures the whole state and
moves with constant velocity in both. Each measurement has noise of its own (23). What the print leaves open is read so:

* "position model" names the measurement, not the motion: without velocity model 1 loses the manoeuvring target;
* dt^4/41 in the manoeuvring Q stands for dt^4/4: with 41 the matrix is indefinite;
* the filters start at the true state with the unit covariance, and there are 150 steps: with so many the scatter
  of model 1 over the runs is about the printed one;
* the error is the distance in the plane, in the unit of the measurements (none is printed; metres and seconds here).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.sim.studies.tvimm_filters import FloatArray, Model

STEPS = 150
DT_S = 0.5
ACCELERATION_MPS2 = 0.2
DISTURBANCE_MPS = 0.2
"""Both are called a in the paper: of the random acceleration, and of the random velocity that pushes the static one."""

PAPER_RUNS = 50

FILTERS = ("model 1", "model 2", "tvimm", "imm")
PRINTED = {
    "1": {"mean": (0.392, 0.279, 0.248, 0.337), "std": (0.029, 0.029, 0.022, 0.044)},
    "2": {"mean": (0.282, 0.738, 0.258, 0.302), "std": (0.028, 0.095, 0.025, 0.036)},
}
"""The printed tables: error of each of the ``FILTERS``."""

NOISE = 0.5
"""b of the paper: of position (m) and of velocity (m/s) alike."""

H1, H2 = np.eye(2, 4), np.eye(4)


class Scenario(NamedTuple):
    """A target: its name, first state (4,), transition (4, 4), and what unit noise (2,) does to the state (4, 2)."""

    name: str
    start: FloatArray
    phi: FloatArray
    G: FloatArray

    @property
    def Q(self) -> FloatArray:
        """Covariance of the noise of the motion."""
        return self.G @ self.G.T


class Draw(NamedTuple):
    """Simulated runs: true states (t, n, 4), and unit noise of both measurements (t, n, 2) and (t, n, 4)."""

    truth: FloatArray
    noise: tuple[FloatArray, FloatArray]

    def measured(self, models: tuple[Model, Model]) -> tuple[FloatArray, FloatArray]:
        """What each model measures with its own noise (23)."""
        first, second = (_measured(self.truth, m, v) for m, v in zip(models, self.noise, strict=True))
        return first, second

    def measured_once(self, models: tuple[Model, Model]) -> tuple[FloatArray, FloatArray]:
        """What both measure when model 1 is given the position out of the measurement of model 2."""
        second = _measured(self.truth, models[1], self.noise[1])
        return second[..., :2], second


def both_axes(one_axis: list[list[float]]) -> FloatArray:
    """A matrix of [position, velocity] for the states [x, y, vx, vy]."""
    return np.kron(np.array(one_axis), np.eye(2))


CONSTANT_VELOCITY = both_axes([[1.0, DT_S], [0.0, 1.0]])
MANOEUVRING = Scenario(
    "manoeuvring target",
    np.array([1.0, 1.0, 0.1, 0.1]),
    CONSTANT_VELOCITY,
    ACCELERATION_MPS2 * both_axes([[DT_S**2 / 2.0], [DT_S]]),
)
STATIC = Scenario(
    "disturbed static target",
    np.array([1.0, 1.0, 0.0, 0.0]),
    np.eye(4),
    DISTURBANCE_MPS * both_axes([[DT_S], [0.0]]),
)


SCENARIOS = {"1": MANOEUVRING, "2": STATIC}
"""By the number of the table."""


def printed_models(scenario: Scenario, velocity_noise: float = NOISE) -> tuple[Model, Model]:
    """Models 1 and 2 with the printed parameters, the noise of the measured velocity apart."""
    R1, R2 = (np.diag(np.square(b)) for b in ([NOISE] * 2, [NOISE, NOISE, velocity_noise, velocity_noise]))
    return Model(scenario.phi, scenario.Q, H1, R1), Model(CONSTANT_VELOCITY, MANOEUVRING.Q, H2, R2)


def fitted_models(scenario: Scenario) -> tuple[Model, Model]:
    """Models with two values chosen to come near the printed tables; the paper states neither.

    The velocity is measured with 0.3 instead of 0.5, and the covariance of model 2 moves like the target of the
    scenario while its state moves with constant velocity, as if one phi had been used twice.
    """
    first, second = printed_models(scenario, velocity_noise=0.3)
    return first, second._replace(phi_P=scenario.phi)


def stacked(models: tuple[Model, Model]) -> tuple[Model, Model]:
    """The same motions, each measuring both measurements together, [z1; z2]."""
    H = np.concatenate([m.H for m in models])
    R = np.zeros((len(H), len(H)))
    R[:2, :2], R[2:, 2:] = (m.R for m in models)
    first, second = (m._replace(H=H, R=R) for m in models)
    return first, second


def simulate(scenario: Scenario, runs: int, rng: np.random.Generator, steps: int = STEPS) -> Draw:
    """Draw ``runs`` targets (22) and the unit noise of what is measured, run by run."""
    noise = rng.standard_normal((runs, steps, 8)).swapaxes(0, 1)
    push = noise[..., :2] @ scenario.G.T
    truth, x = np.empty((steps, runs, 4)), np.broadcast_to(scenario.start, (runs, 4))
    for k in range(steps):
        x = x @ scenario.phi.T + push[k]
        truth[k] = x
    return Draw(truth, (noise[..., 2:4], noise[..., 4:]))


def _measured(truth: FloatArray, model: Model, noise: FloatArray) -> FloatArray:
    return np.asarray(truth @ model.H.T + noise @ np.linalg.cholesky(model.R).T)
