"""The interacting multiple model filter, branch by branch, with a transition matrix that may vary in time.

One cycle over dt is ``interact`` (mix and predict every model) and, with a plot, ``update``. All models are scored on
the same plot (Blom and Bar-Shalom 1988). What may vary the transition matrix of a step, beside dt itself:

* the track's own past transitions, as a Dirichlet posterior whose prior is ``prior_count`` transitions by Pi(dt)
  (quasi-Bayes; ``prior_count`` infinite gives the fixed chain exactly);
* the age of each model (semi-Markov): pi_ii <- pi_ii^f with f rising from 0.05 to 1.35 over its age constant;
* the published TV-IMM (Luan et al. 2021): likelihoods of the models' states under each other (``printed.py``).

A model's own parameters are set to their prior in what comes to it from other models.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import printed
from trackmesh.services.estimation.bank import Models, State, Work
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.motion import predict_model
from trackmesh.services.estimation.transition import transition_matrix

FloatArray = npt.NDArray[np.float64]

MU_FLOOR = 1e-6
"""No model probability falls below this, so that a model can come back."""

_AGE_FLOOR, _AGE_GAIN = 0.05, 1.3
_STAY_LEAST, _STAY_MOST = 0.02, 0.9999
_EVIDENCE_CLIP = 50.0
_FIRST_STAY = 0.95


@kernel
def make_work(models: Models, d: int) -> Work:
    """Scratch for one track."""
    r = len(models.kind)
    width = models.generator.shape[1]
    return Work(
        np.zeros((r, width)), np.empty((width, d)), np.empty((width, d, d)), np.empty(r), np.empty(r),
        np.empty(r), np.empty((13, 6)), np.empty((6, 2)),
    )  # fmt: skip


@kernel
def begin(models: Models, s: State, i: int, z: FloatArray, R: FloatArray, t_s: float, sigma_v_mps: float) -> None:
    """Start row ``i`` from one plot.

    It stands at the plot, at rest with ``sigma_v_mps`` per axis, own parameters at their prior.
    """
    r, d = s.x.shape[1:]
    for j in range(r):
        for a in range(d):
            s.x[i, j, a] = 0.0
            for b in range(d):
                s.P[i, j, a, b] = 0.0
        s.x[i, j, 0], s.x[i, j, 1] = z[0], z[1]
        s.P[i, j, 0, 0], s.P[i, j, 1, 1] = R[0], R[2]
        s.P[i, j, 0, 1] = s.P[i, j, 1, 0] = R[1]
        s.P[i, j, 2, 2] = s.P[i, j, 3, 3] = sigma_v_mps * sigma_v_mps
        for a in range(4, models.states[j]):
            s.x[i, j, a] = models.numbers[j, 1]
            s.P[i, j, a, a] = models.numbers[j, 2] * models.numbers[j, 2]
        s.mu[i, j] = models.start[j]
        s.age_s[i, j] = 0.0
        for k in range(s.counts.shape[2]):
            s.counts[i, j, k] = 0.0
        if models.printed:
            # The printed filter keeps its next transition matrix where others keep counts.
            for k in range(r):
                s.counts[i, j, k] = _FIRST_STAY if j == k else (1.0 - _FIRST_STAY) / max(r - 1, 1)
    for b in range(s.weight.shape[1]):
        s.weight[i, b] = 1.0 / s.weight.shape[1]
    s.t_s[i] = t_s


@kernel
def copy_row(source: State, i: int, target: State, k: int) -> None:
    """Copy row ``i`` of one state to row ``k`` of another."""
    target.x[k] = source.x[i]
    target.P[k] = source.P[i]
    target.mu[k] = source.mu[i]
    target.weight[k] = source.weight[i]
    target.counts[k] = source.counts[i]
    target.age_s[k] = source.age_s[i]
    target.t_s[k] = source.t_s[i]


@kernel
def interact(models: Models, s: State, i: int, t_s: float, w: Work) -> None:
    """Mix and predict row ``i`` to ``t_s`` in place; ``w.pi`` receives the transition matrix of the last part used.

    A time that is not later changes nothing, and is a transition matrix of identity.
    """
    dt_s = t_s - s.t_s[i]
    for branch in range(len(models.split_s)):
        low, high = models.first[branch], models.first[branch + 1]
        if dt_s <= 0.0:
            for a in range(low, high):
                w.before[a] = s.mu[i, a]
                for b in range(low, high):
                    w.pi[a, b - low] = 1.0 if a == b else 0.0
            continue
        parts = 2 if dt_s > models.split_s[branch] else 1
        for _ in range(parts):
            step_matrix(models, s, i, branch, dt_s / parts, w.pi)
            mix(models, s, i, low, high, dt_s / parts, w)
            for j in range(low, high):
                predict_model(models.kind[j], models.numbers[j], s.x[i, j], s.P[i, j], dt_s / parts, w.motion)
    s.t_s[i] = max(t_s, s.t_s[i])


@kernel
def step_matrix(models: Models, s: State, i: int, branch: int, dt_s: float, pi: FloatArray) -> None:
    """Write the transition matrix of this step into the branch's rows of ``pi`` (r, width)."""
    low, high = models.first[branch], models.first[branch + 1]
    n = high - low
    if models.printed:
        for a in range(low, high):
            for b in range(n):
                pi[a, b] = s.counts[i, a, b]
        return
    transition_matrix(models.generator[low:high, :n], dt_s, pi[low:high, :n])
    prior = models.prior_count[branch]
    learns = np.isfinite(prior)
    for a in range(low, high):
        if learns:
            total = 0.0
            for b in range(n):
                pi[a, b] = prior * pi[a, b] + s.counts[i, a, b]
                total += pi[a, b]
            for b in range(n):
                pi[a, b] /= total
        if models.age_s[a] > 0.0:
            _hold_by_age(pi[a], a - low, n, (s.age_s[i, a] + 0.5 * dt_s) / models.age_s[a])


