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

from trackmesh.services.estimation import lags, printed
from trackmesh.services.estimation.bank import Models, State, Work
from trackmesh.services.estimation.gating import Mixture
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.measurement import range_rate, update_position, update_scalar
from trackmesh.services.estimation.motion import linear_flow, predict_model
from trackmesh.services.estimation.plots import Plot
from trackmesh.services.estimation.repair import is_state, repair
from trackmesh.services.estimation.transition import transition_by_modes, transition_matrix

FloatArray = npt.NDArray[np.float64]

MU_FLOOR = 1e-6
"""No model probability falls below this, so that a model can come back."""

_AGE_FLOOR, _AGE_GAIN = 0.05, 1.3
_STAY_LEAST, _STAY_MOST = 0.02, 0.9999
_EVIDENCE_CLIP = 50.0
_FIRST_STAY = 0.95


@kernel
def begin(models: Models, s: State, plot: Plot, sigma_v_mps: float) -> None:
    """Start a filter from one plot.

    It stands at the plot, at rest with ``sigma_v_mps`` per axis, own parameters at their prior.
    """
    r, d = s.x.shape
    for j in range(r):
        for a in range(d):
            s.x[j, a] = 0.0
            for b in range(d):
                s.P[j, a, b] = 0.0
        s.x[j, 0], s.x[j, 1] = plot.z[0], plot.z[1]
        s.P[j, 0, 0], s.P[j, 1, 1] = plot.R[0], plot.R[2]
        s.P[j, 0, 1] = s.P[j, 1, 0] = plot.R[1]
        s.P[j, 2, 2] = s.P[j, 3, 3] = sigma_v_mps * sigma_v_mps
        for a in range(4, models.states[j]):
            s.x[j, a] = models.numbers[j, 1]
            s.P[j, a, a] = models.numbers[j, 2] * models.numbers[j, 2]
        s.mu[j] = models.start[j]
        s.age_s[j] = 0.0
        for k in range(s.counts.shape[1]):
            s.counts[j, k] = 0.0
        if models.printed:
            # The printed filter keeps its next transition matrix where others keep counts.
            for k in range(r):
                s.counts[j, k] = _FIRST_STAY if j == k else (1.0 - _FIRST_STAY) / max(r - 1, 1)
    for b in range(len(s.weight)):
        s.weight[b] = 1.0 / len(s.weight)
    s.t_s = plot.t_s
    lags.renew(s)


@kernel
def interact(models: Models, s: State, t_s: float, w: Work) -> None:
    """Mix and predict to ``t_s`` in place; ``w.pi`` receives the transition matrix of the last part used.

    A time that is not later changes nothing, and is a transition matrix of identity.
    """
    dt_s = t_s - s.t_s
    for branch in range(len(models.split_s)):
        low, high = models.first[branch], models.first[branch + 1]
        if dt_s <= 0.0:
            for a in range(low, high):
                w.before[a] = s.mu[a]
                for b in range(low, high):
                    w.pi[a, b - low] = 1.0 if a == b else 0.0
            continue
        parts = 2 if dt_s > models.split_s[branch] else 1
        for _ in range(parts):
            step_matrix(models, s, branch, dt_s / parts, w)
            mix(models, s, low, high, dt_s / parts, w)
            for j in range(low, high):
                _predict(models, s, j, dt_s / parts, w)
    s.t_s = max(t_s, s.t_s)


@kernel
def _predict(models: Models, s: State, j: int, dt_s: float, w: Work) -> None:
    predict_model(models.kind[j], models.numbers[j], s.x[j], s.P[j], dt_s, w.F, w.product, w.block)
    if len(s.y_t_s):
        linear_flow(models.kind[j], dt_s, w.F)
        lags.predict(s, j, models.states[j], w)


@kernel
def step_matrix(models: Models, s: State, branch: int, dt_s: float, w: Work) -> None:
    """Write the transition matrix of this step into the branch's rows of ``w.pi`` (r, width)."""
    low, high = models.first[branch], models.first[branch + 1]
    n = high - low
    if models.printed:
        for a in range(low, high):
            for b in range(n):
                w.pi[a, b] = s.counts[a, b]
        return
    if models.has_modes[branch]:
        # The rest are states that are never left.
        rate = models.mode_rate[branch, :n]
        transition_by_modes(rate, models.mode_left[branch], models.mode_right[branch], dt_s, w.step, w.power)
    else:
        transition_matrix(models.jump[branch], models.rate[branch], dt_s, w.step, w.power)
    prior = models.prior_count[branch]
    learns = np.isfinite(prior)
    for a in range(n):
        for b in range(n):
            w.pi[low + a, b] = w.step[a, b]
        if learns:
            _learn_row(w.pi[low + a], s.counts[low + a], prior, n)
        if models.age_s[low + a] > 0.0:
            _hold_by_age(w.pi[low + a], a, n, (s.age_s[low + a] + 0.5 * dt_s) / models.age_s[low + a])


