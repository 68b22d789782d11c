"""The joint extended Kalman filter as an estimator."""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.estimators.appraisal import appraise
from trackmesh.services.emi.estimators.fit import Fit, Task
from trackmesh.services.emi.estimators.start import power_map, start_points
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.recursive import joint_filter
from trackmesh.services.emi.varpro import depth_of, evaluate, linear_part

SD_POSITION = (0.15, 0.05, 0.02)
"""Initial standard deviation of each coordinate in the passes, in depths: each begins where the last one ended, and
stays nearer to it, for its linearisation."""
SD_TENSOR = (0.75, 0.25, 0.1)
"""Of each element, in norms of the tensor there."""


def ekf9(task: Task) -> Fit:
    """The joint filter, a few times over the samples, from the core of the amplitude map.

    The noise is that of the weights, the target does not move.
    """
    sensor, y, w, ground = task.sensor, task.y, task.w, task.ground
    place = start_points(sensor, power_map(sensor, y, w), ground)[:1]
    n_c, after = len(y), 3 + N_TENSOR * len(y)
    tensor, _, _ = linear_part(evaluate(sensor, y, w, np.arange(y.shape[1]), place, np.zeros((n_c, 1, N_TENSOR))))
    levels = np.zeros(sensor.basis.shape[1] * y.shape[2] * n_c)
    state = np.concatenate([place[0], tensor.ravel(), levels])
    for sd_position, sd_tensor in zip(SD_POSITION, SD_TENSOR, strict=True):
        size = np.linalg.norm(state[3:after].reshape(n_c, N_TENSOR), axis=1)
        sd = np.concatenate(
            [
                np.full(3, sd_position * depth_of(state[:3], ground.bounds)),
                np.repeat(np.maximum(sd_tensor * size, 1e-30), N_TENSOR),
                np.full(len(levels), np.abs(y).max()),
            ]
        )
        covariance = np.diag(sd**2)
        covariance[:3, :3] = _with_prior(covariance[:3, :3], ground.prior.information)
        state, _ = joint_filter(sensor, y, w, state, covariance)
        state[:3] = np.clip(state[:3], ground.bounds.lower_m, ground.bounds.upper_m)
    return appraise(task, state[:3], state[3:after].reshape(n_c, N_TENSOR))


def _with_prior(covariance: FloatArray, information: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + information))
