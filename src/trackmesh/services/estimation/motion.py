"""Motion models: how one state and its covariance move over dt.

A state is [east_m, north_m, veast, vnorth | own parameters]; own parameters are what a model estimates beside position
and velocity: a turn rate, a tangential acceleration, an acceleration vector. A model is a kind and four numbers;
``predict_model`` is the only function that tells kinds apart, the filter bank knows none of them by name.

x' = f(x) and P' = F P F^T + Q, with F the Jacobian of f. With dt = 0 nothing changes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.estimation.noise import add_along, add_white_acceleration, singer_noise, white_jerk

FloatArray = npt.NDArray[np.float64]

RANDOM_WALK, CONSTANT_VELOCITY, CONSTANT_ACCELERATION, SINGER, TURN, TANGENTIAL = range(6)
"""Kinds of model."""

STATES = (4, 4, 6, 6, 5, 5)
"""Length of the state of each kind; the first four are position and velocity."""

LEAST_SPEED_MPS = 1.0


class Model(NamedTuple):
    """One motion model.

    Attributes:
        name: as it stands in frames.
        kind: one of the kinds above.
        q: spectral density of white noise: of the acceleration in m^2/s^3; of the velocity in m^2/s for a random walk,
            of the jerk in m^2/s^5 for constant acceleration.
        mean, sd: prior of the own parameters, to which they are set whenever the model is entered (rad/s, m/s^2).
        time_s: correlation time of the own parameters.
    """

    name: str
    kind: int
    q: float
    mean: float = 0.0
    sd: float = 0.0
    time_s: float = 1.0


@kernel
def predict_model(
    kind: int,
    numbers: FloatArray,
    x: FloatArray,
    P: FloatArray,
    dt_s: float,
    F: FloatArray,
    product: FloatArray,
    block: FloatArray,
) -> None:
    """Predict a state (>= d,) and its covariance (>= d, >= d) in place over ``dt_s`` >= 0.

    Args:
        kind: of the model. numbers: (4,) its q, mean, sd, time_s.
        x, P: state and covariance, of which the first d = STATES[kind] components are used.
        dt_s: seconds.
        F: (6, 6), written by all kinds but random walk and constant velocity (see ``linear_flow``).
        product, block: (6, 6), (6,) scratch.
    """
    if dt_s <= 0.0:
        return
    if kind == CONSTANT_VELOCITY:
        predict_constant_velocity(x, P, dt_s, numbers[0])
    elif kind == RANDOM_WALK:
        P[0, 0] += numbers[0] * dt_s
        P[1, 1] += numbers[0] * dt_s
    elif kind == TURN:
        _predict_turn(numbers, x, P, dt_s, F, product, block)
    elif kind == TANGENTIAL:
        _predict_tangential(numbers, x, P, dt_s, F, product, block)
    else:
        _predict_acceleration(kind, numbers, x, P, dt_s, F, product, block)


@kernel
def linear_flow(kind: int, dt_s: float, F: FloatArray) -> None:
    """Write F (>= 4, >= 4) of random walk and constant velocity; other kinds change nothing."""
    if kind in (CONSTANT_VELOCITY, RANDOM_WALK):
        _identity(F, 4)
        if kind == CONSTANT_VELOCITY:
            F[0, 2] = F[1, 3] = dt_s


@kernel
def predict_constant_velocity(x: FloatArray, P: FloatArray, dt_s: float, q: float) -> None:
    """Predict a constant-velocity state in place.

    F = [[I, dt I], [0, I]] and the continuous white-noise acceleration
    Q = q [[dt^3/3 I, dt^2/2 I], [dt^2/2 I, dt I]] (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2).

    Args:
        x: (4,) state. P: (4, 4) covariance, symmetric.
        dt_s: seconds, >= 0.
        q: spectral density of the acceleration, m^2/s^3.
    """
    x[0] += dt_s * x[2]
    x[1] += dt_s * x[3]
    # Blocks: position-position, position-velocity, velocity-velocity; each line uses old values of those below it.
    for i in range(2):
        for j in range(i, 2):
            P[i, j] += dt_s * (P[i, j + 2] + P[j, i + 2]) + dt_s * dt_s * P[i + 2, j + 2]
        P[i, i] += q * dt_s * dt_s * dt_s / 3.0
    P[1, 0] = P[0, 1]
    for i in range(2):
        for j in range(2):
            P[i, j + 2] += dt_s * P[i + 2, j + 2]
        P[i, i + 2] += q * dt_s * dt_s / 2.0
    for i in range(2):
        for j in range(2):
            P[j + 2, i] = P[i, j + 2]
        P[i + 2, i + 2] += q * dt_s


@kernel
def turn(x: FloatArray, mean: float, time_s: float, dt_s: float, F: FloatArray) -> None:
    """Move [p, v, w] along its circle for ``dt_s`` in place, the turn rate w decaying to ``mean``; F (5, 5) is written.

    p += (S v + C Jv), v rotated by w dt, S = sin(w dt)/w, C = (1 - cos(w dt))/w; w is positive anticlockwise.
    """
    w, ve, vn = x[4], x[2], x[3]
    theta = w * dt_s
    sin, cos = math.sin(theta), math.cos(theta)
    if abs(theta) < 1e-4:
        S, C = dt_s * (1.0 - theta * theta / 6.0), dt_s * theta / 2.0
        dS, dC = -dt_s * dt_s * theta / 3.0, dt_s * dt_s * (0.5 - theta * theta / 8.0)
    else:
        S, C = sin / w, (1.0 - cos) / w
        dS, dC = (dt_s * cos - S) / w, (dt_s * sin - C) / w
    keep = math.exp(-dt_s / time_s)
    _identity(F, 5)
    F[0, 2], F[0, 3], F[0, 4] = S, -C, dS * ve - dC * vn
    F[1, 2], F[1, 3], F[1, 4] = C, S, dC * ve + dS * vn
    F[2, 2], F[2, 3], F[2, 4] = cos, -sin, dt_s * (-sin * ve - cos * vn)
    F[3, 2], F[3, 3], F[3, 4] = sin, cos, dt_s * (cos * ve - sin * vn)
    F[4, 4] = keep
    x[0] += S * ve - C * vn
    x[1] += C * ve + S * vn
    x[2], x[3] = cos * ve - sin * vn, sin * ve + cos * vn
    x[4] = mean + keep * (w - mean)


@kernel
def tangential(x: FloatArray, mean: float, time_s: float, dt_s: float, F: FloatArray) -> None:
    """Move [p, v, a] for ``dt_s`` in place, acceleration a along v decaying to ``mean``; F (5, 5) is written."""
    ve, vn, a = x[2], x[3], x[4]
    speed = math.hypot(ve, vn)
    if speed < LEAST_SPEED_MPS:
        ue, un, turn_of_u = (1.0, 0.0, 0.0) if speed == 0.0 else (ve / speed, vn / speed, 0.0)
    else:
        ue, un, turn_of_u = ve / speed, vn / speed, a / speed
    half, keep = 0.5 * dt_s * dt_s, math.exp(-dt_s / time_s)
    _identity(F, 5)
    # d u / d v = (I - u u^T) / |v|
    ee, en, nn = turn_of_u * (1.0 - ue * ue), -turn_of_u * ue * un, turn_of_u * (1.0 - un * un)
    F[0, 2], F[0, 3], F[0, 4] = dt_s + half * ee, half * en, half * ue
    F[1, 2], F[1, 3], F[1, 4] = half * en, dt_s + half * nn, half * un
    F[2, 2], F[2, 3], F[2, 4] = 1.0 + dt_s * ee, dt_s * en, dt_s * ue
    F[3, 2], F[3, 3], F[3, 4] = dt_s * en, 1.0 + dt_s * nn, dt_s * un
    F[4, 4] = keep
    x[0] += dt_s * ve + half * a * ue
    x[1] += dt_s * vn + half * a * un
    x[2] += dt_s * a * ue
    x[3] += dt_s * a * un
    x[4] = mean + keep * (a - mean)


@kernel
def acceleration_matrix(kind: int, time_s: float, dt_s: float, F: FloatArray) -> None:
    """Write F (6, 6) of [p, v, a]: constant acceleration, or Singer's that decays with ``time_s``."""
    pa, va, keep = 0.5 * dt_s * dt_s, dt_s, 1.0
    if kind == SINGER:
        u = dt_s / time_s
        keep = math.exp(-u)
        va = -time_s * math.expm1(-u)
        # u - 1 + e^-u loses its digits for small u.
        pa = time_s * time_s * (u - 1.0 + keep) if u > 1e-3 else dt_s * dt_s * (0.5 - u / 6.0 + u * u / 24.0)
    _identity(F, 6)
    for i in range(2):
        F[i, i + 2], F[i, i + 4], F[i + 2, i + 4], F[i + 4, i + 4] = dt_s, pa, va, keep


