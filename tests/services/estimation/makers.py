"""What the tests of the numerics share: strategies, dense reference formulas, one track and many."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from hypothesis import settings
from hypothesis import strategies as st

from trackmesh.services.estimation import imm, tracks
from trackmesh.services.estimation.bank import Models, State, Work, make_models, make_state
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models, velocity_models
from trackmesh.services.estimation.tracks import Filters, make_filters

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LAW = settings(deadline=None, max_examples=60)
"""Kernels may have to be compiled in the first example, hence no deadline."""


def velocities(
    q: tuple[float, ...] = (1.0, 50.0, 500.0),
    sojourn_s: tuple[float, ...] = (50.0, 15.0, 15.0),
    prior_count: float = np.inf,
    printed: bool = False,
) -> Models:
    """One branch of constant-velocity models."""
    return make_models((velocity_models(list(q), list(sojourn_s), prior_count),), printed=printed)


MODELS = velocities()
DIRICHLET = velocities(prior_count=20.0)
PAPER = velocities(printed=True)
MANOEUVRE = manoeuvre_models(np.deg2rad(6.0), 10.0, 18.0, 45.0, 0.3)
GENERIC = generic_models(10.0, 18.0, 45.0, 0.3)
TVIMM = make_models((MANOEUVRE, GENERIC))
NAMED = {"imm": MODELS, "tvimm-dirichlet": DIRICHLET, "tvimm-paper": PAPER, "tvimm": TVIMM}
"""Every named filter."""

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
    """A filter in the middle of its life, its models a few hundred metres apart; one row at time 0."""
    s = make_state(models, 1)
    r, d = s.x.shape[1:]
    unit = np.array([100.0, 100.0, 10.0, 10.0, 0.03, 0.03])[:d]
    for j in range(r):
        n = models.states[j]
        own = models.numbers[j, 1] * (np.arange(n) >= 4)
        s.x[0, j, :n] = rng.normal(size=n) * 3.0 * unit[:n] + own
        s.P[0, j, :n, :n] = covariance(rng, n) * np.outer(unit[:n], unit[:n])
        s.age_s[0, j] = rng.uniform(0.0, 30.0)
    for b in range(len(models.split_s)):
        low, high = models.first[b], models.first[b + 1]
        s.mu[0, low:high] = probabilities(rng, high - low)
    s.weight[0] = probabilities(rng, len(models.split_s))
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
    """Mean and covariance of a Gaussian mixture, by the definition."""
    mean = weight @ x
    second = sum(w * (p + np.outer(m, m)) for w, m, p in zip(weight, x, P, strict=True))
    return mean, np.asarray(second - np.outer(mean, mean))


def dense_update(x: FloatArray, P: FloatArray, plot: Plot) -> tuple[FloatArray, FloatArray, float]:
    """Textbook Kalman update with the Joseph form, and the log-likelihood."""
    H = np.eye(2, len(x))
    S = H @ P @ H.T + unpacked(plot.R)
    K = np.linalg.solve(S, H @ P).T
    nu = plot.z - H @ x
    left = np.eye(len(x)) - K @ H
    log_likelihood = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, left @ P @ left.T + K @ unpacked(plot.R) @ K.T, float(log_likelihood)


def work(models: Models) -> Work:
    return imm.make_work(models, int(models.states.max()))


def begun(models: Models, plot: Plot, sigma_v_mps: float = 150.0) -> State:
    """One row, begun with a plot."""
    s = make_state(models, 1)
    imm.begin(models, s, 0, plot.z, plot.R, plot.t_s, sigma_v_mps)
    return s


def copied_state(s: State) -> State:
    return State(*(a.copy() for a in s))


def filtered(models: Models, s: State, plots: list[Plot]) -> State:
    """A copy of row 0, fed with plots in order by the kernel of one track."""
    out, w = State(*(a[:1].copy() for a in s)), work(models)
    for plot in plots:
        imm.filter_plot(models, out, 0, plot.z, plot.R, plot.t_s, w)
    return out


def interacted(models: Models, s: State, t_s: float) -> State:
    """A copy of row 0, predicted to a time."""
    out = State(*(a[:1].copy() for a in s))
    imm.interact(models, out, 0, t_s, work(models))
    return out


def output(models: Models, s: State) -> tuple[FloatArray, FloatArray]:
    """Estimate (4,) and covariance (4, 4) of row 0."""
    mu = np.empty((1, len(models.kind)))
    imm.probabilities(models, s, 0, mu[0])
    mean, P = tracks.estimates(models, s.x[:1], s.P[:1], mu)
    return mean[0], P[0]


def assert_sound(models: Models, s: State, row: int = 0, slack: float = 1e-12) -> None:
    """Finite, symmetric, positive semi-definite (to ``slack`` of the scale of each), probabilities that sum to one."""
    for a in s:
        assert np.isfinite(a[row]).all()
    for j, d in enumerate(models.states.tolist()):
        P = s.P[row, j, :d, :d]
        assert np.array_equal(P, P.T)
        # Metres, metres a second and rad/s: compare what has been brought to one scale.
        scale = np.sqrt(np.maximum(np.diag(P), 1e-300))
        assert np.all(np.diag(P) >= 0)
        least, *_, most = np.linalg.eigvalsh(P / np.outer(scale, scale))
        assert least >= -slack * most
    for low, high in zip(models.first, models.first[1:], strict=False):
        assert abs(s.mu[row, low:high].sum() - 1.0) < 1e-9
        assert s.mu[row, low:high].min() >= 0
    assert abs(s.weight[row].sum() - 1.0) < 1e-9


def fresh_filters(models: Models, first: Plot, rows: int = 1, ring: int = 6) -> Filters:
    """Filters with the given number of rows, row 0 begun with the first plot."""
    f = make_filters(models, rows, ring)
    begin_row(models, f, 0, first)
    return f


def begin_row(models: Models, f: Filters, row: int, plot: Plot, sigma_v_mps: float = 150.0) -> None:
    tracks.begin(models, f, np.array([row]), plot.z[None], plot.R[None], np.array([plot.t_s]), sigma_v_mps)


def feed_row(models: Models, f: Filters, row: int, plot: Plot, sensor: int = 0) -> bool:
    taken = tracks.feed(models, f, np.array([row]), plot.z[None], plot.R[None], np.array([plot.t_s]), sensor)
    return bool(taken[0])


def copied(f: Filters) -> Filters:
    rest = {name: getattr(f, name).copy() for name in Filters._fields[2:]}
    return Filters(copied_state(f.head), copied_state(f.lag), **rest)


def head(f: Filters, row: int = 0) -> State:
    """The head of a row, as one row."""
    return State(*(a[row : row + 1].copy() for a in f.head))


def predicted(
    models: Models, f: Filters, rows: IntArray, t_s: FloatArray
) -> tuple[State, FloatArray, npt.NDArray[np.bool_]]:
    """Predictions of rows, the probabilities of all models, and which are known."""
    out, mu = make_state(models, len(rows)), np.zeros((len(rows), len(models.kind)))
    known = tracks.predict(models, f, rows, t_s, out, mu)
    return out, mu, known


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
    """Mean, covariance and model probabilities of one track after a walk with a late plot, as one row of numbers."""
    plots = random_walk(np.random.default_rng(11), 20)
    f = fresh_filters(models, plots[0])
    for plot in [*plots[1:10], *plots[11:14], plots[10], *plots[14:]]:
        feed_row(models, f, 0, plot)
    ahead, mu, _ = predicted(models, f, np.array([0]), f.head.t_s + 3.0)
    mean, P = tracks.estimates(models, ahead.x, ahead.P, mu)
    return np.concatenate([mean.ravel(), P.ravel(), mu.ravel()])
