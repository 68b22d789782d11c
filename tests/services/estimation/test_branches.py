"""Models with parameters of their own, their ages, and branches averaged by evidence."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import (
    DIRICHLET,
    GENERIC,
    LAW,
    MANOEUVRE,
    NAMED,
    TVIMM,
    FloatArray,
    Plot,
    assert_sound,
    begun,
    chain_matrix,
    copied_state,
    fields,
    filtered,
    interacted,
    output,
    random_state,
    random_walk,
    seeds,
    step_matrix,
    unpacked,
)

from trackmesh.services.estimation.bank import Models, State, make_models, make_work
from trackmesh.services.estimation.imm import MU_FLOOR, mix

FIRST = make_models((MANOEUVRE,))
SECOND = make_models((GENERIC,))
FIXED = make_models((MANOEUVRE._replace(age_s=None),))
WHOLE = make_models((MANOEUVRE._replace(split_s=1e300), GENERIC))


# --- mixing ---


def mixed(models: Models, s: State, pi: FloatArray, j: int) -> tuple[FloatArray, FloatArray, float]:
    """Model j after mixing, by definition: what comes from another model has j's prior as its own parameters."""
    d, r = int(models.states[j]), len(models.kind)
    mean, sd = models.numbers[j, 1], models.numbers[j, 2]
    weight = s.mu * pi[:, j]
    x, P = np.empty((r, d)), np.zeros((r, d, d))
    for a in range(r):
        x[a, :4], P[a, :4, :4] = s.x[a, :4], s.P[a, :4, :4]
        x[a, 4:], P[a, 4:, 4:] = mean, sd * sd * np.eye(d - 4)
    x[j], P[j] = s.x[j, :d], s.P[j, :d, :d]
    share = weight / weight.sum()
    whole = share @ x
    spread = np.einsum("a,ai,aj->ij", share, x - whole, x - whole)
    return whole, np.einsum("a,aij->ij", share, P) + spread, float(weight.sum())