@kernel
def _predict_turn(
    numbers: FloatArray,
    x: FloatArray,
    P: FloatArray,
    dt_s: float,
    F: FloatArray,
    product: FloatArray,
    block: FloatArray,
) -> None:
    speed = math.hypot(x[2], x[3])
    east, north = (1.0, 0.0) if speed == 0.0 else (x[2] / speed, x[3] / speed)
    half = 0.5 * x[4] * dt_s
    cos, sin = math.cos(half), math.sin(half)
    turn(x, numbers[1], numbers[3], dt_s, F)
    _propagate(P, F, product, 5)
    singer_noise(numbers[2], numbers[3], dt_s, block)
    # The turn rate acts across the velocity at half time: |v| times it is an acceleration along the normal.
    block[0] *= speed * speed
    block[1] *= speed * speed
    block[3] *= speed * speed
    block[2] *= speed
    block[4] *= speed
    add_along(P, block, -(sin * east + cos * north), cos * east - sin * north, 4)
    add_white_acceleration(P, numbers[0], dt_s)


@kernel
def _predict_tangential(
    numbers: FloatArray,
    x: FloatArray,
    P: FloatArray,
    dt_s: float,
    F: FloatArray,
    product: FloatArray,
    block: FloatArray,
) -> None:
    speed = math.hypot(x[2], x[3])
    east, north = (1.0, 0.0) if speed == 0.0 else (x[2] / speed, x[3] / speed)
    tangential(x, numbers[1], numbers[3], dt_s, F)
    _propagate(P, F, product, 5)
    singer_noise(numbers[2], numbers[3], dt_s, block)
    add_along(P, block, east, north, 4)
    add_white_acceleration(P, numbers[0], dt_s)


