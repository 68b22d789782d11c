"""Frames of others: what is refused, by which reason, and what is left of the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymap3d
import pytest
from tests.services.fusion.makers import NORTH, FloatArray, ns
from tests.services.fusion.units import IDENT, SIGMA_M, frame, unit, upper

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import COASTING, CONFIRMED, ENDED, TENTATIVE, Geodetic, TrackFrame
from trackmesh.services.fusion.foreign_frames import moved, read

STATES = np.array([[10e3, 20e3, 100.0, 50.0], [-10e3, 5e3, 0.0, -200.0]])


def with_variance(variance: float) -> FloatArray:
    P = np.tile(np.eye(4) * 100.0, (2, 1, 1))
    P[1, 2, 2] = variance
    return P


def with_covariance(covariance: float) -> FloatArray:
    P = np.tile(np.eye(4) * 100.0, (2, 1, 1))
    P[1, 0, 1] = P[1, 1, 0] = covariance
    return P


def plain(**change: Any) -> TrackFrame:
    """A frame that no codec has looked at."""
    return frame(5.0, STATES).model_copy(update=change)


WRONG: dict[str, tuple[str, TrackFrame]] = {
    "our own": ("own_tracks", plain(unit_id="main")),
    "a stranger's": ("unknown_input", plain(unit_id="stranger")),
    "not a number": ("not_finite", plain(state=np.full((2, 6), np.nan))),
    "an infinite covariance": ("not_finite", plain(covariance=np.full((2, 21), np.inf, np.float32))),
    "beyond the moon": ("out_of_bounds", plain(state=np.full((2, 6), 2e9))),
    "faster than light": ("out_of_bounds", plain(state=np.pad(STATES * [1, 1, 1e7, 1], ((0, 0), (0, 2))))),
    "a negative variance": ("invalid_covariance", plain(covariance=upper(with_variance(-1.0)))),
    "no variance": ("invalid_covariance", plain(covariance=upper(with_variance(0.0)))),
    "correlated too much": ("invalid_covariance", plain(covariance=upper(with_covariance(101.0)))),
    "one track twice": ("duplicate_track", plain(track_id=np.array([IDENT, IDENT]))),
    "seen tomorrow": ("future_update", plain(updated_t_ns=np.array([ns(5.0), ns(5.0) + 1]))),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_frame_is_refused_whole_and_changes_nothing(what: str) -> None:
    reason, wrong = WRONG[what]
    tracker = unit("main", 1, NORTH)
    with pytest.raises(RefusedMessage) as caught:
        tracker.tracks(wrong)
    assert caught.value.reason == reason
    assert tracker.now_ns is None and tracker.figures()["input_tracks.other"] == 0
    # The right one of the same number is still taken.
    tracker.tracks(plain())
    assert tracker.figures()["input_tracks.other"] == 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, "duplicate_seq"),
        ({"seq": 49}, "out_of_order_seq"),
        ({"seq": 51, "t_ns": ns(4.9), "updated_t_ns": np.full(2, ns(4.0))}, "old_frame"),
        ({"boot_id": "zero", "seq": 51}, "old_boot"),
    ],
)
def test_frames_come_in_sequence(change: dict[str, Any], reason: str) -> None:
    tracker = unit("main", 1, NORTH)
    tracker.tracks(plain(boot_id="zero", seq=3))
    tracker.tracks(plain())
    with pytest.raises(RefusedMessage) as caught:
        tracker.tracks(plain(**change))
    assert caught.value.reason == reason


def test_a_unit_without_inputs_takes_no_frames() -> None:
    tracker = unit("main", 1, NORTH, inputs=())
    with pytest.raises(RefusedMessage) as caught:
        tracker.tracks(plain())
    assert caught.value.reason == "unknown_input"
    assert tracker.now_ns is None


def test_rounded_covariances_are_no_reason_to_refuse() -> None:
    P = np.full((2, 4, 4), 100.0) * (1.0 - 1e-9)
    P[:, range(4), range(4)] = 100.0
    np.linalg.cholesky(P)
    told = read(plain(covariance=upper(P)), "main")
    np.linalg.cholesky(told.P)


def test_only_what_its_sender_has_confirmed_is_taken() -> None:
    four = np.concatenate([STATES, STATES + 3e3])
    status = np.array([TENTATIVE, CONFIRMED, COASTING, ENDED], np.uint8)
    told = read(frame(5.0, four, status=status), "main")
    assert told.ident.tolist() == [IDENT + 1, IDENT + 2]
    assert told.coasting.tolist() == [False, True]
    assert told.ended.tolist() == [IDENT + 3]
    np.testing.assert_array_equal(told.x, four[1:3])
    np.testing.assert_allclose(told.P[:, 0, 0], SIGMA_M**2, rtol=2e-6)


def test_a_track_that_its_sender_has_from_us_alone_is_an_echo() -> None:
    three = np.concatenate([STATES, STATES[:1] + 3e3])
    members = np.array([[4, -1], [5, 6], [-1, 7]])
    told = read(frame(5.0, three, sensors=["main", "far"], members=members), "main")
    assert told.echo.tolist() == [True, False, False]


def test_tracks_are_moved_from_the_plane_of_their_sender_to_ours() -> None:
    theirs, ours = Geodetic(latitude_deg=48.0, longitude_deg=11.0), Geodetic(latitude_deg=49.0, longitude_deg=13.5)
    told = read(frame(5.0, STATES, origin=theirs), "main")
    got = moved(told, frame(5.0, STATES, origin=theirs), ours)
    for dt in (0.0, 10.0):
        place = STATES[:, :2] + dt * STATES[:, 2:]
        where = pymap3d.enu2geodetic(place[:, 0], place[:, 1], np.zeros(2), 48.0, 11.0, 0.0)
        east, north, _ = pymap3d.geodetic2enu(*where, 49.0, 13.5, 0.0)
        np.testing.assert_allclose(got.x[:, :2] + dt * got.x[:, 2:], np.stack([east, north], axis=1), atol=1e-3)
    # Nearly a rotation: areas stay but for the tilt of the plane.
    np.testing.assert_allclose(np.linalg.det(got.P), np.linalg.det(told.P), rtol=2e-2)


def test_a_plane_without_a_place_is_ours() -> None:
    told = read(plain(), "main")
    assert moved(told, plain(), Geodetic(latitude_deg=48.0, longitude_deg=11.0)) is told
    assert moved(told, plain(origin=Geodetic(latitude_deg=48.0, longitude_deg=11.0)), None) is told
