"""The local filters of the paper: one linear filter of constant acceleration, the same gain for all tracks at a scan.

The state is [x, vx, ax, y, vy, ay], eq. (6). Both sensors are equal, so P, the gain and the cross-covariance depend on
the scan alone, and the tracks of all runs are filtered as one array.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.track_distances import cross_covariance
from trackmesh.services.estimation.uncertain import NoiseModel, assumed_variance
from trackmesh.sim.studies.association.setting import Setting

_MEASURED = [0, 3]
"""The states that (11) measures."""


class Scan(NamedTuple):
    """After a scan: states (2, runs, count, 6) of both sensors, P (6, 6) of each, and P_ab (6, 6) of true pairs."""

    x: FloatArray
    P: FloatArray
    Pab: FloatArray


class Model(NamedTuple):
    """F (10), H (11), Q, R and the first P of a filter."""

    F: FloatArray
    H: FloatArray
    Q: FloatArray
    R: FloatArray
    start: FloatArray


def make_model(setting: Setting, noise_model: NoiseModel) -> Model:
    """The filter's model; the traditional noise model leaves interference out of R and Q."""
    dt_s = setting.scan_s
    r = float(assumed_variance(setting.noise_m, setting.interference_m, noise_model))
    q = float(assumed_variance(setting.process_noise_m, setting.process_interference_m, noise_model))
    axis: FloatArray = np.array([[1.0, dt_s, dt_s * dt_s / 2.0], [0.0, 1.0, dt_s], [0.0, 0.0, 1.0]])
    both: FloatArray = np.eye(2)
    return Model(
        F=np.asarray(np.kron(both, axis), float),
        H=np.asarray(np.kron(both, np.eye(1, 3)), float),
        Q=np.diag([q, 0.0, setting.jerk * dt_s] * 2),
        R=r * both,
        start=np.diag([r, setting.velocity_mps**2, setting.acceleration_mps2**2] * 2),
    )


def filtered(model: Model, plots: FloatArray) -> Iterator[Scan]:
    """Filter plots (scans, 2, runs, count, 2), scan by scan; every track starts at its first plot, at rest."""
    n = len(model.F)
    x, P, Pab = np.zeros((*plots.shape[1:-1], n)), model.start, np.zeros((n, n))
    x[..., _MEASURED] = plots[0]
    yield Scan(x, P, Pab)
    for z in plots[1:]:
        predicted = model.F @ P @ model.F.T + model.Q
        gain = np.linalg.solve(model.H @ predicted @ model.H.T + model.R, model.H @ predicted).T
        kept = np.eye(n) - gain @ model.H
        x = x @ model.F.T
        x = x + (z - x[..., _MEASURED]) @ gain.T
        P = kept @ predicted @ kept.T + gain @ model.R @ gain.T
        Pab = cross_covariance(Pab, model.F, model.Q, kept, kept)
        yield Scan(x, P, Pab)
