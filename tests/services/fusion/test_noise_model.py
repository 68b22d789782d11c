"""Interference: what sensors declare of it, and whether a filter that knows of it knows how wrong it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.services.fusion.makers import (
    GEODETIC,
    NORTH,
    PLANE,
    POLAR,
    FloatArray,
    batch,
    drive,
    engine,
    nearest,
    position_sensor,
    radar,
)

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.estimation.bank import Branch
from trackmesh.services.estimation.filters import velocity_models, with_more_noise
from trackmesh.services.estimation.motion import RANDOM_WALK, Model
from trackmesh.services.estimation.uncertain import sample
from trackmesh.services.fusion.accuracy import Accuracy
from trackmesh.services.fusion.settings import EngineSettings

WITH_RATE = [*POLAR, "range_rate_mps"]
INTERFERENCE = {"range_m": 80.0, "azimuth_rad": 2.5e-3}
DISTURBED = radar("north", interference=INTERFERENCE)
QUIET_Q = 1.0


# --- variances ---


def variances(info: SensorInfo, columns: list[str], model: Any = "uncertain", **change: Any) -> list[float]:
    plots = batch(info.sensor_id, 0.0, np.full((1, len(columns)), 0.5), columns, **change)
    [row] = Accuracy(info, model).variances(plots)
    return [float(value) for value in row]


def test_interference_is_one_more_error() -> None:
    assert variances(DISTURBED, POLAR) == pytest.approx([50.0**2 + 80.0**2, 1.5e-3**2 + 2.5e-3**2])
    assert variances(DISTURBED, POLAR, "gaussian") == pytest.approx([50.0**2, 1.5e-3**2])


def test_each_column_has_its_own() -> None:
    rated = radar(sigma=NORTH.sigma | {"range_rate_mps": 1.0}, interference={"range_rate_mps": 3.0})
    assert variances(rated, WITH_RATE) == pytest.approx([2500.0, 2.25e-6, 10.0])
    places = position_sensor(interference={"north_m": 40.0})
    assert variances(places, PLANE) == pytest.approx([900.0, 2500.0])


def test_geodetic_variances_go_east_north_up() -> None:
    sigma = {"latitude_deg": 3.0, "longitude_deg": 5.0, "height_m": 7.0}
    info = position_sensor(sigma=sigma, interference={"latitude_deg": 4.0, "longitude_deg": 12.0, "height_m": 24.0})
    assert variances(info, [*GEODETIC, "height_m"]) == pytest.approx([169.0, 25.0, 625.0])
    told = np.array([[1.0, 2.0, 3.0]])
    assert variances(info, [*GEODETIC, "height_m"], variances=told) == pytest.approx([145.0, 18.0, 579.0])


def test_what_is_not_known_stays_unknown() -> None:
    assert np.isinf(variances(DISTURBED, WITH_RATE)[2])
    with pytest.raises(RefusedMessage, match="azimuth_rad"):
        variances(radar(sigma={"range_m": 1.0}, interference=INTERFERENCE), POLAR)


def test_no_angle_is_worse_than_half_a_turn() -> None:
    wild = radar(interference={"azimuth_rad": 1e9, "range_m": 1e9})
    assert variances(wild, POLAR) == pytest.approx([1e18, np.pi**2])
    tracker = engine(wild, noise_model="uncertain")
    [frame] = drive(tracker, [batch("north", 0.0, np.array([[1e4, 0.5]]), POLAR)])
    assert len(frame.track_id) == 0


@given(noise=st.floats(1e-9, 1e9), interference=st.floats(0.0, 1e9), told=st.booleans())
def test_variances_add_up(noise: float, interference: float, told: bool) -> None:
    info = position_sensor(sigma={"east_m": noise, "north_m": noise}, interference={"east_m": interference})
    change = {"variances": np.full((1, 2), noise**2)} if told else {}
    east, north = variances(info, PLANE, **change)
    assert east == pytest.approx(noise**2 + interference**2)
    assert north == pytest.approx(noise**2)


# --- settings ---


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"process_interference": 1.0}, "needs the noise model"),
        ({"process_interference": 1.0, "noise_model": "uncertain", "filter": "alpha-beta"}, "alpha-beta"),
        ({"process_interference": 1.0, "noise_model": "uncertain", "local_filter": "alpha-beta"}, "alpha-beta"),
        ({"process_interference": -1.0, "noise_model": "uncertain"}, "greater than or equal to 0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        EngineSettings(**settings)


def test_process_interference_reaches_every_model() -> None:
    for name in ("tvimm", "imm"):
        plain = EngineSettings(filter=name)
        rough = EngineSettings(filter=name, noise_model="uncertain", process_interference=7.0)
        q = [s.system_tracks(1).models.numbers[:, 0] for s in (plain, rough)]  # type: ignore[attr-defined]
        assert q[1] == pytest.approx(q[0] + 7.0)
        assert plain.model_names() == rough.model_names()


def test_noise_of_another_kind_cannot_be_added() -> None:
    with pytest.raises(ValueError, match="random walk"):
        with_more_noise(Branch((Model("walk", RANDOM_WALK, 1.0),), (1.0,)), 1.0)
    assert with_more_noise(velocity_models([2.0], [9.0]), 0.0) == velocity_models([2.0], [9.0])


# --- whether the filter knows how wrong it is ---


def wandering(rng: np.random.Generator, n: int, q: float, steps: int, dt_s: float) -> FloatArray:
    """Targets far apart whose velocity wanders with density q, exactly: states (steps, n, 4)."""
    Q = q * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    L = np.linalg.cholesky(Q)
    bearing = 2.0 * np.pi * np.arange(n) / n
    course = rng.uniform(0.0, 2.0 * np.pi, n)
    x = np.empty((steps, n, 4))
    x[0, :, :2] = 45e3 * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    x[0, :, 2:] = 100.0 * np.stack([np.sin(course), np.cos(course)], axis=1)
    for k in range(1, steps):
        push = rng.standard_normal((n, 2, 2)) @ L.T
        x[k, :, :2] = x[k - 1, :, :2] + dt_s * x[k - 1, :, 2:] + push[:, :, 0]
        x[k, :, 2:] = x[k - 1, :, 2:] + push[:, :, 1]
    return x


def disturbed_scans(rng: np.random.Generator, truth: FloatArray, info: SensorInfo) -> list[PlotBatch]:
    """Scans with Gaussian noise of sigma, and interference by Liu's distribution."""
    out = []
    for seq, x in enumerate(truth):
        polar = np.stack([np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 0], x[:, 1])], axis=1)
        for k, name in enumerate(POLAR):
            polar[:, k] += rng.normal(0.0, info.sigma[name], len(x))
            polar[:, k] += sample(rng, (len(x),), (info.interference or {}).get(name, 0.0))
        polar[:, 1] %= 2.0 * np.pi
        out.append(batch(info.sensor_id, seq * info.period_s, polar, POLAR, seq=seq))
    return out