@kernel
def _hold_by_age(row: FloatArray, own: int, n: int, age: float) -> None:
    stay = row[own]
    if stay >= 1.0:
        return
    held = stay ** (_AGE_FLOOR + _AGE_GAIN * (1.0 - np.exp(-age)))
    held = min(max(held, _STAY_LEAST), _STAY_MOST)
    for b in range(n):
        row[b] *= (1.0 - held) / (1.0 - stay)
    row[own] = held


@kernel
def mix(models: Models, s: State, i: int, low: int, high: int, dt_s: float, w: Work) -> None:
    """Mix models low..high-1 of row ``i`` in place; mu becomes the predicted c_j = sum_a mu_a pi_aj.

    x0_j = sum_a W_aj x_a, P0_j = sum_a W_aj (P_a + (x_a - x0_j)(x_a - x0_j)^T), W_aj = mu_a pi_aj / c_j, over position
    and velocity; of the own parameters of model j only its own estimate comes over, in place of the others' stands the
    prior, uncorrelated with everything.
    """
    n = high - low
    for j in range(n):
        c = 0.0
        for a in range(n):
            c += s.mu[i, low + a] * w.pi[low + a, j]
        c = max(c, 1e-300)
        w.c[low + j] = c
        d = models.states[low + j]
        own = s.mu[i, low + j] * w.pi[low + j, j] / c
        for k in range(4):
            value = 0.0
            for a in range(n):
                value += s.mu[i, low + a] * w.pi[low + a, j] * s.x[i, low + a, k]
            w.x[j, k] = value / c
        mean, variance = models.numbers[low + j, 1], models.numbers[low + j, 2] * models.numbers[low + j, 2]
        for k in range(4, d):
            w.x[j, k] = own * s.x[i, low + j, k] + (1.0 - own) * mean
        for k in range(4):
            for m in range(k, 4):
                value = 0.0
                for a in range(n):
                    dk, dm = s.x[i, low + a, k] - w.x[j, k], s.x[i, low + a, m] - w.x[j, m]
                    value += s.mu[i, low + a] * w.pi[low + a, j] * (s.P[i, low + a, k, m] + dk * dm)
                w.P[j, k, m] = value / c
        for m in range(4, d):
            shift_own, shift_prior = s.x[i, low + j, m] - w.x[j, m], mean - w.x[j, m]
            for k in range(4):
                # What comes from others has mean `mean` here, whatever its position.
                value = own * (s.P[i, low + j, k, m] + (s.x[i, low + j, k] - w.x[j, k]) * shift_own)
                value -= own * (s.x[i, low + j, k] - w.x[j, k]) * shift_prior
                w.P[j, k, m] = value
            for k in range(4, m + 1):
                dk_own, dk_prior = s.x[i, low + j, k] - w.x[j, k], mean - w.x[j, k]
                spread = own * dk_own * shift_own + (1.0 - own) * dk_prior * shift_prior
                w.P[j, k, m] = own * s.P[i, low + j, k, m] + spread + ((1.0 - own) * variance if k == m else 0.0)
    for j in range(n):
        d = models.states[low + j]
        kept = s.mu[i, low + j] * w.pi[low + j, j] / w.c[low + j]
        s.age_s[i, low + j] = kept * (s.age_s[i, low + j] + dt_s)
        for k in range(d):
            s.x[i, low + j, k] = w.x[j, k]
            for m in range(k, d):
                s.P[i, low + j, k, m] = w.P[j, k, m]
                s.P[i, low + j, m, k] = w.P[j, k, m]
    for j in range(n):
        w.before[low + j] = s.mu[i, low + j]
        s.mu[i, low + j] = w.c[low + j]


