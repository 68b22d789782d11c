"""The four filters of Luan, Yu, Gu and Zhao (2021), over many runs at once: plain numpy, equations as numbered there.

"A time varying IMM fusion target tracking method", Application of Electronic Technique 47(9), 111-116. In their TV-IMM
each model filters a measurement of its own; then the models' densities are multiplied (14, 15), the probabilities are
taken from where a model lies in that product (16 to 18), and the transitions from where it lies in the other model
(19 to 21). ``imm`` is what they compare with: the same mixing and filtering, fixed transitions, probabilities from the
innovations, mean and covariance of the mixture as output.

The print needs corrections; what is computed here:

* the sums of (5) and (6) run over i, and (3) speaks of the normalised probabilities: column j sums to one;
* the mean of (8) gets no noise; (9) takes K S K^T away from the predicted covariance;
* d in (10) is the number of states of model j; (12) is the integral of x p(x);
* (14) is x = P sum_j P_j^-1 x_j: the inverses stand inside the sum, the weighted states too;
* (16) to (18) leave out the probability with which a model was entered, and so does this, since it is the method.

Probabilities are kept as logarithms: far from each other, the densities of (16) and (19) are zero in floating point.
Runs are the leading axis n, then models r, then states [x, y, vx, vy].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

STATES = 4
P_START = np.eye(STATES)
"""Covariance of every filter at the start, where its state is exact; the paper names none."""

TRANSITIONS = np.array([[0.95, 0.05], [0.05, 0.95]])
"""Of the conventional IMM (24), and the first ones of TV-IMM."""


class Model(NamedTuple):
    """A model of motion and measurement (7), all constant in time.

    Attributes:
        phi: transition of the state (4, 4).
        Q: covariance of the motion's noise (4, 4).
        H: measurement matrix (m, 4).
        R: covariance of the measurement's noise (m, m).
        phi_P: transition of the covariance where it is not ``phi``, which no sound filter has.
    """

    phi: FloatArray
    Q: FloatArray
    H: FloatArray
    R: FloatArray
    phi_P: FloatArray | None = None


class Track(NamedTuple):
    """Estimates after each measurement: mean (t, n, 4) and covariance (t, n or 1, 4, 4)."""

    x: FloatArray
    P: FloatArray


class Bank(NamedTuple):
    """Models' states (n, r, 4), covariances (n, r, 4, 4), log-probabilities (n, r) and log-transitions (n, r, r)."""

    x: FloatArray
    P: FloatArray
    log_mu: FloatArray
    log_pi: FloatArray


class Filtered(NamedTuple):
    """A model after its update: state, covariance, innovation (n, m) and its covariance (n, m, m)."""

    x: FloatArray
    P: FloatArray
    innovation: FloatArray
    S: FloatArray


def kalman(model: Model, z: FloatArray, start: FloatArray) -> Track:
    """One model alone on measurements ``z`` (t, n, m), from the state ``start`` (4,) on."""
    x, P = np.broadcast_to(start, (z.shape[1], STATES)), P_START[None]
    steps = []
    for z_k in z:
        x, P, *_ = filtered(model, x, P, z_k)
        steps.append((x, P))
    return _track(steps)


def tvimm(models: Sequence[Model], z: Sequence[FloatArray], start: FloatArray) -> Track:
    """The paper's TV-IMM; model j sees ``z[j]`` (t, n, m_j) only."""
    return _run(models, z, start, tvimm_step)


def imm(models: Sequence[Model], z: Sequence[FloatArray], start: FloatArray) -> Track:
    """The conventional IMM as the paper compares with; model j sees ``z[j]`` (t, n, m_j) only.

    Models that measure unlike vectors are weighed by densities of unlike dimension, which no theory supports.
    """
    return _run(models, z, start, imm_step)


def tvimm_step(models: Sequence[Model], bank: Bank, z: Sequence[FloatArray]) -> tuple[Bank, FloatArray, FloatArray]:
    """One cycle of TV-IMM (2 to 21): the next bank, and the fused state (n, 4) and covariance (n, 4, 4)."""
    x, P, _ = filter_all(models, *mix(bank), z)
    fused_x, fused_P = product(x, P)
    next_bank = Bank(x, P, paper_log_probabilities(x, fused_x, fused_P), paper_log_transitions(x, P))
    return next_bank, fused_x, fused_P


def imm_step(models: Sequence[Model], bank: Bank, z: Sequence[FloatArray]) -> tuple[Bank, FloatArray, FloatArray]:
    """One cycle of the IMM: the next bank, and mean and covariance of the mixture."""
    x, P, log_likelihood = filter_all(models, *mix(bank), z)
    log_mu = log_normalised(log_prior(bank) + log_likelihood)
    return Bank(x, P, log_mu, bank.log_pi), *mixture(np.exp(log_mu), x, P)


def log_prior(bank: Bank) -> FloatArray:
    """Log-probability (n, r) of entering each model: log sum_i mu_i pi_ij."""
    return np.asarray(np.logaddexp.reduce(bank.log_mu[:, :, None] + bank.log_pi, axis=1))