@kernel
def _learn_row(row: FloatArray, counts: FloatArray, prior: float, n: int) -> None:
    """Mean of the Dirichlet posterior, in place of its prior's."""
    total = 0.0
    for b in range(n):
        row[b] = prior * row[b] + counts[b]
        total += row[b]
    for b in range(n):
        row[b] /= total


@kernel
def _hold_by_age(row: FloatArray, own: int, n: int, age: float) -> None:
    stay = row[own]
    if stay >= 1.0:
        return
    held = np.exp(np.log(stay) * (_AGE_FLOOR + _AGE_GAIN * (1.0 - np.exp(-age))))
    held = min(max(held, _STAY_LEAST), _STAY_MOST)
    for b in range(n):
        row[b] *= (1.0 - held) / (1.0 - stay)
    row[own] = held


@kernel
def mix(models: Models, s: State, low: int, high: int, dt_s: float, w: Work) -> None:
    """Mix models low..high-1 in place; mu becomes the predicted c_j = sum_a mu_a pi_aj.

    x0_j = sum_a W_aj x_a, P0_j = sum_a W_aj (P_a + (x_a - x0_j)(x_a - x0_j)^T), W_aj = mu_a pi_aj / c_j, over position
    and velocity; of the own parameters of model j only its own estimate comes over, in place of the others' stands the
    prior, uncorrelated with everything.
    """
    n = high - low
    _second_moments(s, low, n, w)
    for j in range(n):
        c = 0.0
        for a in range(n):
            w.weight[a, j] = s.mu[low + a] * w.pi[low + a, j]
            c += w.weight[a, j]
        w.c[low + j] = max(c, 1e-300)
        for a in range(n):
            w.weight[a, j] /= w.c[low + j]
        _mix_motion(s, j, low, n, w)
        if models.states[low + j] > 4:
            _mix_own(models, s, j, low, w)
    for lag in range(len(s.y_t_s)):
        lags.mix(models, s, lag, low, high, w)
    for j in range(n):
        d = models.states[low + j]
        s.age_s[low + j] = w.weight[j, j] * (s.age_s[low + j] + dt_s)
        for k in range(d):
            s.x[low + j, k] = w.x[j, k]
            for m in range(k, d):
                s.P[low + j, k, m] = w.P[j, k, m]
                s.P[low + j, m, k] = w.P[j, k, m]
        w.before[low + j] = s.mu[low + j]
        s.mu[low + j] = w.c[low + j]


@kernel
def _second_moments(s: State, low: int, n: int, w: Work) -> None:
    """Means and second moments of the models of a branch about the first one's mean, upper triangles.

    They are needed once for each model here, not once for each pair of models. About the plane's origin they would lose
    the digits that tell models apart.
    """
    for a in range(n):
        for k in range(4):
            w.apart[a, k] = s.x[low + a, k] - s.x[low, k]
        for k in range(4):
            for m in range(k, 4):
                w.moment[a, k, m] = s.P[low + a, k, m] + w.apart[a, k] * w.apart[a, m]


@kernel
def _mix_motion(s: State, j: int, low: int, n: int, w: Work) -> None:
    """Position and velocity that come to the j-th model of a branch, upper triangle of the covariance.

    With d = x0 - ref, P0 = sum_a W_a (P_a + (x_a - ref)(x_a - ref)^T) - d d^T for any ref.
    """
    for k in range(4):
        off = 0.0
        for a in range(n):
            off += w.weight[a, j] * w.apart[a, k]
        w.off[k] = off
        w.x[j, k] = s.x[low, k] + off
    for k in range(4):
        for m in range(k, 4):
            value = -w.off[k] * w.off[m]
            for a in range(n):
                value += w.weight[a, j] * w.moment[a, k, m]
            w.P[j, k, m] = value


