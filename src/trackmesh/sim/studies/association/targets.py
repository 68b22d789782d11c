"""The targets of the paper and the plots of its two sensors, many runs at once."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation import uncertain
from trackmesh.sim.legs import unit_vector
from trackmesh.sim.studies.association.setting import ACCELERATION_MPS2, QUIET_MPS, SIDE_M, SWIFT_MPS, Setting


def positions(setting: Setting, runs: int, count: int, rng: np.random.Generator) -> FloatArray:
    """True positions (scans, runs, count, 2): the first half with constant velocity, the others accelerated."""
    shape, quiet = (runs, count), np.arange(count) < count // 2
    start = rng.uniform(0.0, SIDE_M, (*shape, 2))
    speed = np.where(quiet, rng.uniform(*QUIET_MPS, shape), rng.uniform(*SWIFT_MPS, shape))
    pull = np.where(quiet, 0.0, rng.uniform(*ACCELERATION_MPS2, shape))
    heading, pull_heading = rng.uniform(0.0, 2.0 * np.pi, (2, *shape))
    velocity, acceleration = speed[..., None] * unit_vector(heading), pull[..., None] * unit_vector(pull_heading)
    t_s = setting.scan_s * np.arange(setting.scans)[:, None, None, None]
    return np.asarray(start + velocity * t_s + 0.5 * acceleration * t_s * t_s)


def plots(setting: Setting, truth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """What both sensors measure, (scans, 2, runs, count, 2): noise and interference, eqs. (9) and (15) to (17)."""
    shape = (len(truth), 2, *truth.shape[1:])
    noise = setting.noise_m * rng.standard_normal(shape)
    if setting.gaussian_interference:
        interference = setting.interference_m * rng.standard_normal(shape)
    else:
        interference = uncertain.sample(rng, shape, setting.interference_m)
    return np.asarray(truth[:, None] + noise + interference)
