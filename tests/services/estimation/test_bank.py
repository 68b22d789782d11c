from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import GENERIC, LAW, MANOEUVRE, TVIMM, FloatArray, chain

from trackmesh.services.estimation.bank import Branch, make_models, make_states
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models, velocity_models
from trackmesh.services.estimation.motion import CONSTANT_VELOCITY, SINGER, TURN, Model
from trackmesh.services.estimation.transition import generator, stationary

CV = Model("cv", CONSTANT_VELOCITY, 1.0)


def test_branches_stand_one_after_the_other() -> None:
    assert TVIMM.first.tolist() == [0, 5, 8]
    assert TVIMM.kind.tolist() == [
        CONSTANT_VELOCITY,
        TURN,
        TURN,
        5,
        SINGER,
        CONSTANT_VELOCITY,
        SINGER,
        CONSTANT_VELOCITY,
    ]
    assert TVIMM.states.tolist() == [4, 5, 5, 5, 6, 4, 6, 4]
    np.testing.assert_allclose([TVIMM.start[:5].sum(), TVIMM.start[5:].sum()], 1.0)
    states = make_states(TVIMM, 7)
    assert (states["x"].shape, states["P"].shape, states["counts"].shape) == ((7, 8, 6), (7, 8, 6, 6), (7, 8, 5))
    assert states["y"].shape == (7, 0, 8, 4), "no lag is kept unless asked for"


def test_the_chain_of_each_branch_stands_by_itself() -> None:
    """The shorter branch is filled up with models that are never left."""
    for b, branch in enumerate((MANOEUVRE, GENERIC)):
        n = len(branch.models)
        G = TVIMM.rate[b] * (TVIMM.jump[b, 0] - np.eye(5))
        np.testing.assert_allclose(G[:n, :n], generator(np.array(branch.sojourn_s), branch.jumps), atol=1e-16)
        assert not G[n:].any()
        assert not G[:, n:].any()


def test_lags_make_room_for_the_past() -> None:
    states = make_states(make_models((GENERIC,), lags=2), 3)
    shapes = {name: states[name].shape for name in ("y", "C", "Y", "y_t_s")}
    assert shapes == {"y": (3, 2, 3, 4), "C": (3, 2, 3, 6, 4), "Y": (3, 2, 3, 4, 4), "y_t_s": (3, 2)}


@pytest.mark.parametrize(
    ("branch", "extra"),
    [
        (velocity_models([1.0], [1.0, 2.0]), {}),
        (velocity_models([0.0], [1.0]), {}),
        (velocity_models([1.0], [0.0]), {}),
        (velocity_models([1.0], [1.0], prior_count=0.0), {}),
        (velocity_models([1.0], [1.0]), {"memory_s": -1.0}),
        (velocity_models([1.0], [1.0]), {"reference_s": 0.0}),
        (velocity_models([1.0], [1.0]), {"share": 1.1}),
        (velocity_models([1.0], [1.0]), {"lags": -1}),
        (velocity_models([1.0], [1.0]), {"lags": 1, "printed": True}),
        (Branch((CV._replace(sd=-1.0),), (1.0,)), {}),
        (Branch((CV._replace(time_s=0.0),), (1.0,)), {}),
        (Branch((CV, CV), (1.0, 1.0), start=(0.5, 0.4)), {}),
        (Branch((CV, CV), (1.0, 1.0), start=(1.0,)), {}),
        (Branch((CV, CV), (1.0, 1.0), age_s=(1.0,)), {}),
        (Branch((CV, CV), (1.0, 1.0), age_s=(1.0, -1.0)), {}),
        (Branch((CV, CV), (1.0, 1.0), jumps=np.eye(2)), {}),
    ],
)
def test_models_that_make_no_sense_are_refused(branch: Branch, extra: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"positive|must be|must not be|needs one"):
        make_models((branch,), **extra)


def test_the_published_form_has_one_branch() -> None:
    with pytest.raises(ValueError, match="no more than one"):
        make_models((GENERIC, GENERIC), printed=True)
    with pytest.raises(ValueError, match="needs a branch"):
        make_models(())


def matrix(branch: Branch, dt_s: float) -> FloatArray:
    return chain(generator(np.array(branch.sojourn_s), branch.jumps), dt_s)


words = st.tuples(st.floats(0.5, 60.0), st.floats(2.0, 200.0), st.floats(2.0, 600.0), st.floats(0.01, 3.0))


@LAW
@given(words, st.floats(0.0, 600.0))
def test_any_words_make_a_chain_with_the_matrix_exponential(word: tuple[float, ...], dt: float) -> None:
    """Quiet times of three to five manoeuvres give the chain complex eigenvalues."""
    a, manoeuvre_s, quiet_s, q = word
    for branch in (manoeuvre_models(0.1, a, manoeuvre_s, quiet_s, q), generic_models(a, manoeuvre_s, quiet_s, q)):
        assert branch.jumps is not None
        G = (branch.jumps - np.eye(len(branch.models))) / np.array(branch.sojourn_s)[:, None]
        np.testing.assert_allclose(matrix(branch, dt), scipy.linalg.expm(G * dt), atol=1e-12)
        p = stationary(generator(np.array(branch.sojourn_s), branch.jumps))
        np.testing.assert_allclose(p @ matrix(branch, dt), p, atol=1e-9)


def test_a_manoeuvre_is_left_for_straight_flight() -> None:
    assert MANOEUVRE.jumps is not None
    assert np.all(MANOEUVRE.jumps[1:4].argmax(axis=1) == 0)
    np.testing.assert_allclose(MANOEUVRE.jumps.sum(axis=1), 1.0)
    # Over a short interval the matrix is 1 - dt/tau, and J over the rest.
    dt = 1e-4
    want = np.eye(5) + dt * (MANOEUVRE.jumps - np.eye(5)) / np.array(MANOEUVRE.sojourn_s)[:, None]
    np.testing.assert_allclose(matrix(MANOEUVRE, dt), want, atol=1e-9)
