"""The six-dimensional update of the slides: what it is where it works, and that it gives up where it does not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from tests.services.tags.makers import LAW, PLAIN, SQUARE, FloatArray, One, covariance, distances, ranges, seeds

from trackmesh.services.tags.filtering import filter_instant
from trackmesh.services.tags.printed import ORDER, cholesky, update_instant


def joint(
    x: FloatArray, P: FloatArray, z: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[bool, bool]]:
    """The update by whole matrices in the slides' order, and whether S and the new P are positive."""
    L = np.linalg.cholesky(P[np.ix_(ORDER, ORDER)]) * np.sqrt(3.0)
    offsets = np.vstack([np.zeros(6), L.T, -L.T])
    w = np.array([-1.0] + [1.0 / 6.0] * 12)
    points = x[:2] + offsets[:, [0, 3]]
    d = distances(points, SQUARE)
    mean = w @ d
    S = (d - mean).T @ (w[:, None] * (d - mean)) + R
    C = offsets.T @ (w[:, None] * (d - mean))
    K = C @ np.linalg.inv(S)
    after = P.copy()
    after[np.ix_(ORDER, ORDER)] -= K @ S @ K.T
    moved = x.copy()
    moved[ORDER] += K @ (z - mean)
    return moved, after, (bool(np.linalg.eigvalsh(S).min() > 0), bool(np.linalg.eigvalsh(after).min() > 0))


@LAW
@given(seed=seeds)
def test_is_the_joint_update_of_all_readers_of_an_instant(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = np.append(rng.uniform(5, 35, 2), rng.normal(size=4)), covariance(rng, 6, 9.0)
    z = distances(x[:2], SQUARE) + rng.normal(size=4)
    want_x, want_P, sound = joint(x, P, z, np.eye(4))
    got_x, got_P = x.copy(), P.copy()
    rows = [(0.0, reader, metres) for reader, metres in enumerate(z)]
    assert update_instant(got_x, got_P, SQUARE, ranges(*rows)) == all(sound)
    if all(sound):
        np.testing.assert_allclose(got_x, want_x, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(got_P, want_P, rtol=1e-8, atol=1e-8)
        assert (got_P == got_P.T).all()
    else:
        assert (got_x == x).all() and (got_P == P).all()


def failing_state(fault: tuple[bool, bool]) -> tuple[FloatArray, FloatArray]:
    """A place known less well than its distance, correlated with velocity and acceleration."""
    for seed in range(3000):
        rng = np.random.default_rng(seed)
        x, P = np.append(rng.uniform(0, 5, 2), np.zeros(4)), covariance(rng, 6, 400.0)
        if joint(x, P, distances(x[:2], SQUARE), 0.01 * np.eye(4))[2] == fault:
            return x, P
    raise AssertionError("no such state")


@pytest.mark.parametrize("fault", [(False, True), (True, False)])
def test_a_step_that_leaves_no_covariance_is_given_up(fault: tuple[bool, bool]) -> None:
    x, P = failing_state(fault)
    z = distances(x[:2], SQUARE)
    rows = ranges(*[(0.0, reader, metres) for reader, metres in enumerate(z)], sigma=0.1)
    one = One(update="ukf-printed", **PLAIN).begin().set(x, P)
    filter_instant(one.rules[0], one.f, SQUARE, rows, one.work[0])
    assert one.work[0].discarded == 1
    assert (one.f.x[0] == x).all() and (one.f.P[0] == P).all()
    # The two-dimensional form takes the same ranges in the same state.
    ours = One(update="ut", **PLAIN).begin().set(x, P)
    filter_instant(ours.rules[0], ours.f, SQUARE, rows, ours.work[0])
    assert np.linalg.eigvalsh(ours.f.P[0]).min() > 0
    assert np.trace(ours.f.P[0, :2, :2]) < 0.5 * np.trace(P[:2, :2])


def test_the_factor_is_that_of_a_covariance_or_none() -> None:
    P, L = covariance(np.random.default_rng(1), 5), np.empty((5, 5))
    assert cholesky(P, L)
    np.testing.assert_allclose(L, np.linalg.cholesky(P))
    P[4, 4] = -1.0
    assert not cholesky(P, L)
