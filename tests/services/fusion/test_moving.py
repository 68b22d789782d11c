"""Sensors that move: where their plots belong, what they see, how they measure range rates, their biases."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.protocol.strategies import places as geodetic_places
from tests.protocol.strategies import plot_batches
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    ONE,
    POLAR,
    Fleet,
    FloatArray,
    batch,
    drive,
    engine,
    fleet,
    in_time_order,
    live,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
    seen,
)
from tests.services.fusion.test_engine_registration import BIAS, biased, grid
from tests.services.fusion.test_snapshot import again

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo, TrackFrame
from trackmesh.protocol.messages.plots import COLUMN_BOUNDS
from trackmesh.services.fusion.engine import FusionEngine
from trackmesh.services.fusion.sensors import Sensor

SHIP = radar("ship")
STEAMING, FLYING = (9.0, -5.0), (160.0, 120.0)
WITH_RATE = [*POLAR, "range_rate_mps"]
ORIGIN = Geodetic(latitude_deg=54.0, longitude_deg=7.0, height_m=40.0)
AT_SEA = Geodetic(latitude_deg=54.5, longitude_deg=8.1, height_m=12.0)


def on_the_way(
    info: SensorInfo,
    targets: Fleet,
    until_s: float,
    velocity: Sequence[float],
    *,
    start: tuple[float, float] = (0.0, 0.0),
    offset_s: float = 0.0,
    seed: int = 1,
    rates: bool = False,
) -> Iterator[PlotBatch]:
    """Looks from a sensor on its way, with where it was and how it moved."""
    rng = np.random.default_rng(seed)
    for seq, t in enumerate(np.arange(offset_s, until_s, info.period_s).tolist()):
        east, north = start + t * np.array(velocity)
        here = info.model_copy(update={"site_enu_m": [east, north, 0.0]})
        place = targets.at(t)
        where = {"site_enu_m": [east, north, 0.0], "site_velocity_enu_mps": [*velocity, 0.0]}
        one = seen(here, t, place, rng.standard_normal((len(place), 2)), seq=seq, **where)
        if rates:
            off = place - (east, north)
            relative = targets.velocity - np.array(velocity)
            rate = (off * relative).sum(axis=1) / np.linalg.norm(off, axis=1) + rng.standard_normal(len(place))
            one = one.model_copy(update={"columns": WITH_RATE, "values": np.column_stack([one.values, rate])})
        yield one


def rms_m(frames: list[TrackFrame], targets: Fleet) -> float:
    """Of all targets, in all frames of the later half."""
    errors = []
    for frame in frames[len(frames) // 2 :]:
        errors += [nearest(frame, place)[1] for place in targets.at((frame.t_ns - ns(0.0)) / 1e9)]
    return float(np.sqrt(np.mean(np.square(errors))))


# --- where its plots belong ---


def placed(info: SensorInfo, origin: Geodetic | None, columns: list[str], values: list[float], **change: Any) -> Any:
    return Sensor(0, info, origin).plots(batch(info.sensor_id, 0.0, np.array([values]), columns, **change), np.zeros(1))


def test_plots_are_placed_from_where_the_sensor_stood() -> None:
    [plot] = placed(SHIP, None, POLAR, [2000.0, np.pi / 2], site_enu_m=[7e3, -1e3, 20.0])
    np.testing.assert_allclose(plot.z, [9e3, -1e3], atol=1e-9)
    assert plot.site.tolist() == [7e3, -1e3]
    assert plot.site_velocity.tolist() == [0.0, 0.0]


def test_a_geodetic_place_shifts_and_turns() -> None:
    info = radar("ship", site_enu_m=None, site=ORIGIN)
    velocity = [10.0, 0.0, 0.0]
    [plot] = placed(info, ORIGIN, POLAR, [40e3, 1.0], site=AT_SEA, site_velocity_enu_mps=velocity)
    at_sea, origin = (list(p.model_dump(exclude={"schema_version"}).values()) for p in (AT_SEA, ORIGIN))
    want = pymap3d.ecef2enu(*pymap3d.aer2ecef(np.degrees(1.0), 0.0, 40e3, *at_sea), *origin)
    np.testing.assert_allclose(plot.z, want[:2], atol=1e-3)
    ahead = pymap3d.ecef2enu(*pymap3d.enu2ecef(10.0, 0.0, 0.0, *at_sea), *origin)
    np.testing.assert_allclose(plot.site_velocity, np.array(ahead[:2]) - plot.site, atol=1e-6)


def test_a_place_on_earth_needs_a_plane_on_earth() -> None:
    with pytest.raises(RefusedMessage) as error:
        placed(SHIP, None, POLAR, [2000.0, 0.0], site=AT_SEA)
    assert error.value.reason == "no_origin"
    assert error.value.detail.endswith(".")


def test_whoever_says_where_it_stands_needs_no_other_site() -> None:
    info = position_sensor("ship", sigma=NORTH.sigma)
    [plot] = placed(info, None, POLAR, [2000.0, 0.0], site_enu_m=[1e3, 0.0, 0.0])
    np.testing.assert_allclose(plot.z, [1e3, 2e3], atol=1e-9)


@settings(max_examples=300, deadline=None)
@given(told=plot_batches(), origin=geodetic_places, announced=geodetic_places, sigma=st.floats(1e-9, 3.0))
def test_whatever_a_message_may_say_is_a_finite_plot(
    told: PlotBatch, origin: Geodetic, announced: Geodetic, sigma: float
) -> None:
    """Anywhere on, in and above the Earth; at a finite height if that is measured."""
    info = radar("any", site_enu_m=None, site=announced, sigma=dict.fromkeys(COLUMN_BOUNDS, sigma))
    plots = Sensor(0, info, origin, noise_model="uncertain").plots(told, np.zeros(len(told.t_ns)))
    for name in ("z", "R", "site", "site_velocity", "height_m", "range_rate_mps"):
        assert np.isfinite(plots[name]).all(), name
    assert (plots["height_variance_m2"] > 0.0).all()


# --- tracking ---


@pytest.mark.parametrize("velocity", [STEAMING, FLYING], ids=["ship", "aircraft"])
def test_a_moving_radar_tracks_as_well_as_a_fixed_one(velocity: tuple[float, float]) -> None:
    fixed = drive(engine(NORTH), scans(NORTH, FAR_APART, 120.0))
    moving = drive(engine(SHIP), on_the_way(SHIP, FAR_APART, 120.0, velocity))
    assert rms_m(moving, FAR_APART) < 1.25 * rms_m(fixed, FAR_APART)
    assert len(live(moving[-1])) == 4
    assert live(moving[-1]) == live(moving[10])


def test_late_batches_are_placed_from_where_they_were_taken() -> None:
    batches = list(on_the_way(SHIP, FAR_APART, 60.0, FLYING))
    in_order = drive(engine(SHIP), batches)[-1]
    batches[-3], batches[-2] = batches[-2], batches[-3]
    late = drive(engine(SHIP), batches)[-1]
    np.testing.assert_allclose(late.state, in_order.state, atol=1e-6)


def test_a_sensor_is_where_its_newest_plots_say() -> None:
    tracker = engine(SHIP, EAST)
    batches = list(on_the_way(SHIP, FAR_APART, 20.0, FLYING))
    drive(tracker, [*batches[:3], batches[4], batches[3]])
    assert tracker.corrections.biases is not None
    want = 16.0 * np.array(FLYING)
    np.testing.assert_allclose(tracker.sensors["ship"].site, want)
    np.testing.assert_allclose(tracker.corrections.biases.geometry("ship").site_m, want)
    tracker.sensor(SHIP.model_copy(update={"p_detect": 0.8}))
    np.testing.assert_allclose(tracker.sensors["ship"].site, want)
    tracker.sensor(radar("ship", 5e3, 6e3))
    np.testing.assert_allclose(tracker.sensors["ship"].site, [5e3, 6e3])


def test_where_it_stood_is_known_after_a_restart() -> None:
    tracker = engine(SHIP)
    drive(tracker, on_the_way(SHIP, FAR_APART, 20.0, FLYING))
    restored = again(tracker)
    assert restored.sensors["ship"].site.tolist() == tracker.sensors["ship"].site.tolist()
    assert restored.corrections.biases is not None
    assert restored.corrections.biases.geometry("ship").site_m.tolist() == restored.sensors["ship"].site.tolist()
    assert not restored.sensors["ship"].stood(np.zeros(2), 3.0), "plots of earlier are late"


def test_a_range_rate_is_relative_to_the_sensor() -> None:
    info = radar("ship", sigma=SHIP.sigma | {"range_rate_mps": 1.0})

    def velocity_error(told: bool) -> float:
        batches = list(on_the_way(info, FAR_APART, 80.0, FLYING, rates=True))
        if not told:
            batches = [b.model_copy(update={"site_velocity_enu_mps": None}) for b in batches]
        frame = drive(engine(info), batches)[-1]
        places = FAR_APART.at((frame.t_ns - ns(0.0)) / 1e9)
        rows = [nearest(frame, place)[0] for place in places]
        return float(np.linalg.norm(frame.state[rows, 2:4] - FAR_APART.velocity, axis=1).mean())

    assert velocity_error(told=True) < 5.0
    assert velocity_error(told=False) > 20.0


def test_what_its_own_climb_does_to_range_rates_is_taken_off() -> None:
    columns = [*POLAR, "elevation_rad", "range_rate_mps"]
    info = radar("ship", sigma=SHIP.sigma | {"range_rate_mps": 1.0})
    change = {"site_enu_m": [0.0, 0.0, 3e3], "site_velocity_enu_mps": [0.0, 0.0, 20.0]}
    [plot] = placed(info, None, columns, [1e4, 0.0, -0.5, 7.0], **change)
    assert plot.range_rate_mps == pytest.approx(7.0 + 20.0 * np.sin(-0.5))


# --- what it sees ---


@pytest.mark.parametrize(("there", "misses"), [((0.0, 0.0), True), ((-80e3, 0.0), False)])
def test_a_sensor_misses_only_what_it_can_see_from_where_it_is(there: tuple[float, float], misses: bool) -> None:
    """It sees another target, but not the one that a position sensor tells: a miss if that is near to where it is."""
    home = radar("plane", *((-80e3, 0.0) if misses else (0.0, 0.0)), max_range_m=40e3, period_s=2.0)
    stays = fleet((20e3, 0.0, 0.0, 0.0))
    looks = [
        batch("plane", t, np.array([[8e3, 0.0]]), POLAR, seq=k, site_enu_m=[*there, 0.0])
        for k, t in enumerate(np.arange(0.5, 40.0, 2.0).tolist())
    ]
    tracker = engine(home, position_sensor(), registration=False)
    drive(tracker, in_time_order(scans(position_sensor(), stays, 40.0), looks))
    row, distance_m = nearest_row(tracker, stays.start[0])
    assert distance_m < 100.0
    assert bool(tracker._system.life.misses[row] > 0) is misses


def nearest_row(tracker: FusionEngine, place: FloatArray) -> tuple[int, float]:
    rows = tracker._system.rows
    off = np.linalg.norm(tracker._system.filters.mean[rows, :2] - place, axis=1)
    return int(rows[off.argmin()]), float(off.min())


# --- what is wrong with it ---


@pytest.mark.parametrize("velocity", [STEAMING, FLYING], ids=["ship", "aircraft"])
def test_the_bias_of_a_moving_radar_is_learnt_and_stays_valid(velocity: tuple[float, float]) -> None:
    """Corrected from where each plot was taken, also when the correction changes and what tracks hold moves along."""
    tracker, plain = engine(NORTH, SHIP), engine(NORTH, SHIP)
    targets = grid()
    batches = list(on_the_way(SHIP, targets, 120.0, velocity, start=(40e3, 10e3), offset_s=0.7, seed=2))
    north = list(scans(NORTH, targets, 120.0))
    frames = drive(tracker, in_time_order(north, biased(batches)))
    right = drive(plain, in_time_order(north, batches))
    told = tracker.registration()
    assert told is not None
    of_north, of_ship = told.sensors
    difference = of_ship.bias - of_north.bias
    assert of_ship.locked
    assert abs(difference[0] - BIAS[0]) < 40.0
    assert abs(np.rad2deg(difference[1] - BIAS[1])) < 0.08
    assert rms_m(frames, targets) < 1.25 * rms_m(right, targets)


def test_what_tracks_remember_is_moved_as_seen_from_where_it_was_taken() -> None:
    """After a correction changes, what tracks hold is as if it had been corrected so from the beginning."""
    targets, plane = grid(3), radar("plane")
    batches = biased(list(on_the_way(plane, targets, 60.0, FLYING, start=(40e3, 10e3), offset_s=0.7, seed=2)))
    raw = {(b.t_ns[0] - ns(0.0)) / 1e9: Sensor(0, plane, None).plane(b)[0] for b in batches}
    tracker = engine(NORTH, plane, restart_shift_m=1e9)
    drive(tracker, in_time_order(scans(NORTH, targets, 60.0), batches))
    filters: Any = tracker._system.filters
    biases, index = tracker.corrections.biases, tracker.sensors["plane"].index
    assert biases is not None and biases.locked("plane")
    held = [p for row in tracker._system.rows.tolist() for p in filters.remembered(row) if p.sensor == index]
    assert len(held) > 40
    for plot in held:
        shifted = raw[plot.t_s] - biases.shift("plane", raw[plot.t_s], site_m=np.tile(plot.site, (9, 1)))
        assert np.linalg.norm(shifted - plot.z, axis=1).min() < 1e-6


def test_late_plots_are_corrected_as_seen_from_where_they_were_taken() -> None:
    targets, plane = grid(), radar("plane")
    batches = biased(list(on_the_way(plane, targets, 60.0, FLYING, start=(40e3, 10e3), offset_s=0.7, seed=2)))
    tracker = engine(NORTH, plane)
    drive(tracker, in_time_order(scans(NORTH, targets, 60.0), batches))
    index, biases = tracker.sensors["plane"].index, tracker.corrections.biases
    assert biases is not None and biases.locked("plane")
    raw = tracker.sensors["plane"].plots(batches[0], np.zeros(25))
    site = np.tile([40e3 + 0.7 * FLYING[0], 10e3 + 0.7 * FLYING[1]], (25, 1))
    want = raw["z"] - biases.shift("plane", raw["z"], site_m=site)
    np.testing.assert_allclose(tracker.corrections.correct_of(index, raw)["z"], want, atol=1e-9)
    np.testing.assert_allclose(tracker.corrections.correct(raw)["z"], want, atol=1e-9)


def test_one_target_on_a_straight_line_past_a_ship() -> None:
    """The plain case of the handbook: both on steady courses, and the track is of the target's own motion."""
    frame = drive(engine(SHIP), on_the_way(SHIP, ONE, 80.0, STEAMING))[-1]
    np.testing.assert_allclose(frame.state[0, 2:4], ONE.velocity[0], atol=8.0)
