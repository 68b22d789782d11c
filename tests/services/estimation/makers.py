"""What the tests of the numerics share: strategies, dense reference formulas, one track and many."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import scipy.linalg
from hypothesis import settings
from hypothesis import strategies as st

from trackmesh.services.estimation import imm, tracks
from trackmesh.services.estimation.bank import Models, State, make_models, make_states, make_work
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models, velocity_models
from trackmesh.services.estimation.gating import Mixture, make_mixture
from trackmesh.services.estimation.plots import Plots, make_plots
from trackmesh.services.estimation.tracks import Filters, make_filters
from trackmesh.services.estimation.transition import transition_matrix, uniformised

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LAW = settings(deadline=None, max_examples=60)
"""Kernels may have to be compiled in the first example, hence no deadline."""


def velocities(
    q: tuple[float, ...] = (1.0, 50.0, 500.0),
    sojourn_s: tuple[float, ...] = (50.0, 15.0, 15.0),
    prior_count: float = np.inf,
    printed: bool = False,
    lags: int = 0,
) -> Models:
    """One branch of constant-velocity models."""
    return make_models((velocity_models(list(q), list(sojourn_s), prior_count),), printed=printed, lags=lags)


MODELS = velocities()
DIRICHLET = velocities(prior_count=20.0)
PAPER = velocities(printed=True)
MANOEUVRE = manoeuvre_models(np.deg2rad(6.0), 10.0, 18.0, 45.0, 0.3)
GENERIC = generic_models(10.0, 18.0, 45.0, 0.3)
TVIMM = make_models((MANOEUVRE, GENERIC))
NAMED = {"imm": MODELS, "tvimm-dirichlet": DIRICHLET, "tvimm-paper": PAPER, "tvimm": TVIMM}
"""Every named filter."""

LAGGED, TVIMM_LAGGED = velocities(lags=2), make_models((MANOEUVRE, GENERIC), lags=2)
"""Filters that keep two lags."""

SCALE = np.outer([100.0, 100.0, 10.0, 10.0], [100.0, 100.0, 10.0, 10.0])
"""Turns a random covariance into one of metres and metres a second."""

seeds = st.integers(0, 2**32 - 1)
sojourns = st.lists(st.floats(0.5, 500.0), min_size=1, max_size=4).map(np.array)


class Plot(NamedTuple):
    """One plot: z (2,), R (3,) [ee, en, nn], seconds."""

    z: FloatArray
    R: FloatArray
    t_s: float


def covariance(rng: np.random.Generator, n: int, scale: float = 1.0) -> FloatArray:
    """A random positive definite (n, n) matrix, well conditioned."""
    A = rng.normal(size=(n, n))
    return np.asarray(scale * (A @ A.T + 0.1 * np.eye(n)))


def covariances(rng: np.random.Generator, shape: tuple[int, ...], n: int, scale: float = 1.0) -> FloatArray:
    """Random positive definite matrices, shape (*shape, n, n)."""
    count = int(np.prod(shape))
    return np.array([covariance(rng, n, scale) for _ in range(count)]).reshape(*shape, n, n)


def packed(S: FloatArray) -> FloatArray:
    """(..., 2, 2) as (..., 3) [ee, en, nn]."""
    return np.stack([S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]], axis=-1)


def unpacked(R: FloatArray) -> FloatArray:
    """(..., 3) [ee, en, nn] as (..., 2, 2)."""
    return np.stack([np.stack([R[..., 0], R[..., 1]], -1), np.stack([R[..., 1], R[..., 2]], -1)], -2)


def probabilities(rng: np.random.Generator, r: int) -> FloatArray:
    return rng.dirichlet(np.ones(r))


def random_state(rng: np.random.Generator, models: Models) -> State:
    """A filter in the middle of its life, its models a few hundred metres apart, at time 0."""
    s: State = make_states(models, 1)[0]
    r, d = s.x.shape
    unit = np.array([100.0, 100.0, 10.0, 10.0, 0.03, 0.03])[:d]
    for j in range(r):
        n = models.states[j]
        own = models.numbers[j, 1] * (np.arange(n) >= 4)
        s.x[j, :n] = rng.normal(size=n) * 3.0 * unit[:n] + own
        s.P[j, :n, :n] = covariance(rng, n) * np.outer(unit[:n], unit[:n])
        s.age_s[j] = rng.uniform(0.0, 30.0)
    for b in range(len(models.split_s)):
        low, high = models.first[b], models.first[b + 1]
        s.mu[low:high] = probabilities(rng, high - low)
    s.weight[:] = probabilities(rng, len(models.split_s))
    return s


def random_walk(
    rng: np.random.Generator, n: int, sigma_m: float = 60.0, every_s: tuple[float, float] = (0.5, 6.0)
) -> list[Plot]:
    """Plots of a target that wanders about, at irregular and strictly growing times."""
    t = np.cumsum(rng.uniform(*every_s, n))
    velocity = rng.normal(0.0, 150.0, 2) + np.cumsum(rng.normal(0.0, 10.0, (n, 2)), axis=0)
    z = np.cumsum(velocity * np.diff(t, prepend=0.0)[:, None], axis=0) + rng.normal(0.0, sigma_m, (n, 2))
    R = packed(covariances(rng, (n,), 2, sigma_m**2))
    return [Plot(z[k], R[k], float(t[k])) for k in range(n)]


def flow(dt_s: float) -> FloatArray:
    """F of constant velocity."""
    return np.asarray(np.kron([[1.0, dt_s], [0.0, 1.0]], np.eye(2)), np.float64)


def noise(dt_s: float, q: float) -> FloatArray:
    """Q of white-noise acceleration."""
    block = q * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    return np.asarray(np.kron(block, np.eye(2)), np.float64)


H = np.eye(2, 4)


def mixture_moments(x: FloatArray, P: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a Gaussian mixture: the second moment less the square of the first."""
    # Moments about the first component: about the origin, positions of 1e4 m would cost eight digits.
    off = x - x[0]
    mean = weight @ off
    second = sum(w * (p + np.outer(m, m)) for w, m, p in zip(weight, off, P, strict=True))
    return x[0] + mean, np.asarray(second - np.outer(mean, mean))


