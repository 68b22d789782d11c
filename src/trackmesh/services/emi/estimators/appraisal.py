"""What an answer is worth that is no least-squares solution."""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.diagnosis.covariance import covariance_matrix, fisher_matrix
from trackmesh.services.emi.estimators.fit import Fit, Task, appraised
from trackmesh.services.emi.estimators.residuals import residuals
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.varpro import Local, evaluate


def appraise(task: Task, r_m: FloatArray, tensor_m3: FloatArray) -> Fit:
    """The fit that a position (3,) and tensors (C, 6) are, however they were found.

    They are no least-squares solution, and no better than their distance from one: the Gauss-Newton step to it,
    squared, is the excess of their covariance.
    """
    sensor, y, w = task.sensor, task.y, task.w
    place, tensor = np.ascontiguousarray(r_m[None]), np.ascontiguousarray(tensor_m3[:, None])
    every = np.arange(y.shape[1])
    found = Local(place, tensor, evaluate(sensor, y, w, every, place, tensor), len(every), 1, True)
    fit = appraised(w, found, residuals(sensor, y, w, w, found, False))
    step = gauss_newton_step(found.reduced, tensor_m3)
    return fit._replace(excess=np.outer(step, step))


def gauss_newton_step(reduced: FloatArray, tensor_m3: FloatArray) -> FloatArray:
    """Step (3 + 6 C,) of position and tensors to the least-squares solution, to first order; 0 where undetermined."""
    n_c, a = len(tensor_m3), slice(0, N_TENSOR)
    d, last = slice(N_TENSOR, N_TENSOR + 3), N_TENSOR + 3
    gradient = np.zeros(3 + N_TENSOR * n_c)
    for c in range(n_c):
        gradient[:3] += reduced[c, d, last] - reduced[c, d, a] @ tensor_m3[c]
        gradient[3 + N_TENSOR * c : 9 + N_TENSOR * c] = reduced[c, a, last] - reduced[c, a, a] @ tensor_m3[c]
    inverse, least = covariance_matrix(fisher_matrix(reduced[None]))
    return np.asarray(inverse[0] @ gradient * float(least[0] > 0.0))
