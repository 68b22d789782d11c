"""Radars that measure the range rate as well."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.services.fusion.makers import (
    FAR_APART,
    NORTH,
    PLANE,
    POLAR,
    Fleet,
    FloatArray,
    batch,
    drive,
    engine,
    fleet,
    live,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
)

from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.fusion.sensors import Sensor

WITH_RATE = [*POLAR, "range_rate_mps"]
SIGMA = NORTH.sigma | {"range_rate_mps": 1.0}
DOPPLER = radar("north", sigma=SIGMA)


def rated(info: SensorInfo, targets: Fleet, until_s: float, wrong_mps: float = 0.0) -> Iterator[PlotBatch]:
    """The scans of a radar, with range rates that are right to one metre a second, or shifted."""
    rng = np.random.default_rng(8)
    site = np.array((info.site_enu_m or [0.0, 0.0])[:2])
    for scan in scans(info, targets, until_s):
        t_s = (scan.t_ns - ns(0.0)) / 1e9
        off = targets.at(t_s) - site
        rate = (off * targets.velocity).sum(axis=1) / np.linalg.norm(off, axis=1) + rng.normal(0.0, 1.0, len(t_s))
        values = np.column_stack([scan.values, rate + wrong_mps])
        yield scan.model_copy(update={"columns": WITH_RATE, "values": values})


def velocity_errors(frames: list[TrackFrame], targets: Fleet) -> float:
    """RMS of all targets in all frames that show them, m/s."""
    off = []
    for frame in frames:
        if len(live(frame)) == len(targets.start):
            for k, place in enumerate(targets.at((frame.t_ns - ns(0.0)) / 1e9)):
                off.append(frame.state[nearest(frame, place)[0], 2:4] - targets.velocity[k])
    assert len(off) > 20
    return float(np.sqrt((np.array(off) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("kind", ["imm", "tvimm"])
def test_range_rates_make_velocities_better(kind: str) -> None:
    plain = drive(engine(NORTH, filter=kind), scans(NORTH, FAR_APART, 60.0))
    told = drive(engine(DOPPLER, filter=kind), rated(DOPPLER, FAR_APART, 60.0))
    assert velocity_errors(told, FAR_APART) < 0.65 * velocity_errors(plain, FAR_APART)
    assert len(live(told[-1])) == 4


@pytest.mark.parametrize("kind", ["imm", "tvimm"])
def test_a_target_that_comes_straight_on_is_known_by_its_range_rate(kind: str) -> None:
    coming = fleet((40e3, 30e3, -160.0, -120.0))
    plain = drive(engine(NORTH, filter=kind), scans(NORTH, coming, 60.0))
    told = drive(engine(DOPPLER, filter=kind), rated(DOPPLER, coming, 60.0))
    u = np.array([0.8, 0.6])
    speed = [abs(frame.state[0, 2:4] @ u + 200.0) for frame in (plain[-1], told[-1])]
    assert speed[1] < 2.0
    variance = [u @ frame.covariance_matrices()[0, 2:4, 2:4] @ u for frame in (plain[-1], told[-1])]
    assert variance[1] < 0.1 * variance[0]


def test_without_sigma_of_the_range_rate_it_is_ignored() -> None:
    plain = drive(engine(NORTH), scans(NORTH, FAR_APART, 40.0))
    told = drive(engine(NORTH), rated(NORTH, FAR_APART, 40.0, wrong_mps=300.0))
    for one, other in zip(plain, told, strict=True):
        assert one == other


# --- from the batch to the plots ---


def plots_of(info: SensorInfo, values: FloatArray, columns: list[str], **change: Any) -> Any:
    return Sensor(3, info, None).plots(batch(info.sensor_id, 0.0, values, columns, **change), np.zeros(len(values)))


def test_a_range_rate_comes_with_where_it_was_seen_from() -> None:
    info = radar("north", 1e3, -2e3, sigma=SIGMA)
    plots = plots_of(info, np.array([[1e4, 0.5, -70.0], [2e4, 1.0, 30.0]]), WITH_RATE)
    assert plots["range_rate_mps"].tolist() == [-70.0, 30.0]
    assert plots["range_rate_variance"].tolist() == [1.0, 1.0]
    assert plots["site"].tolist() == [[1e3, -2e3]] * 2
    assert plots["level"].tolist() == [1.0, 1.0]
    assert plots["sensor"].tolist() == [3, 3]


def test_the_elevation_levels_the_range_rate() -> None:
    columns = [*POLAR, "elevation_rad", "range_rate_mps"]
    plots = plots_of(DOPPLER, np.array([[1e4, 0.5, 0.3, -70.0]]), columns)
    assert plots["range_rate_mps"].tolist() == [-70.0]
    np.testing.assert_allclose(plots["level"], np.cos(0.3), rtol=1e-15)


def test_variances_of_the_batch_come_before_sigma() -> None:
    values, variances = np.array([[1e4, 0.5, -70.0]]), np.array([[2500.0, 1e-6, 49.0]])
    assert plots_of(DOPPLER, values, WITH_RATE, variances=variances)["range_rate_variance"].tolist() == [49.0]


@pytest.mark.parametrize(
    ("info", "columns", "values"),
    [
        (DOPPLER, POLAR, [1e4, 0.5]),
        (NORTH, WITH_RATE, [1e4, 0.5, -70.0]),
        (position_sensor(), PLANE, [1e4, 0.5]),
    ],
)
def test_what_is_not_known_has_infinite_variance(info: SensorInfo, columns: list[str], values: list[float]) -> None:
    plots = plots_of(info, np.array([values]), columns)
    assert np.isinf(plots["range_rate_variance"]).all()