@kernel
def update(models: Models, s: State, i: int, z: FloatArray, R: FloatArray, dt_s: float, w: Work) -> None:
    """Update row ``i`` in place with position z (2,) of covariance R (3,) [ee, en, nn], after ``interact`` over dt_s.

    In each branch mu_j <- c_j exp(l_j) / sum, and its evidence is e = ln sum_j c_j exp(l_j); the branches exchange a
    share of their weights, which are then multiplied by exp(e). A plot that no model can explain changes no
    probability.
    """
    top = -np.inf
    for branch in range(len(models.split_s)):
        low, high = models.first[branch], models.first[branch + 1]
        for j in range(low, high):
            w.log_likelihood[j] = update_position(s.x[i, j], s.P[i, j], models.states[j], z, R, w.gain)
        learn(models, s, i, branch, dt_s, w)
        w.c[branch] = reweigh(s.mu[i], w.log_likelihood, low, high)
        top = max(top, w.c[branch])
    if not np.isfinite(top):
        return
    b = len(models.split_s)
    total = 0.0
    for branch in range(b):
        shared = (1.0 - models.share) * s.weight[i, branch] + models.share / b
        s.weight[i, branch] = shared * np.exp(max(w.c[branch] - top, -_EVIDENCE_CLIP))
        total += s.weight[i, branch]
    for branch in range(b):
        s.weight[i, branch] /= total
    if models.printed:
        printed.after_update(models, s, i)


@kernel
def update_position(x: FloatArray, P: FloatArray, d: int, z: FloatArray, R: FloatArray, K: FloatArray) -> float:
    """Kalman update of one model with a position, in place; returns the log-likelihood of z.

    S = H P H^T + R, K = P H^T S^-1, x += K nu, P -= K S K^T, log N(nu; 0, S). If S is not positive definite the
    measurement is skipped and -inf returned.

    Args:
        x: (>= d,). P: (>= d, >= d). z: (2,) [east_m, north_m]. R: (3,) its covariance [ee, en, nn].
        K: (>= d, 2) scratch.
    """
    s00, s01, s11 = P[0, 0] + R[0], P[0, 1] + R[1], P[1, 1] + R[2]
    det = s00 * s11 - s01 * s01
    if not (det > 0.0 and s00 > 0.0):
        return -np.inf
    v0, v1 = z[0] - x[0], z[1] - x[1]
    i00, i01, i11 = s11 / det, -s01 / det, s00 / det
    for a in range(d):
        K[a, 0] = P[a, 0] * i00 + P[a, 1] * i01
        K[a, 1] = P[a, 0] * i01 + P[a, 1] * i11
    for a in range(d):
        x[a] += K[a, 0] * v0 + K[a, 1] * v1
        k0 = K[a, 0] * s00 + K[a, 1] * s01
        k1 = K[a, 0] * s01 + K[a, 1] * s11
        for b in range(a, d):
            P[a, b] -= k0 * K[b, 0] + k1 * K[b, 1]
            P[b, a] = P[a, b]
    distance = v0 * v0 * i00 + 2.0 * v0 * v1 * i01 + v1 * v1 * i11
    return float(-np.log(2.0 * np.pi) - 0.5 * np.log(det) - 0.5 * distance)


