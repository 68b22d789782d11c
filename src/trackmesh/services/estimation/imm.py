"""The interacting multiple model filter of one track, with a transition matrix that may vary in time.

One cycle over dt is ``interact`` (mix and predict) and, with a measurement, ``update``. Two forms, told apart by
``Models.prior_count``:

* ``imm``: Pi(dt) of the continuous-time chain, fixed (Blom and Bar-Shalom 1988);
* ``tvimm-dirichlet``: the transition matrix of each step is the mean of a Dirichlet posterior whose prior is
  ``prior_count`` pseudo-transitions by Pi(dt) and whose data are the expected past transitions of this very track,
  forgotten exponentially (quasi-Bayes, Jilkov and Li 2004). ``prior_count`` infinite gives ``imm`` exactly.

All models are scored on the same measurement; the output is moment-matched.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import predict_constant_velocity
from trackmesh.services.estimation.transition import Chain, chain, stationary, transition_matrix

FloatArray = npt.NDArray[np.float64]

MU_FLOOR = 1e-6
"""No model probability falls below this, so that a model can come back."""


class Models(NamedTuple):
    """The models of a bank and how they change.

    Attributes:
        q: (r,) spectral density of the acceleration of each constant-velocity model, m^2/s^3.
        chain: the Markov chain between them.
        mu0: (r,) model probabilities of a new track.
        prior_count: weight of Pi(dt) against observed transitions; ``inf`` for a fixed matrix.
        memory_s: mean time over which observed transitions are remembered.
        reference_s: interval whose expected transition counts as one.
    """

    q: FloatArray
    chain: Chain
    mu0: FloatArray
    prior_count: float
    memory_s: float
    reference_s: float


def make_models(
    q: FloatArray,
    sojourn_s: FloatArray,
    prior_count: float = np.inf,
    memory_s: float = 80.0,
    reference_s: float = 4.0,
) -> Models:
    """Models from noise densities (r,) m^2/s^3 and mean sojourn times (r,) s.

    Raises:
        ValueError: lengths differ, or a value is not positive.
    """
    q, tau = np.asarray(q, float), np.asarray(sojourn_s, float)
    if q.shape != tau.shape or q.ndim != 1 or not np.all(q > 0):
        raise ValueError("q and sojourn_s must be positive and equally long")
    if not (prior_count > 0 and memory_s > 0 and reference_s > 0):
        raise ValueError("prior_count, memory_s and reference_s must be positive")
    return Models(q, chain(tau), stationary(tau), float(prior_count), float(memory_s), float(reference_s))


@kernel
def step_matrix(models: Models, counts: FloatArray, dt_s: float, pi: FloatArray) -> None:
    """Write the transition matrix of this step into ``pi`` (r, r), from the chain and the track's ``counts`` (r, r)."""
    transition_matrix(models.chain, dt_s, pi)
    if not np.isfinite(models.prior_count):
        return
    r = len(models.q)
    for i in range(r):
        total = 0.0
        for j in range(r):
            pi[i, j] = models.prior_count * pi[i, j] + counts[i, j]
            total += pi[i, j]
        for j in range(r):
            pi[i, j] /= total


@kernel
def mix(x: FloatArray, P: FloatArray, mu: FloatArray, pi: FloatArray, mx: FloatArray, mP: FloatArray) -> None:
    """Mix the models' states in place and replace ``mu`` by the predicted probabilities c_j = sum_i mu_i pi_ij.

    x0_j = sum_i w_ij x_i, P0_j = sum_i w_ij (P_i + (x_i - x0_j)(x_i - x0_j)^T), w_ij = mu_i pi_ij / c_j.

    Args:
        x: (r, d) states. P: (r, d, d) covariances. mu: (r,) probabilities. pi: (r, r).
        mx, mP: scratch of the shapes of x and P.
    """
    r, d = x.shape
    c = np.zeros(r)
    for j in range(r):
        for i in range(r):
            c[j] += mu[i] * pi[i, j]
        c[j] = max(c[j], 1e-300)
        for a in range(d):
            mx[j, a] = 0.0
            for i in range(r):
                mx[j, a] += mu[i] * pi[i, j] / c[j] * x[i, a]
        for a in range(d):
            for b in range(a, d):
                value = 0.0
                for i in range(r):
                    w = mu[i] * pi[i, j] / c[j]
                    value += w * (P[i, a, b] + (x[i, a] - mx[j, a]) * (x[i, b] - mx[j, b]))
                mP[j, a, b] = value
                mP[j, b, a] = value
    for j in range(r):
        mu[j] = c[j]
        for a in range(d):
            x[j, a] = mx[j, a]
            for b in range(d):
                P[j, a, b] = mP[j, a, b]


@kernel
def interact(
    models: Models,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    counts: FloatArray,
    dt_s: float,
    pi: FloatArray,
    mx: FloatArray,
    mP: FloatArray,
) -> None:
    """Mix and predict one track over ``dt_s`` in place; ``pi`` receives the transition matrix used. dt = 0: nothing."""
    r = len(mu)
    if dt_s <= 0.0:
        for i in range(r):
            for j in range(r):
                pi[i, j] = 1.0 if i == j else 0.0
        return
    step_matrix(models, counts, dt_s, pi)
    mix(x, P, mu, pi, mx, mP)
    for j in range(r):
        predict_constant_velocity(x[j], P[j], dt_s, models.q[j])


