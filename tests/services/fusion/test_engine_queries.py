"""Questions to the engine about its picture, and pictures in geographic coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymap3d
import pytest
from tests.services.fusion.makers import (
    FAR_APART,
    GEODETIC,
    NORTH,
    POLAR,
    Fleet,
    FloatArray,
    batch,
    drive,
    engine,
    ids,
    in_time_order,
    nearest,
    ns,
    position_sensor,
    radar,
    scans,
)

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, PlotBatch, TrackFrame, TrackQuery
from trackmesh.services.fusion.engine import FusionEngine


def four_tracks(**settings: Any) -> FusionEngine:
    """Four tracks; the first was last seen at 28 s, the others at 40 s."""
    out = engine(NORTH, **settings)
    drive(out, scans(NORTH, FAR_APART, 32.0))
    others = Fleet(FAR_APART.start[1:], FAR_APART.velocity[1:])
    drive(out, scans(NORTH, others, 42.0, offset_s=32.0))
    return out


@pytest.fixture
def tracker() -> FusionEngine:
    return four_tracks()


def at(frame: TrackFrame, place: FloatArray) -> int:
    """Id of the track at a place."""
    k, distance = nearest(frame, place)
    assert distance < 200
    return int(frame.track_id[k])


# --- which tracks ---


def test_by_id_box_age_and_status(tracker: FusionEngine) -> None:
    picture = tracker.query(TrackQuery())
    by_target = [at(picture, place) for place in FAR_APART.at(40.0)]
    assert sorted(by_target) == sorted(picture.track_id.tolist())
    assert ids(tracker.query(TrackQuery(track_ids=by_target[1:3]))) == set(by_target[1:3])
    assert ids(tracker.query(TrackQuery(max_age_s=5.0))) == set(by_target[1:])
    assert ids(tracker.query(TrackQuery(status=[2]))) == {by_target[0]}
    east, north = FAR_APART.at(40.0)[2]
    box = [east - 1e3, north - 1e3, east + 1e3, north + 1e3]
    assert ids(tracker.query(TrackQuery(bbox_enu_m=box))) == {by_target[2]}
    assert not ids(tracker.query(TrackQuery(track_ids=by_target[:1], max_age_s=5.0)))


# --- when ---


def test_the_future_is_the_present_flown_on() -> None:
    """With models of constant velocity, exactly."""
    tracker = four_tracks(filter="imm")
    now, later = tracker.query(TrackQuery()), tracker.query(TrackQuery(at_t_ns=ns(70.0)))
    assert later.t_ns == ns(70.0)
    assert later.track_id.tolist() == now.track_id.tolist()
    np.testing.assert_allclose(later.state[:, :2], now.state[:, :2] + 30.0 * now.state[:, 2:4], atol=1e-6)
    np.testing.assert_allclose(later.state[:, 2:], now.state[:, 2:], atol=1e-9)
    spread = [np.trace(f.covariance_matrices(), axis1=1, axis2=2) for f in (now, later)]
    assert np.all(spread[1] > 2 * spread[0])


def test_a_target_that_may_turn_is_expected_short_of_the_present_flown_on(tracker: FusionEngine) -> None:
    """With models that turn, the mean of where it can be stays behind, well within what the covariance says."""
    now, later = tracker.query(TrackQuery()), tracker.query(TrackQuery(at_t_ns=ns(70.0)))
    way = 30.0 * now.state[:, 2:4]
    off = later.state[:, :2] - now.state[:, :2] - way
    length = np.linalg.norm(way, axis=1)
    assert np.all((off * way).sum(axis=1) < 0)
    assert np.all(np.linalg.norm(off, axis=1) < 0.1 * length)
    P = later.covariance_matrices()[:, :2, :2]
    assert np.all(np.einsum("ni,ni->n", off, np.linalg.solve(P, off[..., None])[..., 0]) < 0.25)


# The default filter is asked less far ahead: its models turn, so that its mean falls behind a straight line.
@pytest.mark.parametrize(("kind", "ahead_s"), [("imm", 140.0), ("tvimm", 70.0)])
def test_a_box_is_asked_at_the_time_asked(kind: str, ahead_s: float) -> None:
    tracker = four_tracks(filter=kind)
    east, north = FAR_APART.at(ahead_s)[3]
    box = [east - 2e3, north - 2e3, east + 2e3, north + 2e3]
    assert not ids(tracker.query(TrackQuery(bbox_enu_m=box)))
    assert len(ids(tracker.query(TrackQuery(bbox_enu_m=box, at_t_ns=ns(ahead_s))))) == 1


def test_the_past_within_the_ring_is_what_was_told_then() -> None:
    tracker, told = engine(NORTH, ring_system=8), {}
    for b in scans(NORTH, FAR_APART, 80.0):
        [frame] = drive(tracker, [b])
        told[frame.t_ns] = frame
    for back in (4.0, 16.0, 28.0):
        then = tracker.query(TrackQuery(at_t_ns=ns(76.0 - back)))
        want = told[ns(76.0 - back)]
        assert then.track_id.tolist() == want.track_id.tolist()
        np.testing.assert_allclose(then.state, want.state, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(then.model_probability, want.model_probability, atol=1e-12)


def test_before_the_ring_there_is_no_answer_and_no_error() -> None:
    tracker = engine(NORTH, ring_system=4)
    drive(tracker, scans(NORTH, FAR_APART, 80.0))
    assert len(ids(tracker.query(TrackQuery(at_t_ns=ns(74.0))))) == 4
    assert not ids(tracker.query(TrackQuery(at_t_ns=ns(30.0))))
    assert not ids(tracker.query(TrackQuery(at_t_ns=0)))


def test_a_track_was_not_before_its_first_plot() -> None:
    tracker = engine(NORTH, ring_system=64)
    first, second = (Fleet(FAR_APART.start[k : k + 1], FAR_APART.velocity[k : k + 1]) for k in (0, 1))
    drive(tracker, in_time_order(scans(NORTH, first, 30.0), scans(NORTH, second, 30.0, offset_s=10.0)))
    assert len(ids(tracker.query(TrackQuery(at_t_ns=ns(29.0))))) == 2
    assert len(ids(tracker.query(TrackQuery(at_t_ns=ns(9.0))))) == 1


# --- where on Earth ---

ORIGIN = Geodetic(latitude_deg=50.0, longitude_deg=8.0, height_m=100.0)
AWAY = Geodetic(latitude_deg=50.3, longitude_deg=8.5, height_m=250.0)
AIS = position_sensor(sigma={"latitude_deg": 30.0, "longitude_deg": 30.0})


def on_earth(t_s: float) -> FloatArray:
    """Latitude, longitude and height of the fleet, which flies in the plane of ``ORIGIN``."""
    east, north = FAR_APART.at(t_s).T
    return np.stack(pymap3d.enu2geodetic(east, north, np.zeros(4), 50.0, 8.0, 100.0), axis=1)


def by_radar(name: str, site: Geodetic, t_s: float) -> PlotBatch:
    """The fleet as a radar with elevation tells of it."""
    azimuth, elevation, range_m = pymap3d.geodetic2aer(
        *on_earth(t_s).T, site.latitude_deg, site.longitude_deg, site.height_m
    )
    values = np.stack([range_m, np.radians(azimuth), np.radians(elevation)], axis=1)
    return batch(name, t_s, values, [*POLAR, "elevation_rad"])


def test_radars_and_positions_on_earth_share_a_plane() -> None:
    """Errorless plots of two radars 49 km apart and of geodetic positions fall on one another."""
    here, there = radar("here", site_enu_m=None, site=ORIGIN), radar("there", site_enu_m=None, site=AWAY)
    tracker = engine(AIS, here, there)
    assert tracker.origin == ORIGIN
    for t in np.arange(0.0, 40.0, 4.0).tolist():
        drive(tracker, [by_radar("here", ORIGIN, t), by_radar("there", AWAY, t + 1.0)])
        [last] = drive(tracker, [batch("ais", t + 2.0, on_earth(t + 2.0), [*GEODETIC, "height_m"])])
    assert last.origin == ORIGIN
    assert len(last.track_id) == 4
    assert max(nearest(last, place)[1] for place in FAR_APART.at(38.0)) < 5.0
    assert -1 not in last.members


def test_a_geodetic_sensor_may_be_heard_of_before_there_is_an_origin() -> None:
    tracker = engine(AIS)
    plots = batch("ais", 0.0, on_earth(0.0), [*GEODETIC, "height_m"])
    with pytest.raises(RefusedMessage, match="no_origin"):
        tracker.plots(plots)
    tracker.sensor(radar("here", site_enu_m=None, site=ORIGIN))
    tracker.sensor(AIS)
    [frame] = drive(tracker, [plots])
    assert frame.origin == ORIGIN
    assert tracker.counters["plots"] == 4


def test_a_box_in_degrees_finds_what_is_there() -> None:
    here = radar("here", site_enu_m=None, site=ORIGIN)
    tracker = engine(here)
    for t in np.arange(0.0, 40.0, 4.0).tolist():
        drive(tracker, [by_radar("here", ORIGIN, t)])
    latitude, longitude, _ = on_earth(36.0)[1]
    found = tracker.query(TrackQuery(bbox_deg=[latitude - 0.01, longitude - 0.01, latitude + 0.01, longitude + 0.01]))
    assert len(found.track_id) == 1
    assert nearest(found, FAR_APART.at(36.0)[1])[1] < 5.0


def test_without_an_origin_a_box_in_degrees_is_refused(tracker: FusionEngine) -> None:
    with pytest.raises(RefusedMessage) as error:
        tracker.query(TrackQuery(bbox_deg=[0.0, 0.0, 1.0, 1.0]))
    assert error.value.reason == "no_origin"