@kernel
def _predict_acceleration(
    kind: int,
    numbers: FloatArray,
    x: FloatArray,
    P: FloatArray,
    dt_s: float,
    F: FloatArray,
    product: FloatArray,
    block: FloatArray,
) -> None:
    acceleration_matrix(kind, numbers[3], dt_s, F)
    for i in range(2):
        x[i] += F[i, i + 2] * x[i + 2] + F[i, i + 4] * x[i + 4]
        x[i + 2] += F[i + 2, i + 4] * x[i + 4]
        x[i + 4] *= F[i + 4, i + 4]
    _propagate(P, F, product, 6)
    if kind == SINGER:
        singer_noise(numbers[2], numbers[3], dt_s, block)
        add_white_acceleration(P, numbers[0], dt_s)
    else:
        white_jerk(numbers[0], dt_s, block)
    add_along(P, block, 1.0, 0.0, 4)
    add_along(P, block, 0.0, 1.0, 5)


@inlined
def _identity(F: FloatArray, d: int) -> None:
    for i in range(d):
        for j in range(d):
            F[i, j] = 1.0 if i == j else 0.0


@inlined
def _propagate(P: FloatArray, F: FloatArray, product: FloatArray, d: int) -> None:
    """P <- F P F^T for a symmetric P, written as one triangle and mirrored.

    Nothing is moved by its position: the first two columns of F are those of the identity.
    """
    for i in range(d):
        for j in range(d):
            value = P[i, j] if i < 2 else 0.0
            for k in range(2, d):
                value += F[i, k] * P[k, j]
            product[i, j] = value
    for i in range(d):
        for j in range(i, d):
            value = product[i, j] if j < 2 else 0.0
            for k in range(2, d):
                value += product[i, k] * F[j, k]
            P[i, j] = value
            P[j, i] = value
