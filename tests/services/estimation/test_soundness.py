"""States that are none are repaired; and a million steps later a covariance is still one."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from tests.services.estimation.makers import (
    LAGGED,
    MODELS,
    TVIMM,
    TVIMM_LAGGED,
    Plot,
    assert_sound,
    batch,
    begun,
    copied_state,
    filtered,
    output,
    random_walk,
)

from trackmesh.services.estimation import imm
from trackmesh.services.estimation.bank import Models, State, Work, make_work
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FILTERS = {"imm": MODELS, "tvimm": TVIMM, "imm with lags": LAGGED, "tvimm with lags": TVIMM_LAGGED}

# --- repairs ---


def negative(s: State) -> None:
    s.P[1, 0, 0] = -1e4


def correlated_beyond_one(s: State) -> None:
    s.P[0, 0, 2] = s.P[0, 2, 0] = 3.0 * np.sqrt(s.P[0, 0, 0] * s.P[0, 2, 2])


def of_mixed_signs(s: State) -> None:
    """Eigenvalues 1, 1, -1, -1 in velocity against position."""
    s.P[2, :4, :4] = np.kron([[0.0, 1.0], [1.0, 0.0]], np.eye(2)) * 1e3


def at_odds(s: State) -> None:
    """No two components are, all together are."""
    scale = np.sqrt(np.diag(s.P[0, :4, :4]))
    rho = np.eye(4)
    rho[0, 1], rho[0, 2], rho[1, 2] = 0.9, 0.9, -0.9
    s.P[0, :4, :4] = np.maximum(rho, rho.T) * np.outer(scale, scale)
    s.P[0, 1, 2] = s.P[0, 2, 1] = -0.9 * scale[1] * scale[2]


def not_a_number(s: State) -> None:
    s.P[1, 2, 3] = s.P[1, 3, 2] = np.nan


def infinite(s: State) -> None:
    s.P[0, 1, 1] = np.inf


def nowhere(s: State) -> None:
    s.x[1, 0] = np.nan


def endless(s: State) -> None:
    s.x[2, 3] = -np.inf


def nothing_at_all(s: State) -> None:
    s.x[:, :4], s.P[:, :4, :4] = np.nan, np.nan


SPOILT = [
    negative,
    correlated_beyond_one,
    of_mixed_signs,
    at_odds,
    not_a_number,
    infinite,
    nowhere,
    endless,
    nothing_at_all,
]


@pytest.mark.parametrize("models", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("spoil", SPOILT, ids=lambda f: f.__name__)
@pytest.mark.parametrize("wait_s", [0.0, 2.0])
def test_a_state_that_is_none_is_repaired_at_the_next_plot(
    models: Models, spoil: Callable[[State], None], wait_s: float
) -> None:
    plots = random_walk(np.random.default_rng(1), 20, every_s=(1.0, 3.0))
    s, w = filtered(models, begun(models, plots[0]), plots[1:10]), make_work(models)
    spoil(s)
    again = plots[10]._replace(t_s=plots[9].t_s + wait_s)
    imm.filter_plot(models, s, batch(again)[0], w)
    if wait_s == 0.0:
        assert w.repairs == (len(models.kind) if spoil is nothing_at_all else 1)
    # Over an interval mixing may spoil the others, or heal.
    assert w.repairs <= len(models.kind)
    assert_sound(models, s)
    repaired = w.repairs
    for plot in plots[11:]:
        imm.filter_plot(models, s, batch(plot)[0], w)
        assert_sound(models, s)
    assert w.repairs == repaired, "once is enough"
    x, P = output(models, s)
    off = x[:2] - plots[-1].z
    assert off @ np.linalg.solve(P[:2, :2] + [[3600.0, 0.0], [0.0, 3600.0]], off) < 30.0, "it follows again"


@pytest.mark.parametrize("models", FILTERS.values(), ids=FILTERS)
def test_what_is_sound_is_never_repaired(models: Models) -> None:
    rng = np.random.default_rng(2)
    for sigma_m in (0.1, 10.0, 1e3):
        plots, w = random_walk(rng, 60, sigma_m, (0.01, 12.0)), make_work(models)
        s = begun(models, plots[0])
        for plot in plots[1:]:
            imm.filter_plot(models, s, batch(plot)[0], w)
        assert w.repairs == 0


def test_a_repair_keeps_what_variances_there_are() -> None:
    s, w = filtered(MODELS, begun(MODELS, (p := random_walk(np.random.default_rng(3), 8))[0]), p[1:]), make_work(MODELS)
    sound = copied_state(s)
    correlated_beyond_one(s)
    twin = p[-1]._replace(R=np.array([1e12, 0.0, 1e12]))
    imm.filter_plot(MODELS, s, batch(twin)[0], w)
    assert w.repairs == 1
    np.testing.assert_allclose(s.P[0], np.diag(np.diag(sound.P[0])), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(s.x[0], sound.x[0], atol=1e-4)
    np.testing.assert_allclose(s.P[1:], sound.P[1:], rtol=1e-6)


def test_a_layer_counts_its_repairs() -> None:
    plots = random_walk(np.random.default_rng(4), 6)
    tracks, row = ImmTracks(MODELS, 1, 6, 150.0), np.array([0])
    tracks.begin(row, batch(plots[0]))
    tracks.feed(row, batch(plots[1]))
    assert tracks.repairs == 0
    tracks.filters.head["P"][0, 0, 0, 0] = -1e6
    tracks.feed(row, batch(plots[2]))
    assert tracks.repairs > 0
    _, known = tracks.predict(row, tracks.t_s)
    assert known.all()
    assert np.isfinite(tracks.mean).all()


# --- a long life ---


@kernel
def _many_steps(models: Models, s: State, plots: Plots, rounds: int, dt_s: float, w: Work) -> None:
    """Feed the plots again and again, one every ``dt_s``."""
    for _ in range(rounds):
        for k in range(len(plots)):
            plots[k].t_s = s.t_s + dt_s
            imm.filter_plot(models, s, plots[k], w)


@pytest.mark.parametrize(
    ("models", "rounds"), [(MODELS, 1000), (TVIMM, 250), (LAGGED, 250)], ids=["imm", "tvimm", "lags"]
)
@pytest.mark.parametrize("dt_s", [0.01, 4.0])
def test_a_million_steps_later_it_is_as_sound(models: Models, rounds: int, dt_s: float) -> None:
    """About a target that stands, circles within its errors, and is measured by turns well and badly."""
    rng, n = np.random.default_rng(5), 1000
    z = rng.normal(0.0, 50.0, (n, 2)) + 1e4
    R = np.array([[100.0, 30.0, 2500.0], [1e4, -5e3, 4e4]])[np.arange(n) % 2]
    plots, w = batch(*itertools.starmap(Plot, zip(z, R, np.zeros(n), strict=True))), make_work(models)
    s = begun(models, Plot(z[0], R[0], 0.0))
    _many_steps(models, s, plots, rounds, dt_s, w)
    assert s.t_s == pytest.approx(rounds * n * dt_s, rel=1e-9)
    assert w.repairs == 0
    assert_sound(models, s)
    x, P = output(models, s)
    assert np.all(abs(x[:2] - 1e4) < 5.0 * np.sqrt(np.diag(P)[:2]) + 50.0)
