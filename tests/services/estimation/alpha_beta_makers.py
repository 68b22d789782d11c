"""What the tests of the alpha-beta filter share: targets, and the filter run over them."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from tests.services.estimation.makers import FloatArray, IntArray

from trackmesh.services.estimation import alpha_beta as ab

INDICES = (0.005, 0.0158, 0.05, 0.158, 0.3, 0.6, 1.2, 3.0)
"""The range for which a bank is made."""

scales = st.floats(-3.0, 3.0).map(lambda e: 10.0**e)


def held(k_end: IntArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Decreasing gains held from ``k_end`` (...) on, (..., n)."""
    return ab.decreasing_gains(np.minimum(np.arange(1, n + 1), np.asarray(k_end)[..., None]))


def simulated(index: float, tracks: int, plots: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Truth (plots, tracks, 4) and plots (plots, tracks, 2) with T = 1 and sigma_w = 1."""
    rng = np.random.default_rng(seed)
    x, truth = np.concatenate([np.zeros((tracks, 2)), rng.normal(0.0, 3.0, (tracks, 2))], axis=1), []
    for _ in range(plots):
        push = rng.normal(0.0, index, (tracks, 2))
        x = np.concatenate([x[:, :2] + x[:, 2:] + push / 2.0, x[:, 2:] + push], axis=1)
        truth.append(x)
    states = np.array(truth)
    return states, states[..., :2] + rng.normal(size=(plots, tracks, 2))


def filtered(z: FloatArray, dt_s: FloatArray, alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """States (plots, n, 4) of n tracks with plots (plots, n, 2) at intervals (plots,) under gains (plots,)."""
    n, x, found = z.shape[1], np.full((z.shape[1], 4), np.nan), []
    for k in range(len(z)):
        same = (np.full(n, v) for v in (dt_s[k], k + 1, alpha[k], beta[k]))
        x = ab.step(x, z[k], *same)
        found.append(x)
    return np.array(found)


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))