@kernel
def reweigh(mu: FloatArray, log_likelihood: FloatArray, low: int, high: int) -> float:
    """Bayes over models low..high-1 in logarithms, floored; returns ln sum_j c_j exp(l_j).

    Without any finite likelihood mu stays, and -inf is returned.
    """
    top = -np.inf
    for j in range(low, high):
        top = max(top, log_likelihood[j])
    if not np.isfinite(top):
        return -np.inf
    total = 0.0
    for j in range(low, high):
        mu[j] *= np.exp(log_likelihood[j] - top)
        total += mu[j]
    if not total > 0.0:
        # Every model that fits had lost all probability: begin again from what fits.
        for j in range(low, high):
            mu[j] = np.exp(log_likelihood[j] - top)
            total += mu[j]
    floored = 0.0
    for j in range(low, high):
        mu[j] = max(mu[j] / total, MU_FLOOR)
        floored += mu[j]
    for j in range(low, high):
        mu[j] /= floored
    return float(top + np.log(total))


@kernel
def learn(models: Models, s: State, i: int, branch: int, dt_s: float, w: Work) -> None:
    """Add this step's expected transitions to the track's counts, forgetting the old ones.

    xi_ab = mu_a pi_ab exp(l_b) / sum; counts <- exp(-dt/memory) counts + min(dt/reference, 1) xi.
    """
    if dt_s <= 0.0 or not np.isfinite(models.prior_count[branch]):
        return
    low, high = models.first[branch], models.first[branch + 1]
    top = -np.inf
    for b in range(low, high):
        top = max(top, w.log_likelihood[b])
    if not np.isfinite(top):
        return
    total = 0.0
    for a in range(low, high):
        for b in range(low, high):
            total += w.before[a] * w.pi[a, b - low] * np.exp(w.log_likelihood[b] - top)
    if not total > 0.0:
        return
    keep = np.exp(-dt_s / models.memory_s)
    gain = min(dt_s / models.reference_s, 1.0) / total
    for a in range(low, high):
        for b in range(high - low):
            xi = w.before[a] * w.pi[a, b] * np.exp(w.log_likelihood[low + b] - top)
            s.counts[i, a, b] = keep * s.counts[i, a, b] + gain * xi


@kernel
def filter_plot(models: Models, s: State, i: int, z: FloatArray, R: FloatArray, t_s: float, w: Work) -> None:
    """One full cycle of row ``i`` in place: predict to ``t_s``, not before its own time, and update with a plot."""
    dt_s = t_s - s.t_s[i]
    interact(models, s, i, t_s, w)
    update(models, s, i, z, R, dt_s, w)


@kernel
def probabilities(models: Models, s: State, i: int, out: FloatArray) -> None:
    """Write the probability of every model over all branches, (r,): that within the branch times its weight."""
    for branch in range(len(models.split_s)):
        for j in range(models.first[branch], models.first[branch + 1]):
            out[j] = s.weight[i, branch] * s.mu[i, j]


@kernel
def moment_match(x: FloatArray, P: FloatArray, mu: FloatArray, out_x: FloatArray, out_P: FloatArray) -> None:
    """Mean and covariance of a mixture over position and velocity.

    x = sum mu_j x_j, P = sum mu_j (P_j + (x_j - x)(x_j - x)^T).
    """
    r = len(mu)
    for a in range(4):
        value = 0.0
        for j in range(r):
            value += mu[j] * x[j, a]
        out_x[a] = value
    for a in range(4):
        for b in range(a, 4):
            value = 0.0
            for j in range(r):
                value += mu[j] * (P[j, a, b] + (x[j, a] - out_x[a]) * (x[j, b] - out_x[b]))
            out_P[a, b] = value
            out_P[b, a] = value
