"""How filters move: each model over its own dt, and the models' mixing before it.

The models share one state, so that a hypothesis keeps what it knows when the model changes:

* Singer: position, velocity and an acceleration that is forgotten (``singer``), each axis for itself;
* constant velocity: the acceleration is set to its prior, uncorrelated, and white acceleration drives the velocity;
* random walk: so is the velocity, and white velocity drives the position.

Bias and scale of ranges drift slowly in all of them. With dt = 0 nothing changes.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.estimation.motion import CONSTANT_VELOCITY, SINGER
from trackmesh.services.tags import singer
from trackmesh.services.tags.records import BIAS, SCALE, Filter, Rules, Work

FloatArray = npt.NDArray[np.float64]


@kernel
def predict(rules: Rules, f: Filter, t_s: float, w: Work) -> None:
    """Predict a filter to ``t_s`` in place; a time that is not later changes nothing.

    Models are left after exponential times of mean tau for any other one, so over dt the probability to stay is
    1/r + (1 - 1/r) exp(-r dt / ((r - 1) tau)).
    """
    dt_s = t_s - f.t_s
    if dt_s <= 0.0:
        return
    r = len(f.mu)
    if r > 1:
        stay = 1.0 / r + (1.0 - 1.0 / r) * math.exp(-r * dt_s / ((r - 1) * rules.sojourn_s))
        _mix(f, stay, w)
    for axis in range(2):
        singer.transition(f.alpha[axis], dt_s, w.step[axis])
    for j in range(r):
        _predict_model(rules, f, j, dt_s, w)
    f.t_s = t_s


@kernel
def _predict_model(rules: Rules, f: Filter, j: int, dt_s: float, w: Work) -> None:
    x, P, kind, d = f.x[j], f.P[j], rules.kind[j], f.x.shape[1]
    if kind == SINGER:
        _move_singer(x, P, dt_s, w.step)
        for axis in range(2):
            if axis == 0 or f.alpha[1] != f.alpha[0] or f.variance[1] != f.variance[0]:
                singer.noise(f.alpha[axis], f.variance[axis], dt_s, w.block)
            _add_noise(P, axis, w.block)
    else:
        for axis in range(2):
            _forget(x, P, 4 + axis, f.variance[axis])
            if kind == CONSTANT_VELOCITY:
                _move_velocity(x, P, axis, dt_s, rules.velocity)
            else:
                _forget(x, P, 2 + axis, rules.speed_variance)
                P[axis, axis] += rules.walk * dt_s
    if d > BIAS:
        P[BIAS, BIAS] += rules.bias_drift * dt_s
        P[SCALE, SCALE] += rules.scale_drift * dt_s
    for a in range(d):
        for b in range(a):
            P[a, b] = P[b, a]


@inlined
def _move_singer(x: FloatArray, P: FloatArray, dt_s: float, step: FloatArray) -> None:
    """Write F x and F P F^T over x and P, rows first, then columns."""
    d = len(x)
    for i in range(2):
        pa, va, keep = step[i, 0], step[i, 1], step[i, 2]
        x[i] += dt_s * x[i + 2] + pa * x[i + 4]
        x[i + 2] += va * x[i + 4]
        x[i + 4] *= keep
        for c in range(d):
            P[i, c] += dt_s * P[i + 2, c] + pa * P[i + 4, c]
            P[i + 2, c] += va * P[i + 4, c]
            P[i + 4, c] *= keep
    for i in range(2):
        pa, va, keep = step[i, 0], step[i, 1], step[i, 2]
        for c in range(d):
            P[c, i] += dt_s * P[c, i + 2] + pa * P[c, i + 4]
            P[c, i + 2] += va * P[c, i + 4]
            P[c, i + 4] *= keep


@inlined
def _add_noise(P: FloatArray, i: int, block: FloatArray) -> None:
    """Add the noise of an axis to the upper triangle."""
    P[i, i] += block[0]
    P[i, i + 2] += block[1]
    P[i, i + 4] += block[2]
    P[i + 2, i + 2] += block[3]
    P[i + 2, i + 4] += block[4]
    P[i + 4, i + 4] += block[5]


@inlined
def _move_velocity(x: FloatArray, P: FloatArray, i: int, dt_s: float, density: float) -> None:
    d = len(x)
    x[i] += dt_s * x[i + 2]
    for c in range(d):
        P[i, c] += dt_s * P[i + 2, c]
    for c in range(d):
        P[c, i] += dt_s * P[c, i + 2]
    P[i, i] += density * dt_s**3 / 3.0
    P[i, i + 2] += density * dt_s * dt_s / 2.0
    P[i + 2, i + 2] += density * dt_s


@inlined
def _forget(x: FloatArray, P: FloatArray, i: int, variance: float) -> None:
    """Set a state to its prior: mean nought, uncorrelated."""
    x[i] = 0.0
    for c in range(len(x)):
        P[i, c] = P[c, i] = 0.0
    P[i, i] = variance


@kernel
def _mix(f: Filter, stay: float, w: Work) -> None:
    """Mix the models in place; mu becomes the predicted c_j = sum_a mu_a pi_aj.

    x0_j = sum_a W_aj x_a, P0_j = sum_a W_aj (P_a + (x_a - x0_j)(x_a - x0_j)^T), W_aj = mu_a pi_aj / c_j.
    """
    r, d = f.x.shape
    leave = (1.0 - stay) / (r - 1)
    for j in range(r):
        w.c[j] = 0.0
        for a in range(r):
            w.weight[a, j] = f.mu[a] * (stay if a == j else leave)
            w.c[j] += w.weight[a, j]
        w.c[j] = max(w.c[j], 1e-300)
        for a in range(r):
            w.weight[a, j] /= w.c[j]
        moments(f.x, f.P, w.weight[:, j], w.x[j], w.P[j])
    for j in range(r):
        f.mu[j] = w.c[j]
        for a in range(d):
            f.x[j, a] = w.x[j, a]
            for b in range(d):
                f.P[j, a, b] = w.P[j, a, b]


@kernel
def moments(x: FloatArray, P: FloatArray, weight: FloatArray, mean: FloatArray, covariance: FloatArray) -> None:
    """Write mean (d,) and covariance (d, d) of a mixture of r Gaussians x (r, >= d), P (r, >= d, >= d)."""
    r, d = len(x), len(mean)
    for a in range(d):
        value = 0.0
        for j in range(r):
            value += weight[j] * x[j, a]
        mean[a] = value
    for a in range(d):
        for b in range(a, d):
            value = 0.0
            for j in range(r):
                value += weight[j] * (P[j, a, b] + (x[j, a] - mean[a]) * (x[j, b] - mean[b]))
            covariance[a, b] = value
            covariance[b, a] = value
