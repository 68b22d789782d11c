"""Every named filter in the engine."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    drive,
    engine,
    in_time_order,
    live,
    nearest,
    scans,
    sector_scans,
)

from trackmesh.protocol.messages import PlotBatch, TrackFrame
from trackmesh.services.estimation.bank import Models
from trackmesh.services.estimation.filters import FilterName
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.fusion.settings import EngineSettings

FILTERS = get_args(FilterName)
REPLAYING = [name for name in FILTERS if name != "alpha-beta"]
"""Filters that remember plots; alpha-beta refuses late ones."""


def batches(until_s: float = 40.0) -> list[PlotBatch]:
    return in_time_order(scans(NORTH, FAR_APART, until_s), scans(EAST, FAR_APART, until_s, offset_s=0.7, seed=2))


def assert_sound(frame: TrackFrame) -> None:
    assert np.isfinite(frame.state).all()
    P = frame.covariance_matrices()
    assert np.isfinite(P).all()
    assert np.array_equal(P, np.swapaxes(P, 1, 2))
    # Covariances travel in single precision.
    least, most = np.linalg.eigvalsh(P[:, :4, :4])[:, [0, -1]].T
    assert np.all(least > -1e-6 * most)
    np.testing.assert_allclose(frame.model_probability.sum(axis=1), 1.0, atol=1e-9)
    assert frame.model_probability.shape[1] == len(frame.models)


@pytest.mark.parametrize("kind", FILTERS)
def test_every_filter_tracks_four_targets(kind: str) -> None:
    frames = drive(engine(NORTH, EAST, filter=kind), batches())
    for frame in frames:
        assert_sound(frame)
    last = frames[-1]
    assert len(live(last)) == 4
    t_s = (last.t_ns - frames[0].t_ns) / 1e9
    assert max(nearest(last, place)[1] for place in FAR_APART.at(t_s)) < 200


@pytest.mark.parametrize("kind", REPLAYING)
def test_late_batches_replay_exactly(kind: str) -> None:
    in_time = batches()
    late = [*in_time[:10], *in_time[11:13], in_time[10], *in_time[13:]]
    # A plot is corrected by the biases that are known when it comes: with registration the order counts.
    one, other = (drive(engine(NORTH, EAST, filter=kind, registration=False), b)[-1] for b in (in_time, late))
    assert np.array_equal(one.track_id, other.track_id)
    assert np.array_equal(one.state, other.state)
    assert np.array_equal(one.covariance, other.covariance)
    assert np.array_equal(one.model_probability, other.model_probability)


@pytest.mark.parametrize("kind", FILTERS)
def test_every_filter_takes_sectors(kind: str) -> None:
    last = drive(engine(NORTH, filter=kind), sector_scans(NORTH, FAR_APART, 48.0, 16))[-1]
    assert_sound(last)
    assert len(live(last)) == 4


def models_of(settings: EngineSettings) -> Models:
    tracks = settings.system_tracks(1)
    assert isinstance(tracks, ImmTracks)
    return tracks.models


def test_the_default_is_the_one_with_two_branches() -> None:
    settings = EngineSettings()
    assert settings.filter == "tvimm"
    assert len(models_of(settings).split_s) == 2
    assert len(settings.model_names()) == len(set(settings.model_names())) == 8


@pytest.mark.parametrize("quiet_s", [20.0, 45.0, 60.0, 90.0, 300.0])
def test_words_of_the_user_reach_the_models(quiet_s: float) -> None:
    words = {"quiet_s": quiet_s, "turn_rate_max_degps": 10.0, "acceleration_max_mps2": 40.0, "q_quiet": 1.0}
    models = models_of(EngineSettings.model_validate(words))
    assert models.numbers[1, 1] == pytest.approx(0.55 * np.deg2rad(10.0))
    assert models.numbers[3, 2] == pytest.approx(24.0)
    assert models.numbers[0, 0] == pytest.approx(1.0)
    # Quiet flight is left at the rate of its sojourn time.
    assert models.rate[0] * (models.jump[0, 0, 0, 0] - 1.0) == pytest.approx(-1.0 / (1.2 * quiet_s))
