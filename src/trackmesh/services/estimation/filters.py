"""The named filters: which branches and models each one has."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from trackmesh.services.estimation.bank import Branch
from trackmesh.services.estimation.motion import (
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    RANDOM_WALK,
    SINGER,
    TANGENTIAL,
    TURN,
    Model,
)

FilterName = Literal["tvimm", "tvimm-dirichlet", "tvimm-paper", "imm", "alpha-beta"]


def velocity_models(q_m2ps3: list[float], sojourn_s: list[float], prior_count: float = math.inf) -> Branch:
    """One branch of constant-velocity models of different noise."""
    models = tuple(Model(f"cv-{q:g}", CONSTANT_VELOCITY, q) for q in q_m2ps3)
    return Branch(models, tuple(sojourn_s), prior_count=prior_count)


def manoeuvre_models(
    turn_rate_max_radps: float, acceleration_max_mps2: float, manoeuvre_s: float, quiet_s: float, q_quiet: float
) -> Branch:
    """Models whose turn rate and tangential acceleration are estimated per track.

    Args:
        turn_rate_max_radps: fastest turn expected. acceleration_max_mps2: strongest acceleration expected.
        manoeuvre_s, quiet_s: typical length of a manoeuvre, and of the time between.
        q_quiet: acceleration noise of quiet flight, m/s^1.5 (the square root of its spectral density).
    """
    w, a, t = turn_rate_max_radps, acceleration_max_mps2, manoeuvre_s
    q = (0.06 * a) ** 2
    models = (
        Model("cv", CONSTANT_VELOCITY, q_quiet**2),
        Model("turn-left", TURN, q, 0.55 * w, 0.23 * w, 100.0),
        Model("turn-right", TURN, q, -0.55 * w, 0.23 * w, 100.0),
        Model("speed-change", TANGENTIAL, q, 0.0, 0.6 * a, 100.0),
        Model("singer", SINGER, (0.03 * a) ** 2, 0.0, a, 0.45 * t),
    )
    c, f, s = 0.8, 0.08, 0.04
    jumps = np.array(
        [
            [0, 0.8 / 3, 0.8 / 3, 0.8 / 3, 0.2],
            [c, 0, f, f, s],
            [c, f, 0, f, s],
            [c, f, f, 0, s],
            [0.6, *[0.4 / 3] * 3, 0],
        ]
    )
    return Branch(
        models,
        (1.2 * quiet_s, *[1.4 * t] * 4),
        jumps,
        start=(0.7, 0.08, 0.08, 0.08, 0.06),
        age_s=(0.25 * quiet_s, *[0.7 * t] * 4),
        split_s=3.0,
    )


def generic_models(acceleration_max_mps2: float, manoeuvre_s: float, quiet_s: float, q_quiet: float) -> Branch:
    """A plain three-model filter for everything that is no turn and no speed change."""
    a, t = acceleration_max_mps2, manoeuvre_s
    models = (
        Model("generic-cv", CONSTANT_VELOCITY, (0.5 * q_quiet) ** 2),
        Model("generic-singer", SINGER, 0.3**2, 0.0, 0.9 * a, 0.45 * t),
        Model("generic-rough", CONSTANT_VELOCITY, (0.6 * a) ** 2),
    )
    jumps = np.array([[0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    return Branch(models, (1.15 * quiet_s, 3.0 * t, 3.0 * t), jumps, start=(0.8, 0.1, 0.1))


def with_more_noise(branch: Branch, q_m2ps3: float) -> Branch:
    """The branch with ``q_m2ps3`` more of acceleration noise in every model.

    Raises:
        ValueError: a model has noise of another kind (random walk, constant acceleration).
    """
    if any(model.kind in (RANDOM_WALK, CONSTANT_ACCELERATION) for model in branch.models):
        raise ValueError("q of random walk and constant acceleration is no acceleration noise")
    return branch._replace(models=tuple(model._replace(q=model.q + q_m2ps3) for model in branch.models))