def mix(bank: Bank) -> tuple[FloatArray, FloatArray]:
    """Mixed states (n, r, 4) and covariances (n, r, 4, 4) that the models start from (2 to 6)."""
    log_weight = bank.log_mu[:, :, None] + bank.log_pi
    weight = np.exp(log_weight - log_prior(bank)[:, None, :]).swapaxes(1, 2)
    x = weight @ bank.x
    apart = bank.x[:, None] - x[:, :, None]
    spread = (weight[..., None] * apart).swapaxes(-1, -2) @ apart
    return x, (weight @ _flat(bank.P)).reshape(bank.P.shape) + spread


def filter_all(
    models: Sequence[Model], x: FloatArray, P: FloatArray, z: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Every model predicted and updated: states, covariances, log-likelihoods (n, r) of the innovations."""
    found = [filtered(m, x[:, j], P[:, j], z_j) for j, (m, z_j) in enumerate(zip(models, z, strict=True))]
    log_likelihood = np.stack([log_normal(f.innovation, f.S) for f in found], axis=1)
    return np.stack([f.x for f in found], axis=1), np.stack([f.P for f in found], axis=1), log_likelihood


def filtered(model: Model, x: FloatArray, P: FloatArray, z: FloatArray) -> Filtered:
    """One step of the Kalman filter (8, 9) from states (n, 4) and covariances (n or 1, 4, 4)."""
    phi_P = model.phi if model.phi_P is None else model.phi_P
    x, P = x @ model.phi.T, phi_P @ P @ phi_P.T + model.Q
    innovation, HP = z - x @ model.H.T, model.H @ P
    S = HP @ model.H.T + model.R
    gain_T = np.asarray(np.linalg.solve(S, HP), np.float64)
    P = P - HP.swapaxes(-1, -2) @ gain_T
    return Filtered(x + _apply(gain_T, innovation), 0.5 * (P + P.swapaxes(-1, -2)), innovation, S)


def product(x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Product of the models' Gaussians (14, 15): right for independent estimates, and for no others."""
    information = _symmetric_inverse(P)
    fused_P = _symmetric_inverse(information.sum(axis=1))
    return _apply(fused_P, _apply(information, x).sum(axis=1)), fused_P


def mixture(mu: FloatArray, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (n, 4) and covariance (n, 4, 4) of the mixture of the models with probabilities ``mu`` (n, r)."""
    mean = (mu[:, None] @ x)[:, 0]
    apart = x - mean[:, None]
    spread = (mu[..., None] * apart).swapaxes(-1, -2) @ apart
    return mean, (mu[:, None] @ _flat(P)).reshape(-1, *P.shape[2:]) + spread


def paper_log_probabilities(x: FloatArray, fused_x: FloatArray, fused_P: FloatArray) -> FloatArray:
    """Log-probabilities (n, r): where each model lies in the product (16 to 18). No measurement enters."""
    return log_normalised(log_normal(x - fused_x[:, None], fused_P[:, None]))


def paper_log_transitions(x: FloatArray, P: FloatArray) -> FloatArray:
    """Log-transitions (n, r, r): where model i lies in the density of model j, rows normalised (19 to 21)."""
    return log_normalised(log_normal(x[:, :, None] - x[:, None], P[:, None]))


def log_normal(apart: FloatArray, P: FloatArray) -> FloatArray:
    """Log of the density N(apart; 0, P) (10), for vectors (..., d) and covariances (..., d, d)."""
    logdet = np.linalg.slogdet(P)[1] + P.shape[-1] * np.log(2.0 * np.pi)
    return np.asarray(-0.5 * (squared_distance(apart, P) + logdet))


def squared_distance(apart: FloatArray, P: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance of vectors (..., d) under covariances (..., d, d)."""
    return np.asarray((apart * np.linalg.solve(P, apart[..., None])[..., 0]).sum(axis=-1))


def log_normalised(log_weight: FloatArray) -> FloatArray:
    """Log of exp(log_weight) / sum over the last axis."""
    return np.asarray(log_weight - np.logaddexp.reduce(log_weight, axis=-1, keepdims=True))


def _run(
    models: Sequence[Model],
    z: Sequence[FloatArray],
    start: FloatArray,
    step: Callable[[Sequence[Model], Bank, Sequence[FloatArray]], tuple[Bank, FloatArray, FloatArray]],
) -> Track:
    n, r = z[0].shape[1], len(models)
    bank = Bank(
        np.broadcast_to(start, (n, r, STATES)),
        np.broadcast_to(P_START, (n, r, STATES, STATES)),
        np.full((n, r), -np.log(r)),
        np.broadcast_to(np.log(TRANSITIONS), (n, r, r)),
    )
    steps = []
    for z_k in zip(*z, strict=True):
        bank, x, P = step(models, bank, z_k)
        steps.append((x, P))
    return _track(steps)


def _track(steps: list[tuple[FloatArray, FloatArray]]) -> Track:
    x, P = zip(*steps, strict=True)
    return Track(np.stack(x), np.stack(P))


def _apply(A: FloatArray, v: FloatArray) -> FloatArray:
    """A^T v for matrices (..., k, d) and vectors (..., k)."""
    return np.asarray((v[..., None, :] @ A)[..., 0, :])


def _flat(P: FloatArray) -> FloatArray:
    return P.reshape(*P.shape[:2], -1)


def _symmetric_inverse(P: FloatArray) -> FloatArray:
    inverse = np.linalg.solve(P, np.eye(P.shape[-1]))
    return 0.5 * (inverse + inverse.swapaxes(-1, -2))
