from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import GENERIC, LAW, MANOEUVRE, TVIMM, FloatArray

from trackmesh.services.estimation.bank import Branch, make_models, make_state
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models, velocity_models
from trackmesh.services.estimation.motion import CONSTANT_VELOCITY, SINGER, TURN, Model
from trackmesh.services.estimation.transition import generator, stationary, transition_matrix

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
    state = make_state(TVIMM, 7)
    assert (state.x.shape, state.P.shape, state.counts.shape) == ((7, 8, 6), (7, 8, 6, 6), (7, 8, 5))


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
    with pytest.raises(ValueError, match=r"positive|must be|needs one"):
        make_models((branch,), **extra)


def test_the_published_form_has_one_branch() -> None:
    with pytest.raises(ValueError, match="no more than one"):
        make_models((GENERIC, GENERIC), printed=True)
    with pytest.raises(ValueError, match="needs a branch"):
        make_models(())


def matrix(branch: Branch, dt_s: float) -> FloatArray:
    out = np.empty((len(branch.models),) * 2)
    transition_matrix(generator(np.array(branch.sojourn_s), branch.jumps), dt_s, out)
    return out


words = st.tuples(st.floats(0.5, 60.0), st.floats(2.0, 200.0), st.floats(2.0, 600.0), st.floats(0.01, 3.0))


@LAW
@given(words, st.floats(0.0, 600.0))
def test_any_words_make_a_chain_with_the_matrix_exponential(word: tuple[float, ...], dt: float) -> None:
    """Quiet times of three to five manoeuvres give the chain complex eigenvalues."""
    a, manoeuvre_s, quiet_s, q = word
    for branch in (manoeuvre_models(0.1, a, manoeuvre_s, quiet_s, q), generic_models(a, manoeuvre_s, quiet_s, q)):
        assert branch.jumps is not None
        G = (branch.jumps - np.eye(len(branch.models))) / np.array(branch.sojourn_s)[:, None]
        np.testing.assert_allclose(matrix(branch, dt), scipy.linalg.expm(G * dt), atol=1e-9)
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
