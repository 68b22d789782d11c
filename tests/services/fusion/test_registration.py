from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.services.fusion.biased import (
    EAST,
    LARGE,
    NORTH,
    PLACES,
    RING,
    SMALL,
    WEST,
    Sky,
    Station,
    Tracked,
    announced,
    assert_registered,
    biased,
    errors,
    finish,
    run,
)

from trackmesh.services.fusion.biases import RegistrationRules
from trackmesh.services.fusion.registration import Registration

FloatArray = npt.NDArray[np.float64]

STILL = RegistrationRules(walk_m=0.0, walk_azimuth_rad=0.0, walk_time_offset_s=0.0)
INDEPENDENT = STILL._replace(
    correlation_s=0.0, outlier_distance=np.inf, jump_distance=np.inf, free_period_s=0.0, locked_period_s=0.0
)
FREE = RegistrationRules(lock_m=0.0)


# --- what is learnt ---


@pytest.mark.parametrize("bias", [SMALL, LARGE])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_two_radars_are_registered_within_two_minutes(seed: int, bias: tuple[float, float, float]) -> None:
    sky = Sky(seed, 50, [NORTH, EAST._replace(bias=bias)])
    registration = announced(sky)
    finish(registration, sky, 120.0)
    assert_registered(registration, sky)
    assert registration.locked("north")
    assert registration.locked("east")


@pytest.mark.parametrize("n", [2, 4])
def test_few_targets_take_longer_to_lock_and_tell_less(n: int) -> None:
    sky = Sky(4, n, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    locked = [t_s for t_s, changes in run(registration, sky, 120.0) if any(c.kind == "locked" for c in changes)]
    assert locked[0] > 0.0
    assert_registered(registration, sky, metres=150.0, degrees=0.3)


def test_static_biases_are_the_batch_least_squares_solution() -> None:
    sky = Sky(5, 12, [PLACES._replace(name=name, bias=bias) for name, bias in POSITIONS], correlation_s=0.0)
    registration = announced(sky, INDEPENDENT)
    looks = []
    for t_s in (0.0, 2.0, 4.0, 6.0):
        looks.append(sky.look(t_s))
        for i, j in ((0, 1), (2, 0), (1, 2)):
            names = sky.stations[i].name, sky.stations[j].name
            assert registration.update(*names, *looks[-1][i], *looks[-1][j], t_s)
        registration.settle(t_s)
    beta, P = batch_solution(looks)
    assert np.concatenate([e.bias for e in registration.messages()]) == pytest.approx(beta, rel=1e-9)
    for k, estimate in enumerate(registration.messages()):
        assert estimate.covariance == pytest.approx(P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], rel=1e-9, abs=1e-6)


POSITIONS = (("a", (50.0, -80.0, 0.0)), ("b", (-120.0, 20.0, 0.0)), ("c", (0.0, 90.0, 0.0)))


def batch_solution(looks: list[list[Tracked]]) -> tuple[FloatArray, FloatArray]:
    """Biases (6,) of three position sensors, with every target's place at every time as an unknown beside them."""
    n = len(looks[0][0].x)
    unknowns = 6 + 2 * n * len(looks)
    rows, right = [np.eye(6, unknowns) / 100.0], [np.zeros(6)]
    for time, look in enumerate(looks):
        for k, (x, P) in enumerate(look):
            for target in range(n):
                H = np.zeros((2, unknowns))
                H[:, 2 * k : 2 * k + 2] = np.eye(2)
                place = 6 + 2 * (time * n + target)
                H[:, place : place + 2] = np.eye(2)
                root = np.linalg.inv(np.linalg.cholesky(P[target, :2, :2]))
                rows.append(root @ H)
                right.append(root @ x[target, :2])
    A = np.concatenate(rows)
    solution, *_ = np.linalg.lstsq(A, np.concatenate(right), rcond=None)
    return np.asarray(solution[:6], float), np.asarray(np.linalg.inv(A.T @ A)[:6, :6], float)


