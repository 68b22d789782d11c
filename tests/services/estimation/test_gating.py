from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    LAW,
    FloatArray,
    covariances,
    packed,
    seeds,
    unpacked,
)

from trackmesh.services.estimation.gating import Mixture, gate, mixture_cost
from trackmesh.services.estimation.plots import Plots, make_plots


class Scene(NamedTuple):
    """Tracks, their times, plots."""

    tracks: Mixture
    t_s: FloatArray
    plots: Plots


def scene(rng: np.random.Generator, n: int, m: int, r: int, span_m: float = 2000.0) -> Scene:
    """n mixtures of r models and m plots in a square, times up to 3 s apart."""
    centre = rng.uniform(0, span_m, (n, 1, 2))
    x = np.concatenate([centre + rng.normal(0, 60, (n, r, 2)), rng.normal(0, 150, (n, r, 2))], axis=2)
    P = covariances(rng, (n, r), 4, 900.0)
    mu = rng.dirichlet(np.ones(r), n)
    z = rng.uniform(-200, span_m + 200, (m, 2))
    t_s, R = rng.uniform(-1.5, 1.5, n), packed(covariances(rng, (m,), 2, 900.0))
    return Scene(Mixture(x, P, mu), t_s, make_plots(z, R, rng.uniform(-1.5, 1.5, m)))


def brute_force(things: Scene, limit: float) -> dict[tuple[int, int], float]:
    """Every pair inside a model's ellipse, with -2 ln of the mixture density but for its constant."""
    x, P, mu = things.tracks
    found = {}
    for i in range(len(x)):
        for j, plot in enumerate(things.plots):
            nu = plot["z"] - x[i, :, :2] - (plot["t_s"] - things.t_s[i]) * x[i, :, 2:]
            S = P[i, :, :2, :2] + unpacked(plot["R"])
            distance = np.einsum("ra,ra->r", nu, np.linalg.solve(S, nu[..., None])[..., 0])
            if (distance <= limit).any():
                log_weight = np.log(mu[i]) - 0.5 * (distance + np.linalg.slogdet(S)[1])
                found[i, j] = -2.0 * float(scipy.special.logsumexp(log_weight))
    return found


@LAW
@given(seeds, st.integers(1, 12), st.integers(1, 15), st.integers(1, 3), st.sampled_from([4.0, 16.0, 25.0]))
def test_finds_exactly_the_pairs_of_brute_force(seed: int, n: int, m: int, r: int, limit: float) -> None:
    things = scene(np.random.default_rng(seed), n, m, r)
    want = brute_force(things, limit)
    i, j, cost = gate(*things, limit)
    got = dict(zip(zip(i.tolist(), j.tolist(), strict=True), cost.tolist(), strict=True))
    assert len(got) == len(i), "a pair is listed twice"
    assert got.keys() == want.keys()
    for pair, value in want.items():
        assert got[pair] == pytest.approx(value, abs=1e-8)


def test_more_pairs_than_room_was_made_for() -> None:
    rng = np.random.default_rng(1)
    things = scene(rng, 60, 70, 2, span_m=1.0)
    i, j, _ = gate(*things, 1e6)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(a, b) for a in range(60) for b in range(70)]


def test_pairs_come_in_order_of_track_then_north() -> None:
    things = scene(np.random.default_rng(2), 20, 30, 2, span_m=300.0)
    i, j, _ = gate(*things, 25.0)
    north = things.plots["z"][:, 1]
    keys: list[tuple[int, float]] = [(int(a), float(north[b])) for a, b in zip(i, j, strict=True)]
    assert len(keys) > 30
    assert keys == sorted(keys)


def test_the_cost_of_one_model_is_the_normal_density() -> None:
    (x, P, mu), _, plots = scene(np.random.default_rng(3), 1, 1, 1, span_m=10.0)
    z, R = plots[0]["z"], plots[0]["R"]
    cost = mixture_cost(x[0], P[0], mu[0], z, R, 0.0, 1e9)
    density = scipy.stats.multivariate_normal(x[0, 0, :2], P[0, 0, :2, :2] + unpacked(R))
    assert -0.5 * cost - np.log(2 * np.pi) == pytest.approx(density.logpdf(z), abs=1e-9)


def test_a_plot_in_the_wide_model_alone_is_inside() -> None:
    x = np.zeros((2, 4))
    P = np.stack([np.eye(4), 1e4 * np.eye(4)])
    z, R = np.array([200.0, 0.0]), np.array([1.0, 0.0, 1.0])
    assert np.isfinite(mixture_cost(x, P, np.array([0.999999, 1e-6]), z, R, 0.0, 16.0))
    assert np.isinf(mixture_cost(x[:1], P[:1], np.ones(1), z, R, 0.0, 16.0))


def test_a_covariance_that_is_not_positive_is_in_no_gate() -> None:
    assert np.isinf(
        mixture_cost(np.zeros((1, 4)), -np.eye(4)[None], np.ones(1), np.zeros(2), np.array([1.0, 0.0, 1.0]), 0.0, 16.0)
    )


@pytest.mark.parametrize(("n", "m"), [(0, 3), (3, 0), (0, 0)])
def test_nothing_on_one_side_gives_no_pairs(n: int, m: int) -> None:
    rng = np.random.default_rng(4)
    tracks, t_s, plots = scene(rng, 3, 3, 2)
    i, j, cost = gate(Mixture(*(part[:n] for part in tracks)), t_s[:n], plots[:m], 16.0)
    assert i.tolist() == j.tolist() == cost.tolist() == []
