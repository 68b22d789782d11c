"""Heights in the engine: what plots tell of them, how well the filter knows them, how frames tell them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymap3d
import pytest
from tests.services.fusion.makers import (
    ENDED,
    FAR_APART,
    GEODETIC,
    NORTH,
    PLANE,
    POLAR,
    Fleet,
    FloatArray,
    batch,
    drive,
    engine,
    fleet,
    in_time_order,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
)
from tests.services.fusion.test_snapshot import again

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import UNKNOWN_HEIGHT_M2, Geodetic, PlotBatch, SensorInfo, TrackFrame, TrackQuery
from trackmesh.services.fusion import frames as frame_tools
from trackmesh.services.fusion import places
from trackmesh.services.fusion.sensors import Sensor

ELEVATED = [*POLAR, "elevation_rad"]
TALL = radar("tall", sigma=NORTH.sigma | {"elevation_rad": 3e-3})
ORIGIN = Geodetic(latitude_deg=50.0, longitude_deg=8.0, height_m=100.0)
AWAY = Geodetic(latitude_deg=50.6, longitude_deg=9.1, height_m=300.0)
ORIGIN_DEG, AWAY_DEG = (50.0, 8.0, 100.0), (50.6, 9.1, 300.0)


def plots_of(info: SensorInfo, origin: Geodetic | None, columns: list[str], values: FloatArray, **change: Any) -> Any:
    told = batch(info.sensor_id, 0.0, values, columns, **change)
    return Sensor(0, info, origin).plots(told, np.zeros(len(told.t_ns)))


# --- what plots tell ---


RANGES, AZIMUTHS, ELEVATIONS = np.array([5e3, 40e3, 110e3]), np.array([0.3, 2.0, 5.5]), np.array([0.5, 0.1, 0.02])


def test_heights_are_above_the_ellipsoid() -> None:
    info = radar("tall", site_enu_m=None, site=AWAY, sigma=TALL.sigma)
    plots = plots_of(info, ORIGIN, ELEVATED, np.stack([RANGES, AZIMUTHS, ELEVATIONS], axis=1))
    _, _, want = pymap3d.aer2geodetic(np.degrees(AZIMUTHS), np.degrees(ELEVATIONS), RANGES, *AWAY_DEG)
    np.testing.assert_allclose(plots["height_m"], want, atol=0.01)
    level = plots_of(info, ORIGIN, ELEVATED, np.array([[100e3, 1.0, 0.0]]))
    assert level["height_m"][0] == pytest.approx(300.0 + 100e3**2 / (2 * 6.38e6), abs=3.0)


def test_without_an_origin_they_are_above_the_plane() -> None:
    info = radar("tall", site_enu_m=[1e3, 0.0, 50.0], sigma=TALL.sigma)
    plots = plots_of(info, None, ELEVATED, np.array([[20e3, 1.0, 0.1]]))
    assert plots["height_m"][0] == pytest.approx(50.0 + 20e3 * np.sin(0.1))


def test_a_sensor_in_the_plane_of_an_origin_tells_heights_above_the_ellipsoid_too() -> None:
    info = radar("tall", site_enu_m=[30e3, 40e3, 50.0], sigma=TALL.sigma)
    [plot] = plots_of(info, ORIGIN, ELEVATED, np.array([[20e3, 1.0, 0.1]]))
    _, _, want = pymap3d.enu2geodetic(*plot.z, 50.0 + 20e3 * np.sin(0.1), *ORIGIN_DEG)
    assert plot.height_m == pytest.approx(float(want), abs=0.01)


def test_a_ship_tells_them_from_where_it_is() -> None:
    info = radar("tall", site_enu_m=None, site=ORIGIN, sigma=TALL.sigma)
    values = np.array([[20e3, 1.0, 0.1]])
    [ship], [fixed] = (
        plots_of(i, ORIGIN, ELEVATED, values, **c)
        for i, c in ((info, {"site": AWAY}), (info.model_copy(update={"site": AWAY}), {}))
    )
    assert ship.height_m == pytest.approx(fixed.height_m)


def test_columns_of_height() -> None:
    up = position_sensor(sigma={"east_m": 1.0, "north_m": 1.0, "up_m": 6.0})
    [flat] = plots_of(up, None, [*PLANE, "up_m"], np.array([[50e3, 0.0, 700.0]]))
    assert (flat.height_m, flat.height_variance_m2) == (700.0, 36.0)
    [curved] = plots_of(up, ORIGIN, [*PLANE, "up_m"], np.array([[50e3, 0.0, 700.0]]))
    assert curved.height_m == pytest.approx(float(pymap3d.enu2geodetic(50e3, 0.0, 700.0, *ORIGIN_DEG)[2]), abs=0.01)
    high = position_sensor(sigma={"latitude_deg": 1.0, "longitude_deg": 1.0, "height_m": 4.0})
    [geodetic] = plots_of(high, ORIGIN, [*GEODETIC, "height_m"], np.array([[50.5, 7.5, 9e3]]))
    assert (geodetic.height_m, geodetic.height_variance_m2) == (9e3, 16.0)
    [by_batch] = plots_of(
        high, ORIGIN, [*GEODETIC, "height_m"], np.array([[50.5, 7.5, 9e3]]), variances=np.array([[1.0, 2.0, 81.0]])
    )
    assert by_batch.height_variance_m2 == 81.0


@pytest.mark.parametrize(
    ("info", "columns"),
    [
        (NORTH, ELEVATED),
        (NORTH, POLAR),
        (radar(sigma=NORTH.sigma | {"range_rate_mps": 1.0}), [*POLAR, "range_rate_mps"]),
        (position_sensor("north"), [*PLANE, "up_m"]),
        (position_sensor("north"), PLANE),
    ],
)
def test_a_height_of_unknown_variance_is_none(info: SensorInfo, columns: list[str]) -> None:
    plots = plots_of(info, None, columns, np.full((2, len(columns)), 0.5))
    assert np.isinf(plots["height_variance_m2"]).all()


def test_interference_counts_for_heights_too() -> None:
    info = TALL.model_copy(update={"interference": {"elevation_rad": 4e-3}})
    values = np.array([[50e3, 1.0, 0.1]])
    told = batch("tall", 0.0, values, ELEVATED)
    quiet, loud = (
        Sensor(0, info, None, noise_model=model).plots(told, np.zeros(1))["height_variance_m2"][0]
        for model in ("gaussian", "uncertain")
    )
    assert loud == pytest.approx(quiet * 25.0 / 9.0, rel=0.01)


@pytest.mark.parametrize(
    ("elevation", "sigma_rad"), [(0.0, 3e-3), (0.05, 3e-3), (0.6, 3e-3), (1.4, 3e-3), (0.0, 1e-6), (0.02, 1e-5)]
)
def test_variances_of_heights_and_places_are_those_of_the_errors(elevation: float, sigma_rad: float) -> None:
    """By drawing errors of range and elevation; a small one of elevation shows what the range does on a round Earth."""
    rng, n = np.random.default_rng(1), 40_000
    r, el = 60e3 + rng.normal(0.0, 300.0, n), elevation + rng.normal(0.0, sigma_rad, n)
    _, _, height = pymap3d.aer2geodetic(40.0, np.degrees(el), r, *AWAY_DEG)
    sigma = {"range_m": 300.0, "azimuth_rad": 1e-9, "elevation_rad": sigma_rad}
    info = radar("tall", site_enu_m=None, site=AWAY, sigma=sigma)
    [plot] = plots_of(info, AWAY, ELEVATED, np.array([[60e3, np.radians(40.0), elevation]]))
    assert plot.height_variance_m2 == pytest.approx(np.var(height), rel=0.04)
    assert plot.R[0] + plot.R[2] == pytest.approx(np.var(r * np.cos(el)), rel=0.04)


def test_a_height_is_never_known_exactly() -> None:
    [plot] = plots_of(TALL, None, ELEVATED, np.array([[0.0, 1.0, 0.0]]))
    assert plot.height_variance_m2 > 0.0


# --- how well the filter knows them ---


def climbing(rng: np.random.Generator, steps: int, n: int, q: float, dt_s: float) -> FloatArray:
    """Heights (steps, n) of targets whose climb wanders with density q, exactly."""
    L = np.linalg.cholesky(q * np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]]))
    x = np.empty((steps, n, 2))
    x[0] = np.stack([rng.uniform(2e3, 9e3, n), rng.normal(0.0, 20.0, n)], axis=1)
    for k in range(1, steps):
        push = rng.standard_normal((n, 2)) @ L.T
        x[k, :, 0] = x[k - 1, :, 0] + dt_s * x[k - 1, :, 1] + push[:, 0]
        x[k, :, 1] = x[k - 1, :, 1] + push[:, 1]
    return x[:, :, 0]


def elevated_scans(info: SensorInfo, targets: Fleet, heights: FloatArray, seed: int = 1) -> list[PlotBatch]:
    """Looks of a radar that measures elevations: over the plane, or from its site over the Earth."""
    rng = np.random.default_rng(seed)
    sigma = [info.sigma[name] for name in ELEVATED]
    out = []
    for seq, height in enumerate(heights):
        east, north = targets.at(seq * info.period_s).T
        if info.site is None:
            ground = np.hypot(east, north)
            seen = np.stack([np.hypot(ground, height), np.arctan2(east, north), np.arctan2(height, ground)], axis=1)
        else:
            at = list(info.site.model_dump(exclude={"schema_version"}).values())
            latitude, longitude, _ = pymap3d.enu2geodetic(east, north, height, *at)
            azimuth, elevation, range_m = pymap3d.geodetic2aer(latitude, longitude, height, *at)
            seen = np.stack([range_m, np.radians(azimuth), np.radians(elevation)], axis=1)
        seen += rng.normal(0.0, sigma, seen.shape)
        seen[:, 1] %= 2.0 * np.pi
        out.append(batch(info.sensor_id, seq * info.period_s, seen, ELEVATED, seq=seq))
    return out


def circle(n: int) -> Fleet:
    bearing = 2.0 * np.pi * np.arange(n) / n
    place = np.linspace(20e3, 70e3, n)[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    return Fleet(place, 120.0 * np.stack([np.cos(2.6 * bearing), np.sin(2.6 * bearing)], axis=1))


@pytest.mark.parametrize("site", [None, ORIGIN], ids=["plane", "earth"])
def test_errors_of_heights_are_as_large_as_told(site: Geodetic | None) -> None:
    info = TALL if site is None else TALL.model_copy(update={"site_enu_m": None, "site": site})
    targets, steps = circle(12), 40
    heights = climbing(np.random.default_rng(4), steps, 12, 1.0, info.period_s)
    frames = drive(engine(info), elevated_scans(info, targets, heights))
    ratio, gain = [], []
    for frame, truth in list(zip(frames, heights, strict=True))[8:]:
        assert frame.height_m is not None and frame.height_variance_m2 is not None
        for place, height in zip(targets.at((frame.t_ns - ns(0.0)) / 1e9), truth, strict=True):
            k, _ = nearest(frame, place)
            ratio.append((frame.height_m[k] - height) ** 2 / frame.height_variance_m2[k])
            gain.append(frame.height_variance_m2[k] / (np.hypot(*place) * 3e-3) ** 2)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.2)
    assert np.mean(gain) < 0.6, "the filter is better than a single plot"


# --- how frames tell them ---


TWO = fleet((30e3, 20e3, 100, 40), (-20e3, 45e3, -60, 120))


def told(frame: TrackFrame, target: int) -> tuple[float, float]:
    k, _ = nearest(frame, TWO.at((frame.t_ns - ns(0.0)) / 1e9)[target])
    assert frame.height_m is not None and frame.height_variance_m2 is not None
    return float(frame.height_m[k]), float(frame.height_variance_m2[k])


GLIMPSE = TALL.model_copy(update={"p_detect": 0.2})


def half_seen(until_s: float = 40.0) -> list[PlotBatch]:
    """Of two targets one radar sees both flat, the other one of them with its height, 5 km."""
    first = Fleet(TWO.start[:1], TWO.velocity[:1])
    steps = int(until_s / 4.0)
    high = elevated_scans(TALL, first, np.full((steps, 1), 5e3))
    return in_time_order(scans(NORTH, TWO, until_s, offset_s=1.0), high)


def test_without_heights_the_fields_are_not_there() -> None:
    frame = drive(engine(NORTH), scans(NORTH, TWO, 20.0))[-1]
    assert (frame.height_m, frame.height_variance_m2) == (None, None)
    assert not frame.height_known().any()


def test_tracks_without_height_are_told_to_be_unknown() -> None:
    tracker = engine(NORTH, GLIMPSE)
    frame = drive(tracker, half_seen())[-1]
    height, variance = told(frame, 0)
    assert height == pytest.approx(5e3, abs=150.0) and variance < 200.0**2
    assert told(frame, 1) == (0.0, UNKNOWN_HEIGHT_M2)
    assert sorted(frame.height_known().tolist()) == [False, True]
    assert decode(encode(frame), TrackFrame) == frame


def test_a_query_predicts_heights_and_selects_them() -> None:
    tracker = engine(NORTH, GLIMPSE)
    last = drive(tracker, half_seen())[-1]
    now, variance = told(last, 0)
    later = tracker.query(TrackQuery(at_t_ns=last.t_ns + 20 * 10**9))
    assert told(later, 0)[1] > 2.0 * variance
    k, _ = nearest(last, TWO.at((last.t_ns - ns(0.0)) / 1e9)[0])
    one = tracker.query(TrackQuery(track_ids=[int(last.track_id[k])]))
    assert one.height_m is not None and one.height_m.tolist() == [now]
    assert decode(encode(one), TrackFrame) == one
    never = tracker.query(TrackQuery(at_t_ns=last.t_ns + 10**9 * 10**9))
    assert not never.height_known().any()
    assert decode(encode(never), TrackFrame) == never


def test_last_words_and_frames_with_heights_fit_together() -> None:
    """A track without height ends while others have one, and one with height after all others are gone."""
    for gone in (0, 1):
        tracker = engine(NORTH, GLIMPSE, coast_s=6.0, stitch_s=0.0)
        drive(tracker, half_seen())
        stays = Fleet(TWO.start[1 - gone : 2 - gone], TWO.velocity[1 - gone : 2 - gone])
        rest = drive(tracker, list(scans(NORTH, stays, 80.0, offset_s=41.0)))
        [ended] = [frame for frame in rest if (frame.status == ENDED).any()]
        [k] = np.flatnonzero(ended.status == ENDED).tolist()
        assert ended.height_known()[k] == (gone == 0)


def test_frames_with_and_without_heights_are_joined() -> None:
    tracker = engine(NORTH, GLIMPSE)
    high = drive(tracker, half_seen())[-1]
    flat = drive(engine(NORTH), scans(NORTH, TWO, 20.0))[-1].model_copy(update={"sensors": high.sensors})
    flat = flat.model_copy(update={"members": np.full((2, 2), -1)})
    for parts in ((high, flat), (flat, high)):
        both = frame_tools.join(parts[0], [parts[1]])
        assert len(both.height_known()) == 4 and both.height_known().sum() == 1
    assert frame_tools.join(flat, [flat]).height_m is None


def test_late_heights_are_filtered_at_their_place() -> None:
    heights = climbing(np.random.default_rng(2), 12, 4, 1.0, 4.0)
    batches = elevated_scans(TALL, FAR_APART, heights)
    in_order = drive(engine(TALL), batches)[-1]
    batches[-3], batches[-2] = batches[-2], batches[-3]
    late = drive(engine(TALL), batches)[-1]
    assert in_order.height_m is not None and late.height_m is not None
    np.testing.assert_allclose(late.height_m, in_order.height_m, rtol=1e-9)
    np.testing.assert_allclose(late.height_variance_m2, in_order.height_variance_m2, rtol=1e-9)  # type: ignore[arg-type]


def test_heights_do_not_change_the_plane() -> None:
    """The same plots with and without the variance of their elevation, but for what that says of the ground range."""
    heights = np.full((12, 4), 3e3)
    batches = elevated_scans(TALL, FAR_APART, heights)
    flat = radar("tall", sigma=NORTH.sigma)
    one, other = drive(engine(TALL), batches)[-1], drive(engine(flat), batches)[-1]
    np.testing.assert_allclose(one.state[:, :2], other.state[:, :2], atol=20.0)
    assert one.height_known().all() and not other.height_known().any()


def test_merged_tracks_keep_a_height() -> None:
    tracker = engine(TALL)
    drive(tracker, elevated_scans(TALL, TWO, np.full((10, 2), 5e3)))
    system = tracker._system
    young, old = system.rows[system.life.confirmed[system.rows]].tolist()
    assert system.heights is not None
    before = system.heights.rows.head[old].copy()
    system.join(young, old)
    after = system.heights.rows.head[old]
    assert after[1] == pytest.approx(5e3, abs=150.0)
    assert after[3] < before[3]


def test_a_picture_made_anew_has_heights() -> None:
    tracker = engine(TALL, NORTH)
    drive(tracker, elevated_scans(TALL, TWO, np.full((10, 2), 5e3)))
    tracker._restart()
    again = tracker.query(TrackQuery())
    assert again.height_known().all() and again.height_m is not None
    np.testing.assert_allclose(again.height_m, 5e3, atol=150.0)


def test_heights_go_on_after_a_restart() -> None:
    heights = climbing(np.random.default_rng(2), 14, 4, 1.0, 4.0)
    batches = elevated_scans(TALL, FAR_APART, heights)
    tracker = engine(TALL)
    drive(tracker, batches[:10])
    restored = again(tracker)
    batches[10], batches[11] = batches[11], batches[10]
    want, got = drive(tracker, batches[10:])[-1], drive(restored, batches[10:])[-1]
    assert want.height_m is not None and got.height_m is not None
    assert got.height_m.tolist() == want.height_m.tolist()


def test_up_is_up() -> None:
    """At the site of a radar its own up is the plane's; far away it leans."""
    place = places.on_earth(AWAY, ORIGIN)
    assert place.turn is not None
    np.testing.assert_allclose(place.turn @ place.turn.T, np.eye(3), atol=1e-12)
    assert 0.99 < place.turn[2, 2] < 1.0 - 1e-5
    home = places.on_earth(ORIGIN, ORIGIN)
    assert home.turn is not None
    np.testing.assert_allclose(home.turn, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(home.site, np.zeros(3), atol=1e-6)