@kernel
def _mix_own(models: Models, s: State, j: int, low: int, w: Work) -> None:
    """Own parameters of the j-th model of a branch, after ``_mix_motion``."""
    i = low + j
    d = models.states[i]
    own = w.weight[j, j]
    mean, variance = models.numbers[i, 1], models.numbers[i, 2] * models.numbers[i, 2]
    for m in range(4, d):
        w.x[j, m] = own * s.x[i, m] + (1.0 - own) * mean
        for k in range(4):
            # What comes from others has mean `mean` here, whatever its position.
            w.P[j, k, m] = own * (s.P[i, k, m] + (s.x[i, k] - w.x[j, k]) * (s.x[i, m] - mean))
        for k in range(4, m + 1):
            dk, dm = s.x[i, k] - mean, s.x[i, m] - mean
            w.P[j, k, m] = own * s.P[i, k, m] + own * (1.0 - own) * dk * dm
            if k == m:
                w.P[j, k, m] += (1.0 - own) * variance


@kernel
def update(models: Models, s: State, plot: Plot, dt_s: float, w: Work) -> None:
    """Update in place with a plot, after ``interact`` over dt_s.

    In each branch mu_j <- c_j exp(l_j) / sum, and its evidence is e = ln sum_j c_j exp(l_j); the branches exchange a
    share of their weights, which are then multiplied by exp(e). A plot that no model can explain changes no
    probability.
    """
    top, repairs = -np.inf, w.repairs
    for branch in range(len(models.split_s)):
        low, high = models.first[branch], models.first[branch + 1]
        for j in range(low, high):
            w.log_likelihood[j] = _update_model(s, j, models.states[j], plot, w)
        learn(models, s, branch, dt_s, w)
        w.c[branch] = reweigh(s.mu, w.log_likelihood, low, high)
        top = max(top, w.c[branch])
    if len(s.y_t_s):
        lags.repair(s, w.repairs > repairs, w)
    if not np.isfinite(top):
        return
    b = len(models.split_s)
    total = 0.0
    for branch in range(b):
        shared = (1.0 - models.share) * s.weight[branch] + models.share / b
        s.weight[branch] = shared * np.exp(max(w.c[branch] - top, -_EVIDENCE_CLIP))
        total += s.weight[branch]
    for branch in range(b):
        s.weight[branch] /= total
    if models.printed:
        printed.after_update(models, s)


@kernel
def _update_model(s: State, j: int, d: int, plot: Plot, w: Work) -> float:
    """Update one model with position and, where it is known, range rate; their joint log-likelihood."""
    x, P = s.x[j], s.P[j]
    if not is_state(x, P, d, w):
        repair(s, j, d, plot)
        w.repairs += 1
    if len(s.y_t_s):
        lags.update_position(s, j, d, plot.z, plot.R, w)
    value = update_position(x, P, d, plot.z, plot.R, w.gain)
    if np.isfinite(plot.range_rate_variance):
        h = w.block
        nu = plot.range_rate_mps - range_rate(x, plot, h)
        if len(s.y_t_s):
            lags.update_scalar(s, j, d, h, nu, plot.range_rate_variance, w)
        value += update_scalar(x, P, d, h, nu, plot.range_rate_variance, w.gain)
    return value


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
def learn(models: Models, s: State, branch: int, dt_s: float, w: Work) -> None:
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
            s.counts[a, b] = keep * s.counts[a, b] + gain * xi


@kernel
def filter_plot(models: Models, s: State, plot: Plot, w: Work) -> None:
    """One full cycle in place: predict to the time of a plot, not before the filter's own, and update with it."""
    dt_s = plot.t_s - s.t_s
    if len(s.y_t_s) and dt_s > 0.0:
        lags.shift(s)
    interact(models, s, plot.t_s, w)
    update(models, s, plot, dt_s, w)


@kernel
def probabilities(models: Models, s: State, out: FloatArray) -> None:
    """Write the probability of every model over all branches, (r,): that within the branch times its weight."""
    for branch in range(len(models.split_s)):
        for j in range(models.first[branch], models.first[branch + 1]):
            out[j] = s.weight[branch] * s.mu[j]


@kernel
def write_mixture(models: Models, s: State, x: FloatArray, P: FloatArray, out: Mixture, k: int) -> None:
    """Write position and velocity of a filter, model by model, as mixture ``k``: x (r, >= 4), P (r, >= 4, >= 4)."""
    probabilities(models, s, out.mu[k])
    for j in range(len(models.kind)):
        for a in range(4):
            out.x[k, j, a] = x[j, a]
            for b in range(4):
                out.P[k, j, a, b] = P[j, a, b]


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
