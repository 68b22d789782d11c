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

from trackmesh.services.estimation import tracks
from trackmesh.services.estimation.imm import Models, filter_plot, make_models
from trackmesh.services.estimation.tracks import Filters, make_filters

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

LAW = settings(deadline=None, max_examples=60)
"""Kernels may have to be compiled in the first example, hence no deadline."""

MODELS = make_models(np.array([1.0, 50.0, 500.0]), np.array([50.0, 15.0, 15.0]))
DIRICHLET = make_models(np.array([1.0, 50.0, 500.0]), np.array([50.0, 15.0, 15.0]), prior_count=20.0)

SCALE = np.outer([100.0, 100.0, 10.0, 10.0], [100.0, 100.0, 10.0, 10.0])
"""Turns a random covariance into one of metres and metres a second."""

seeds = st.integers(0, 2**32 - 1)
sojourns = st.lists(st.floats(0.5, 500.0), min_size=1, max_size=4).map(np.array)


class Plot(NamedTuple):
    """One plot: z (2,), R (3,) [ee, en, nn], seconds."""

    z: FloatArray
    R: FloatArray
    t_s: float


class Track(NamedTuple):
    """The arrays of one filter."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    counts: FloatArray

    def copy(self) -> Track:
        return Track(*(a.copy() for a in self))


class Scratch(NamedTuple):
    """What the kernels want for intermediate results."""

    pi: FloatArray
    mx: FloatArray
    mP: FloatArray


def scratch(r: int) -> Scratch:
    return Scratch(np.empty((r, r)), np.empty((r, 4)), np.empty((r, 4, 4)))


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


def random_track(rng: np.random.Generator, r: int) -> Track:
    """A filter in the middle of its life, its models a few hundred metres apart."""
    x = rng.normal(size=(r, 4)) * [300.0, 300.0, 20.0, 20.0]
    P = covariances(rng, (r,), 4) * SCALE
    return Track(x, P, probabilities(rng, r), np.zeros((r, r)))


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
    S = H @ P @ H.T + unpacked(plot.R)
    K = np.linalg.solve(S, H @ P).T
    nu = plot.z - H @ x
    left = np.eye(4) - K @ H
    log_likelihood = -0.5 * (nu @ np.linalg.solve(S, nu) + np.linalg.slogdet(2 * np.pi * S)[1])
    return x + K @ nu, left @ P @ left.T + K @ unpacked(plot.R) @ K.T, float(log_likelihood)


def filtered(models: Models, track: Track, plots: list[Plot], t_s: float) -> Track:
    """A copy of a track at ``t_s`` that was fed the plots in order by the kernel of one track."""
    out, s = track.copy(), scratch(len(track.mu))
    for plot in plots:
        filter_plot(models, *out, plot.t_s - t_s, plot.z, plot.R, *s)
        t_s = plot.t_s
    return out


def fresh_filters(models: Models, first: Plot, rows: int = 1, ring: int = 6) -> Filters:
    """Filters with the given number of rows, row 0 begun with the first plot."""
    f = make_filters(rows, len(models.q), ring)
    begin_row(models, f, 0, first)
    return f


def begin_row(models: Models, f: Filters, row: int, plot: Plot, sigma_v_mps: float = 150.0) -> None:
    tracks.begin(models, f, np.array([row]), plot.z[None], plot.R[None], np.array([plot.t_s]), sigma_v_mps)


def feed_row(models: Models, f: Filters, row: int, plot: Plot, sensor: int = 0) -> bool:
    taken = tracks.feed(models, f, np.array([row]), plot.z[None], plot.R[None], np.array([plot.t_s]), sensor)
    return bool(taken[0])


def copied(f: Filters) -> Filters:
    return Filters(**{name: a.copy() for name, a in f._asdict().items()})


def head(f: Filters, row: int = 0) -> Track:
    return Track(f.x[row], f.P[row], f.mu[row], f.counts[row]).copy()


def predicted(models: Models, f: Filters, rows: IntArray, t_s: FloatArray) -> tuple[Track, npt.NDArray[np.bool_]]:
    """Predictions (m, ...) of rows and which are known; the counts are of no meaning."""
    r, m = len(models.q), len(rows)
    out = Track(np.empty((m, r, 4)), np.empty((m, r, 4, 4)), np.empty((m, r)), np.empty(0))
    known = tracks.predict(models, f, rows, t_s, out.x, out.P, out.mu)
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
    """Mean, covariance and model probabilities of one track after a walk with a late plot, as one row of numbers."""
    plots = random_walk(np.random.default_rng(11), 20)
    f = fresh_filters(models, plots[0])
    for plot in [*plots[1:10], *plots[11:14], plots[10], *plots[14:]]:
        feed_row(models, f, 0, plot)
    ahead, _ = predicted(models, f, np.array([0]), f.t_s + 3.0)
    mean, P = tracks.moments(ahead.x, ahead.P, ahead.mu)
    return np.concatenate([mean.ravel(), P.ravel(), ahead.mu.ravel()])