@pytest.mark.parametrize(("size", "tolerance"), [(1.0, 0.1), (0.1, 0.01), (0.01, 0.001)])
def test_polar_biases_are_the_nonlinear_least_squares_solution(size: float, tolerance: float) -> None:
    # Not exactly: the filter does not turn and stretch the covariances of raw tracks with their positions.
    first, second = ((size * b[0], size * b[1], 0.0) for b in (LARGE, (-900.0, 0.03)))
    sky = Sky(6, 20, [NORTH._replace(bias=first), EAST._replace(bias=second)], noise=0.01)
    registration = announced(sky, INDEPENDENT)
    a, b = sky.look(0.0)
    registration.update("north", "east", *a, *b, 0.0)
    registration.settle(0.0)
    prior = np.tile(INDEPENDENT.prior("polar")[:2], 2)

    def cost(scaled: FloatArray) -> FloatArray:
        beta, places = scaled[:4] * prior, scaled[4:].reshape(-1, 2) * 1e3
        parts = [scaled[:4]]
        for tracked, station, own in ((a, NORTH, beta[:2]), (b, EAST, beta[2:])):
            measured = biased(station._replace(bias=(own[0], own[1], 0.0)), places)
            left = (tracked.x[:, :2] - measured)[:, :, None]
            parts.append(np.linalg.solve(np.linalg.cholesky(tracked.P[:, :2, :2]), left).ravel())
        return np.concatenate(parts)

    start = np.concatenate([np.zeros(4), sky.truth(0.0).ravel() / 1e3])
    best = scipy.optimize.least_squares(cost, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x[:4] * prior
    found = np.concatenate([e.bias for e in registration.messages()])
    sigma = np.sqrt(np.concatenate([np.diag(e.covariance) for e in registration.messages()]))
    assert np.abs((found - best) / sigma).max() < tolerance


def test_a_third_sensor_helps_and_all_share_one_covariance() -> None:
    stations = [
        NORTH._replace(bias=(-200.0, 0.002, 0.0)),
        EAST._replace(bias=SMALL),
        WEST._replace(bias=(0.0, -0.01, 0.0)),
    ]
    sky = Sky(7, 50, stations)
    registration = announced(sky)
    finish(registration, sky, 120.0)
    assert_registered(registration, sky)
    # North and west never see a target together, and still each is known through east.
    chain = announced(sky)
    for t_s in np.arange(200.0, 320.0, 2.0).tolist():
        looks = sky.look(t_s)
        chain.update("north", "east", *looks[0], *looks[1], t_s)
        chain.update("west", "east", *looks[2], *looks[1], t_s)
        chain.settle(t_s)
    assert_registered(chain, sky)
    at = RING + np.array([0.0, 20e3])
    alone = chain.covariance("north", at) + chain.covariance("west", at)
    together = chain.difference("north", "west", at, at)[1]
    ratio = np.trace(together, axis1=1, axis2=2) / np.trace(alone, axis1=1, axis2=2)
    assert np.abs(ratio - 1.0).max() > 0.03


def test_a_position_sensor_and_a_radar_are_registered() -> None:
    sky = Sky(8, 50, [NORTH._replace(bias=SMALL), PLACES._replace(bias=(-70.0, 90.0, 0.0))])
    registration = announced(sky)
    finish(registration, sky, 120.0)
    assert_registered(registration, sky)


def test_the_order_in_which_sensors_and_pairs_come_makes_no_difference() -> None:
    sky = Sky(9, 30, [NORTH, EAST._replace(bias=SMALL), WEST])
    looks = {s.name: look for s, look in zip(sky.stations, sky.look(0.0), strict=True)}
    found = []
    for order in (["north", "east", "west"], ["west", "east", "north"]):
        registration = Registration(FREE)
        for name in order:
            registration.announce(name, "polar", next(s.site_m for s in sky.stations if s.name == name))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            registration.update(order[a], order[b], *looks[order[a]], *looks[order[b]], 0.0)
        registration.settle(0.0)
        found.append({e.sensor_id: e.bias for e in registration.messages()})
    for name, bias in found[0].items():
        assert found[1][name] == pytest.approx(bias, rel=1e-6)


def test_a_time_offset_is_found_where_it_is_looked_for() -> None:
    offset = [NORTH._replace(bias=SMALL), EAST._replace(bias=(-100.0, 0.003, 0.5))]
    sky = Sky(10, 60, offset)
    registration = announced(sky, RegistrationRules(prior_time_offset_s=0.5))
    finish(registration, sky, 120.0)
    north, east = registration.messages()
    assert east.time_offset_s - north.time_offset_s == pytest.approx(0.5, abs=0.1)
    assert registration.time_offset_s("east") == pytest.approx(east.time_offset_s, abs=0.05)
    assert_registered(registration, sky)
    assert north.notes == ["time_offset_s: known only in relation to east"]
    assert north.observable == [True, True, False]
    still = announced(sky)
    finish(still, sky, 240.0, begin_s=130.0)
    assert [e.time_offset_s for e in still.messages()] == [0.0, 0.0]


def test_a_clock_that_is_right_makes_the_time_offset_of_the_other_known() -> None:
    sky = Sky(11, 60, [NORTH, PLACES._replace(bias=(50.0, 0.0, -0.5))])
    registration = Registration(RegistrationRules(prior_time_offset_s=0.5))
    registration.announce("north", "polar", prior=[300.0, 0.01, 0.0])
    registration.announce("places", "position")
    finish(registration, sky, 120.0)
    north, places = registration.messages()
    assert north.time_offset_s == 0.0
    assert places.time_offset_s == pytest.approx(-0.5, abs=0.1)
    assert all(places.observable)


def test_wrong_pairs_weigh_less() -> None:
    sky = Sky(12, 40, [NORTH, EAST._replace(bias=SMALL)])
    registration = announced(sky)
    for t_s in np.arange(0.0, 120.0, 2.0).tolist():
        a, b = sky.look(t_s)
        rows = np.arange(40)
        rows[:4] = [1, 2, 3, 0]
        b.x[rows[:4], :2] = a.x[:4, :2] + [1500.0, 700.0]
        registration.update("north", "east", *a, b.x[rows], b.P[rows], t_s)
        registration.settle(t_s)
    assert_registered(registration, sky, metres=60.0)


# --- whether it knows how well it knows ---


@pytest.mark.parametrize("stations", [[NORTH, EAST], [NORTH, EAST, WEST], [NORTH, PLACES], [NORTH, NORTH]])
def test_errors_are_as_large_as_the_covariance_says(stations: list[Station]) -> None:
    nees = []
    for seed in range(20):
        rng = np.random.default_rng(1000 + seed)
        sky = Sky(seed, 25, [s._replace(name=f"{k}", bias=drawn(rng, s)) for k, s in enumerate(stations)])
        registration = announced(sky, STILL)
        finish(registration, sky, 80.0)
        nees += [
            e @ np.linalg.solve(told.covariance, e) / 2.0
            for e, told in zip(errors(registration, sky).values(), registration.messages(), strict=True)
        ]
    assert 0.5 < np.mean(nees) < 1.5


def drawn(rng: np.random.Generator, station: Station) -> tuple[float, float, float]:
    first, second, _ = (STILL.prior(station.kind) * rng.standard_normal(3).clip(-2, 2)).tolist()
    return first, second, 0.0


def test_a_sum_that_cannot_be_known_does_not_drift() -> None:
    sky = Sky(13, 50, [NORTH, NORTH._replace(name="same", bias=SMALL)])
    registration = announced(sky, STILL)
    for t_s in np.arange(0.0, 1600.0, 8.0).tolist():
        registration.update("north", "same", *sky.look(t_s)[0], *sky.look(t_s + 1.0)[1], t_s)
        sky.t_s = t_s
        registration.settle(t_s)
    north, same = registration.messages()
    assert north.bias + same.bias == pytest.approx([0.0, 0.0], abs=1e-3)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    steps=st.lists(
        st.tuples(
            st.sampled_from([(0, 1), (1, 2), (2, 0)]), st.integers(0, 8), st.floats(0.0, 300.0), st.floats(1.0, 1e5)
        ),
        min_size=1, max_size=10,
    ),
)  # fmt: skip
def test_covariances_stay_covariances_whatever_is_handed_over(
    seed: int, steps: list[tuple[tuple[int, int], int, float, float]]
) -> None:
    rng, t_s = np.random.default_rng(seed), 0.0
    registration = announced(Sky(seed, 1, [NORTH, EAST, PLACES]), RegistrationRules(prior_time_offset_s=0.5))
    for pair, n, dt_s, size_m in steps:
        t_s += dt_s
        names = [("north", "east", "places")[k] for k in pair]
        tracks = [(rng.normal(0, size_m, (n, 4)), np.tile(np.diag([1e4, 1e4, 100.0, 100.0]), (n, 1, 1))) for _ in pair]
        registration.update(names[0], names[1], *tracks[0], *tracks[1], t_s)
        registration.settle(t_s)
        P = registration.snapshot()["covariance"]
        assert np.array_equal(P, P.T)
        scale = np.sqrt(np.diag(P))
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 0.0
        assert np.isfinite(registration.snapshot()["bias"]).all()
        for estimate in registration.messages():
            assert np.linalg.eigvalsh(registration.covariance(estimate.sensor_id, RING)).min() > -1e-6
        assert np.linalg.eigvalsh(registration.difference("north", "places", RING, RING)[1]).min() > -1e-6