@LAW
@given(seeds)
def test_what_comes_from_other_models_has_the_prior(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, w = random_state(rng, FIRST), make_work(FIRST)
    w.pi[:] = rng.dirichlet(np.ones(5), 5)
    before = copied_state(s)
    mix(FIRST, s, 0, 5, 2.0, w)
    for j, d in enumerate(FIRST.states.tolist()):
        x, P, c = mixed(FIRST, before, w.pi, j)
        unit = np.sqrt(np.diag(P))
        np.testing.assert_allclose(s.x[j, :d] / unit, x / unit, atol=1e-9)
        np.testing.assert_allclose(s.P[j, :d, :d] / np.outer(unit, unit), P / np.outer(unit, unit), atol=1e-9)
        assert s.mu[j] == pytest.approx(c, abs=1e-14)
        kept = before.mu[j] * w.pi[j, j] / c
        assert s.age_s[j] == pytest.approx(kept * (before.age_s[j] + 2.0), rel=1e-12)
    assert np.array_equal(s.P, np.swapaxes(s.P, -1, -2))


def test_branches_do_not_mix() -> None:
    rng = np.random.default_rng(1)
    s = random_state(rng, TVIMM)
    other = copied_state(s)
    other.x[5:] += 500.0
    one, two = interacted(TVIMM, s, 2.0), interacted(TVIMM, other, 2.0)
    assert np.array_equal(one.x[:5], two.x[:5])
    assert np.array_equal(one.P[:5], two.P[:5])


# --- ages ---


def test_without_age_constants_the_chain_is_fixed() -> None:
    zero = make_models((MANOEUVRE._replace(age_s=(0.0,) * 5),))
    plots = random_walk(np.random.default_rng(2), 25)
    s = filtered(FIXED, begun(FIXED, plots[0]), plots[1:])
    got = fields(filtered(zero, begun(zero, plots[0]), plots[1:]))
    for name, want in fields(s).items():
        np.testing.assert_allclose(got[name], want, rtol=1e-12, err_msg=name)
    for dt in (0.1, 1.0, 4.0):
        np.testing.assert_allclose(step_matrix(zero, s, dt), chain_matrix(zero, dt), atol=1e-12)


def test_at_one_age_the_chain_is_the_fixed_one() -> None:
    """0.05 + 1.3 (1 - exp(-age)) = 1."""
    dt, s = 1.0, random_state(np.random.default_rng(3), FIRST)
    s.age_s[:] = FIRST.age_s * np.log(1.3 / 0.35) - 0.5 * dt
    np.testing.assert_allclose(step_matrix(FIRST, s, dt), chain_matrix(FIRST, dt), atol=1e-12)


@LAW
@given(seeds, st.floats(0.01, 30.0))
def test_the_matrix_by_age(seed: int, dt: float) -> None:
    rng = np.random.default_rng(seed)
    s = random_state(rng, FIRST)
    s.age_s[:] = rng.exponential(30.0, 5)
    got, fixed = step_matrix(FIRST, s, dt), chain_matrix(FIRST, dt)
    np.testing.assert_allclose(got.sum(axis=1), 1.0, atol=1e-13)
    assert np.all(got >= 0)
    f = 0.05 + 1.3 * (1.0 - np.exp(-(s.age_s + 0.5 * dt) / FIRST.age_s))
    stay = np.clip(np.diag(fixed) ** f, 0.02, 0.9999)
    np.testing.assert_allclose(np.diag(got), stay, atol=1e-12)
    off = fixed * (1.0 - np.eye(5))
    np.testing.assert_allclose(got * (1.0 - np.eye(5)), off * ((1.0 - stay) / off.sum(axis=1))[:, None], atol=1e-12)


def test_a_model_is_left_more_readily_the_longer_it_lasts() -> None:
    s = random_state(np.random.default_rng(4), FIRST)
    stay = []
    for age in (0.0, 5.0, 20.0, 100.0):
        s.age_s[:] = age
        stay.append(np.diag(step_matrix(FIRST, s, 1.0)))
    assert np.all(np.diff(stay, axis=0) < 0)


# --- half steps ---


@pytest.mark.parametrize("dt", [3.001, 4.0, 10.0])
def test_a_long_interval_is_two_halves(dt: float) -> None:
    s = random_state(np.random.default_rng(5), TVIMM)
    halves = interacted(WHOLE, interacted(WHOLE, s, dt / 2), dt)
    once, got = interacted(WHOLE, s, dt), interacted(TVIMM, s, dt)
    for name in ("x", "P", "mu", "age_s"):
        manoeuvre, generic = (getattr(a, name)[rows] for a, rows in ((got, slice(5)), (got, slice(5, 8))))
        np.testing.assert_allclose(manoeuvre, getattr(halves, name)[:5], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(generic, getattr(once, name)[5:], rtol=1e-12, atol=1e-12)
    assert abs(halves.mu[:5] - once.mu[:5]).max() > 1e-4
    assert got.t_s == dt


def test_a_short_interval_is_whole() -> None:
    s = random_state(np.random.default_rng(6), TVIMM)
    got = fields(interacted(TVIMM, s, 3.0))
    for name, want in fields(interacted(WHOLE, s, 3.0)).items():
        assert np.array_equal(got[name], want), name


# --- the average of branches ---


def evidences(models: Models, s: State, plot: Plot) -> list[float]:
    """Log-density of a plot under each branch, predicted to the plot's time."""
    ahead, out = interacted(models, s, plot.t_s), []
    for low, high in itertools.pairwise(models.first.tolist()):
        density = [
            scipy.stats.multivariate_normal(ahead.x[j, :2], ahead.P[j, :2, :2] + unpacked(plot.R)).logpdf(plot.z)
            for j in range(low, high)
        ]
        out.append(float(scipy.special.logsumexp(density, b=ahead.mu[low:high])))
    return out


def manoeuvring(seed: int, n: int = 60) -> list[Plot]:
    """A walk with a turn in its middle: now one branch fits better, now the other."""
    rng = np.random.default_rng(seed)
    turned = np.cumsum(np.where((np.arange(n) > n // 3) & (np.arange(n) < 2 * n // 3), 0.08, 0.0))
    velocity = 180.0 * np.stack([np.cos(turned), np.sin(turned)], axis=1) + np.cumsum(rng.normal(0, 1, (n, 2)), axis=0)
    z = np.cumsum(velocity, axis=0) + rng.normal(0.0, 25.0, (n, 2))
    return [Plot(z[k], np.array([625.0, 0.0, 625.0]), float(k)) for k in range(n)]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.002, 0.02, 0.2])
def test_the_average_is_nearly_as_good_as_the_better_branch(seed: int, share: float) -> None:
    plots = random_walk(np.random.default_rng(seed), 60) if seed % 2 else manoeuvring(seed)
    both = make_models((MANOEUVRE, GENERIC), share=share)
    s, alone = begun(both, plots[0]), [begun(m, plots[0]) for m in (FIRST, SECOND)]
    log_both, log_alone = 0.0, np.zeros(2)
    for plot in plots[1:]:
        weight = (1.0 - share) * s.weight + share / 2.0
        log_both += scipy.special.logsumexp(evidences(both, s, plot), b=weight)
        log_alone += [evidences(m, a, plot)[0] for m, a in zip((FIRST, SECOND), alone, strict=True)]
        s = filtered(both, s, [plot])
        alone = [filtered(m, a, [plot]) for m, a in zip((FIRST, SECOND), alone, strict=True)]
        # Neither branch feeds the other.
        np.testing.assert_allclose(s.mu, np.concatenate([a.mu for a in alone]), rtol=1e-9, atol=1e-12)
    steps = len(plots) - 1
    bound = log_alone.max() - np.log(2.0) + steps * np.log(1.0 - share / 2.0)
    assert log_both >= bound - 1e-9
    assert log_both <= log_alone.max() + 0.5 * steps, "and no miracle"


def test_weights_follow_bayes_with_a_share_exchanged() -> None:
    plots = manoeuvring(7)
    s = begun(TVIMM, plots[0])
    for plot in plots[1:]:
        want = (0.98 * s.weight + 0.01) * np.exp(np.array(e := evidences(TVIMM, s, plot)) - max(e))
        s = filtered(TVIMM, s, [plot])
        np.testing.assert_allclose(s.weight, want / want.sum(), rtol=1e-9)


@pytest.mark.parametrize(("alone", "weight"), [(FIRST, [1.0, 0.0]), (SECOND, [0.0, 1.0])], ids=["first", "second"])
def test_without_exchange_all_weight_on_one_branch_is_that_branch(alone: Models, weight: list[float]) -> None:
    plots = manoeuvring(8)
    both = make_models((MANOEUVRE, GENERIC), share=0.0)
    s, one = begun(both, plots[0]), begun(alone, plots[0])
    s.weight[:] = weight
    for plot in plots[1:]:
        s, one = filtered(both, s, [plot]), filtered(alone, one, [plot])
        for got, want in zip(output(both, s), output(alone, one), strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(s.weight, weight, atol=1e-15)


def test_weights_differ_by_what_the_targets_do() -> None:
    turning, shaking = manoeuvring(9), random_walk(np.random.default_rng(9), 60, 25.0, (1.0, 1.0))
    ends = [filtered(TVIMM, begun(TVIMM, p[0]), p[1:40]).weight[0] for p in (turning, shaking)]
    assert ends[0] > 0.6 > ends[1]


# --- what must not break it ---


@pytest.mark.parametrize("models", NAMED.values(), ids=NAMED)
@pytest.mark.parametrize("dt", [0.01, 1.0, 10.0])
@pytest.mark.parametrize("ratio", [1.0, 1e6, 1e12])
def test_sound_from_any_start_at_any_rate(models: Models, dt: float, ratio: float) -> None:
    rng, R = np.random.default_rng(10), np.array([25.0, 0.0, 25.0])
    s = begun(models, Plot(np.zeros(2), R, 0.0))
    s.P[:, :4, :4] = np.eye(4) * 25.0 * ratio
    for k in range(60):
        s = filtered(models, s, [Plot(rng.normal(0.0, 5.0, 2) + 150.0 * dt * k, R, dt * (k + 1))])
        # Differences of numbers 1e12 apart leave 1e-4 of the smaller one.
        assert_sound(models, s, slack=max(1e-12, 1e-16 * ratio))


@pytest.mark.parametrize("models", NAMED.values(), ids=NAMED)
def test_sound_after_a_plot_75_sigma_away(models: Models) -> None:
    plots = manoeuvring(11)
    wild = plots[30]._replace(z=plots[30].z + 75.0 * 25.0 * np.array([1.0, 0.0]))
    s = begun(models, plots[0])
    for plot in [*plots[1:30], wild, *plots[31:]]:
        s = filtered(models, s, [plot])
        assert_sound(models, s)
    assert s.weight.min() > 0
    x, _ = output(models, s)
    assert np.linalg.norm(x[:2] - plots[-1].z) < 300.0


def test_sound_with_parameters_known_exactly() -> None:
    """A prior of no spread: singular covariances, and no parameter ever moves."""
    known = MANOEUVRE._replace(models=tuple(m._replace(sd=0.0) for m in MANOEUVRE.models))
    models = make_models((known, GENERIC))
    plots = manoeuvring(12)
    s = begun(models, plots[0])
    for plot in plots[1:]:
        s = filtered(models, s, [plot])
        assert_sound(models, s)
    np.testing.assert_allclose(s.x[1:3, 4], models.numbers[1:3, 1], rtol=1e-12)


@pytest.mark.parametrize("speed", [0.0, 1e-300, 1e-9, 0.5, 1.0])
def test_sound_at_rest(speed: float) -> None:
    """The direction of a velocity that is none has no meaning."""
    R = np.array([25.0, 0.0, 25.0])
    s = begun(TVIMM, Plot(np.zeros(2), R, 0.0))
    rng = np.random.default_rng(13)
    for k in range(40):
        s.x[:, 2], s.x[:, 3] = speed, 0.0
        s = filtered(TVIMM, s, [Plot(rng.normal(0.0, 5.0, 2), R, float(k + 1))])
        assert_sound(TVIMM, s)
    x, _ = output(TVIMM, s)
    assert np.linalg.norm(x[:2]) < 20.0


@LAW
@given(seeds)
def test_sound_on_any_walk_and_floored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plots = random_walk(rng, 12, 10 ** rng.uniform(0, 3), (0.01, 12.0))
    for models in (TVIMM, DIRICHLET):
        s = filtered(models, begun(models, plots[0]), plots[1:])
        assert_sound(models, s, slack=1e-10)
        assert s.mu.min() >= 0.9 * MU_FLOOR