def nees(frames: list[TrackFrame], truth: FloatArray) -> float:
    """Mean squared error in units of the covariance told, over the length of the state: 1 where it is right."""
    found = []
    for frame, x in list(zip(frames, truth, strict=True))[10:]:
        P = frame.covariance_matrices()[:, :4, :4]
        for one in x:
            k, distance_m = nearest(frame, one[:2])
            if distance_m < 2e3:
                e = frame.state[k, :4] - one
                found.append(e @ np.linalg.solve(P[k], e) / 4.0)
    assert len(found) > 0.8 * (len(truth) - 10) * truth.shape[1]
    return float(np.mean(found))


def measured_nees(q: float, info: SensorInfo, **settings: Any) -> float:
    rng = np.random.default_rng(5)
    truth = wandering(rng, 12, q, 40, info.period_s)
    batches = disturbed_scans(rng, truth, info)
    tracker = engine(info, filter="imm", q_m2ps3=[QUIET_Q], sojourn_s=[50.0], gate=25.0, **settings)
    return nees(drive(tracker, batches), truth)


def test_a_filter_that_knows_of_interference_is_consistent() -> None:
    assert measured_nees(QUIET_Q, DISTURBED, noise_model="uncertain") == pytest.approx(1.0, abs=0.15)
    assert measured_nees(QUIET_Q, DISTURBED) > 1.8


def test_so_is_one_that_knows_of_interference_with_the_motion() -> None:
    pushed = QUIET_Q + 30.0
    assert measured_nees(pushed, NORTH, noise_model="uncertain", process_interference=30.0) == pytest.approx(
        1.0, abs=0.15
    )
    assert measured_nees(pushed, NORTH, noise_model="uncertain") > 1.8


def test_without_interference_both_models_are_one() -> None:
    truth = wandering(np.random.default_rng(6), 4, QUIET_Q, 10, 4.0)
    plain, told = ([*disturbed_scans(np.random.default_rng(7), truth, NORTH)] for _ in range(2))
    assert drive(engine(NORTH), plain) == drive(engine(NORTH, noise_model="uncertain"), told)