def dense_update(x: FloatArray, P: FloatArray, plot: Plot) -> tuple[FloatArray, FloatArray, float]:
    """Textbook Kalman update with the Joseph form, and the log-likelihood."""
    H = np.eye(2, len(x))
    S = H @ P @ H.T + unpacked(plot.R)
    K = np.linalg.solve(S, H @ P).T
    nu = plot.z - H @ x
    left = np.eye(len(x)) - K @ H
    log_likelihood = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, left @ P @ left.T + K @ unpacked(plot.R) @ K.T, float(log_likelihood)


def batch(*plots: Plot) -> Plots:
    """Plots as the kernels take them."""
    return make_plots(np.array([p.z for p in plots]), np.array([p.R for p in plots]), np.array([p.t_s for p in plots]))


def begun(models: Models, plot: Plot, sigma_v_mps: float = 150.0) -> State:
    """A filter, begun with a plot."""
    s: State = make_states(models, 1)[0]
    imm.begin(models, s, batch(plot)[0], sigma_v_mps)
    return s


def copied_state(s: Any) -> State:
    return cast("State", np.array([s], s.dtype)[0])


def fields(s: Any) -> dict[str, FloatArray]:
    """All that a state holds, by name."""
    return {name: np.asarray(s[name]) for name in s.dtype.names}


def filtered(models: Models, s: State, plots: list[Plot]) -> State:
    """A copy, fed with plots in order by the kernel of one track."""
    out, w = copied_state(s), make_work(models)
    for plot in plots:
        imm.filter_plot(models, out, batch(plot)[0], w)
    return out


def interacted(models: Models, s: State, t_s: float) -> State:
    """A copy, predicted to a time."""
    out = copied_state(s)
    imm.interact(models, out, t_s, make_work(models))
    return out


def updated(models: Models, s: State, plot: Plot, dt_s: float) -> State:
    """A copy, updated with a plot."""
    out = copied_state(s)
    imm.update(models, out, batch(plot)[0], dt_s, make_work(models))
    return out


def step_matrix(models: Models, s: State, dt_s: float, branch: int = 0) -> FloatArray:
    """The transition matrix of a step of one branch."""
    w = make_work(models)
    imm.step_matrix(models, s, branch, dt_s, w)
    low, high = models.first[branch], models.first[branch + 1]
    return np.array(w.pi[low:high, : high - low])


def chain(G: FloatArray, dt_s: float) -> FloatArray:
    """The transition matrix of a generator, by the kernel."""
    r = len(G)
    out = np.empty((r, r))
    transition_matrix(*uniformised(G, r), dt_s, out, np.empty((r, r)))
    return out


def chain_matrix(models: Models, dt_s: float, branch: int = 0) -> FloatArray:
    """The fixed transition matrix of a branch, by scipy's matrix exponential."""
    n = int(models.first[branch + 1] - models.first[branch])
    G = models.rate[branch] * (models.jump[branch, 0, :n, :n] - np.eye(n))
    return np.asarray(scipy.linalg.expm(G * dt_s))


def mixture(models: Models, s: State) -> Mixture:
    """Position and velocity, model by model, as one mixture."""
    mu = np.empty((1, len(models.kind)))
    imm.probabilities(models, s, mu[0])
    return Mixture(np.array(s.x[None, :, :4]), np.array(s.P[None, :, :4, :4]), mu)