@kernel
def update_position(x: FloatArray, P: FloatArray, z: FloatArray, R: FloatArray) -> float:
    """Kalman update of one model with a position, in place; returns the log-likelihood of z.

    S = H P H^T + R, K = P H^T S^-1, x += K nu, P -= K S K^T, log N(nu; 0, S). If S is not positive definite the
    measurement is skipped and -inf returned.

    Args:
        x: (4,). P: (4, 4). z: (2,) [east_m, north_m]. R: (3,) its covariance [ee, en, nn].
    """
    s00, s01, s11 = P[0, 0] + R[0], P[0, 1] + R[1], P[1, 1] + R[2]
    det = s00 * s11 - s01 * s01
    if not (det > 0.0 and s00 > 0.0):
        return -np.inf
    v0, v1 = z[0] - x[0], z[1] - x[1]
    i00, i01, i11 = s11 / det, -s01 / det, s00 / det
    K = np.empty((4, 2))
    for a in range(4):
        K[a, 0] = P[a, 0] * i00 + P[a, 1] * i01
        K[a, 1] = P[a, 0] * i01 + P[a, 1] * i11
    for a in range(4):
        x[a] += K[a, 0] * v0 + K[a, 1] * v1
    for a in range(4):
        k0 = K[a, 0] * s00 + K[a, 1] * s01
        k1 = K[a, 0] * s01 + K[a, 1] * s11
        for b in range(a, 4):
            P[a, b] -= k0 * K[b, 0] + k1 * K[b, 1]
            P[b, a] = P[a, b]
    distance = v0 * v0 * i00 + 2.0 * v0 * v1 * i01 + v1 * v1 * i11
    return float(-np.log(2.0 * np.pi) - 0.5 * np.log(det) - 0.5 * distance)


@kernel
def reweigh(mu: FloatArray, log_likelihood: FloatArray) -> None:
    """Bayes: mu_j <- c_j exp(l_j) / sum, in logarithms, floored; without any finite l_j, mu stays."""
    r = len(mu)
    top = -np.inf
    for j in range(r):
        top = max(top, np.log(max(mu[j], 1e-300)) + log_likelihood[j])
    if not np.isfinite(top):
        return
    total = 0.0
    for j in range(r):
        mu[j] = np.exp(np.log(max(mu[j], 1e-300)) + log_likelihood[j] - top)
        total += mu[j]
    floored = 0.0
    for j in range(r):
        mu[j] = max(mu[j] / total, MU_FLOOR)
        floored += mu[j]
    for j in range(r):
        mu[j] /= floored


@kernel
def learn(
    models: Models,
    counts: FloatArray,
    mu_before: FloatArray,
    pi: FloatArray,
    log_likelihood: FloatArray,
    dt_s: float,
) -> None:
    """Add this step's expected transitions to the track's counts, forgetting the old ones.

    xi_ij = mu_i pi_ij exp(l_j) / sum; counts <- exp(-dt/memory) counts + min(dt/reference, 1) xi.
    """
    if dt_s <= 0.0 or not np.isfinite(models.prior_count):
        return
    r = len(mu_before)
    top = -np.inf
    for j in range(r):
        top = max(top, log_likelihood[j])
    if not np.isfinite(top):
        return
    total = 0.0
    for i in range(r):
        for j in range(r):
            total += mu_before[i] * pi[i, j] * np.exp(log_likelihood[j] - top)
    if not total > 0.0:
        return
    keep = np.exp(-dt_s / models.memory_s)
    weight = min(dt_s / models.reference_s, 1.0) / total
    for i in range(r):
        for j in range(r):
            xi = mu_before[i] * pi[i, j] * np.exp(log_likelihood[j] - top)
            counts[i, j] = keep * counts[i, j] + weight * xi


@kernel
def filter_plot(
    models: Models,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    counts: FloatArray,
    dt_s: float,
    z: FloatArray,
    R: FloatArray,
    pi: FloatArray,
    mx: FloatArray,
    mP: FloatArray,
) -> None:
    """One full cycle of one track in place: interact over ``dt_s`` >= 0, update with position z of covariance R."""
    r = len(mu)
    before = mu.copy()
    interact(models, x, P, mu, counts, dt_s, pi, mx, mP)
    ll = np.empty(r)
    for j in range(r):
        ll[j] = update_position(x[j], P[j], z, R)
    learn(models, counts, before, pi, ll, dt_s)
    reweigh(mu, ll)


@kernel
def moment_match(x: FloatArray, P: FloatArray, mu: FloatArray, out_x: FloatArray, out_P: FloatArray) -> None:
    """The mixture's mean and covariance: x = sum mu_j x_j, P = sum mu_j (P_j + (x_j - x)(x_j - x)^T)."""
    r, d = x.shape
    for a in range(d):
        out_x[a] = 0.0
        for j in range(r):
            out_x[a] += mu[j] * x[j, a]
    for a in range(d):
        for b in range(a, d):
            value = 0.0
            for j in range(r):
                value += mu[j] * (P[j, a, b] + (x[j, a] - out_x[a]) * (x[j, b] - out_x[b]))
            out_P[a, b] = value
            out_P[b, a] = value
