"""What the tests of the simulation share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.messages import TrackFrame
from trackmesh.sim.recording import START_NS
from trackmesh.sim.scenario import Scenario, load_scenario

SHARED = Path(__file__).resolve().parents[2] / ".." / "shared"


def make_frame(
    t_s: float,
    ids: object,
    states: object,
    *,
    status: object = None,
    sigma_m: float = 50.0,
    start_ns: int = START_NS,
) -> TrackFrame:
    """A frame with tracks ``ids`` at ``states`` (n, 4)."""
    track_id = np.array(ids, np.int64)
    n, t_ns = len(track_id), start_ns + round(t_s * 1e9)
    covariance = np.zeros((n, 21), np.float32)
    covariance[:, [0, 6]] = sigma_m**2
    state = np.concatenate([np.array(states, np.float64).reshape(n, 4), np.zeros((n, 2))], axis=1)
    return TrackFrame(
        unit_id="main",
        boot_id="test",
        seq=0,
        t_ns=t_ns,
        track_id=track_id,
        epoch=np.ones(n, np.uint32),
        status=np.ones(n, np.uint8) if status is None else np.array(status, np.uint8),
        state=state,
        covariance=covariance,
        model_probability=np.ones((n, 1)),
        models=["cv"],
        sensors=["north"],
        members=np.full((n, 1), -1),
        updated_t_ns=np.full(n, t_ns),
        first_t_ns=np.full(n, start_ns),
    )


@pytest.fixture
def frame() -> Callable[..., TrackFrame]:
    return make_frame


@pytest.fixture
def two_radars() -> Scenario:
    return load_scenario("two-radars")


@pytest.fixture
def peers() -> Path:
    """The folder with the scoring that the peers were measured with."""
    folder = SHARED / "peers"
    if not (folder / "score.py").exists():
        pytest.skip("the peers' score.py is not here")
    return folder


@pytest.fixture
def autoferry_data() -> Path:
    """The folder with the Autoferry recordings."""
    folder = SHARED / "data" / "autoferry"
    if not folder.exists():
        pytest.skip("the Autoferry recordings are not here")
    return folder