def output(models: Models, s: State) -> tuple[FloatArray, FloatArray]:
    """Estimate (4,) and covariance (4, 4)."""
    mean, P = tracks.estimates(models, mixture(models, s))
    return mean[0], P[0]


def assert_sound(models: Models, s: Any, slack: float = 1e-12) -> None:
    """Finite, symmetric, positive semi-definite (to ``slack`` of the scale of each), probabilities that sum to one."""
    for name in s.dtype.names:
        assert np.isfinite(s[name]).all(), name
    for j, d in enumerate(models.states.tolist()):
        assert_covariance(s.P[j, :d, :d], slack)
        for lag in range(len(s.y_t_s)):
            assert_covariance(s.Y[lag, j], slack)
    for low, high in zip(models.first, models.first[1:], strict=False):
        assert abs(s.mu[low:high].sum() - 1.0) < 1e-9
        assert s.mu[low:high].min() >= 0
    assert abs(s.weight.sum() - 1.0) < 1e-9


def assert_covariance(P: FloatArray, slack: float = 1e-12) -> None:
    """Symmetric and, to ``slack`` of its scale, positive semi-definite."""
    assert np.array_equal(P, P.T)
    # Metres, metres a second and rad/s: compare what has been brought to one scale.
    scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
    assert np.all(np.diag(P) >= 0)
    least, *_, most = np.linalg.eigvalsh(P / np.outer(scale, scale))
    assert least >= -slack * most


def assert_scaled(x: FloatArray, P: FloatArray, want_x: FloatArray, want_P: FloatArray, tolerance: float) -> None:
    """Equal to ``tolerance`` standard deviations of what is wanted."""
    scale = np.sqrt(np.diag(want_P))
    np.testing.assert_allclose(x / scale, want_x / scale, rtol=tolerance, atol=tolerance)
    unit = np.outer(scale, scale)
    np.testing.assert_allclose(P / unit, want_P / unit, rtol=0, atol=tolerance)


def fresh_filters(models: Models, first: Plot, rows: int = 1, ring: int = 6) -> Filters:
    """Filters with the given number of rows, row 0 begun with the first plot."""
    f = make_filters(models, rows, ring)
    begin_row(models, f, 0, first)
    return f


def begin_row(models: Models, f: Filters, row: int, plot: Plot, sigma_v_mps: float = 150.0) -> None:
    tracks.begin(f, np.array([row]), batch(plot), sigma_v_mps)


def feed_row(models: Models, f: Filters, row: int, plot: Plot) -> bool:
    return bool(tracks.feed(f, np.array([row]), batch(plot))[0])


def copied(f: Filters) -> Filters:
    return f._replace(**{name: getattr(f, name).copy() for name in Filters._fields if name not in ("models", "work")})


def meaning(f: Filters, row: int) -> list[bytes]:
    """All that a row holds; of the ring only the plots in use."""
    rest = (f.head, f.base, f.ring_n, f.mid_n, f.t_s, f.mean, f.spread)
    mid = [f.mid[row].tobytes()] if f.mid_n[row] else []
    return [f.ring[row, : f.ring_n[row]].tobytes(), *mid, *(a[row].tobytes() for a in rest)]


def same(one: Filters, other: Filters, row: int = 0, other_row: int | None = None) -> bool:
    """Whether two rows are equal bit for bit."""
    return meaning(one, row) == meaning(other, row if other_row is None else other_row)


def same_present(one: Filters, other: Filters) -> bool:
    """Whether the present of all rows is equal bit for bit, wherever their bases stand."""
    return all(getattr(one, n).tobytes() == getattr(other, n).tobytes() for n in ("head", "t_s", "mean", "spread"))


def predicted(models: Models, f: Filters, rows: IntArray, t_s: FloatArray) -> tuple[Mixture, npt.NDArray[np.bool_]]:
    """Predictions of rows, and which are known."""
    out = make_mixture(len(rows), len(models.kind))
    known = tracks.predict(f, rows, t_s, out)
    return out, known


def plain_python(expression: str, module: str) -> Any:
    """The value of an expression over a test module's names, computed in a process in which nothing is compiled."""
    root = str(Path(__file__).resolve().parents[3])
    code = f"import json; from {module} import *; print(json.dumps({expression}))"
    env = os.environ | {
        "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]),
    }
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def fed_walk(models: Models) -> FloatArray:
    """Mean, covariance, model probabilities and past of one track after a walk with a late plot, in one row."""
    plots = random_walk(np.random.default_rng(11), 20)
    f = fresh_filters(models, plots[0])
    for plot in [*plots[1:10], *plots[11:14], plots[10], *plots[14:]]:
        feed_row(models, f, 0, plot)
    ahead, _ = predicted(models, f, np.array([0]), f.t_s + 3.0)
    mean, P = tracks.estimates(models, ahead)
    past = f.head[0]
    return np.concatenate([part.ravel() for part in (mean, P, ahead.mu, past.y, past.Y)])
