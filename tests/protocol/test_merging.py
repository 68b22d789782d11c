"""One picture of several units: doubles, deaths, tracks that are told no more."""

from __future__ import annotations

import numpy as np
import pytest
from tests.protocol.builders import frame

from trackmesh.protocol.merging import LatestFrames, ahead, without_doubles
from trackmesh.protocol.messages import COASTING, CONFIRMED, ENDED, TrackFrame
from trackmesh.protocol.picture import TrackPicture

SECOND_NS = 10**9


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def told(frames: list[TrackFrame]) -> dict[str, list[int]]:
    return {one.unit_id: one.track_id.tolist() for one in frames}


def test_a_track_that_two_units_tell_is_in_the_frame_of_the_higher_epoch() -> None:
    frames = [frame([1, 2], unit="a", epoch=1), frame([2, 3], unit="b", epoch=2)]
    assert told(without_doubles(frames)) == {"a": [1], "b": [2, 3]}
    assert told(without_doubles(frames[::-1])) == {"a": [1], "b": [2, 3]}


def test_with_equal_epochs_the_later_frame_counts() -> None:
    assert told(without_doubles([frame([1], unit="a", t_ns=20), frame([1], unit="b", t_ns=10)])) == {"a": [1], "b": []}


def test_frames_without_common_tracks_are_left_alone() -> None:
    frames = [frame([1, 2], unit="a"), frame([3], unit="b")]
    assert without_doubles(frames) == frames
    assert without_doubles([]) == []


def test_prediction_is_that_of_constant_velocity() -> None:
    one = frame([1])
    state, covariance = one.state.copy(), one.covariance.copy()
    state[0, :4] = [100.0, 200.0, 10.0, -20.0]
    moved, wider = ahead(state, covariance, np.array([2.0]))
    np.testing.assert_allclose(moved[0, :4], [120.0, 160.0, 10.0, -20.0])
    assert wider[0, 0] > covariance[0, 0]
    same, as_before = ahead(state, covariance, np.zeros(1))
    np.testing.assert_array_equal(same, state)
    np.testing.assert_array_equal(as_before, covariance)


def test_a_dead_units_tracks_are_carried_on_until_others_go_on_with_them() -> None:
    clock = Clock()
    latest, merged = LatestFrames(clock=clock), TrackPicture(clock=clock)
    for one in (latest, merged):
        one.update(frame([1, 2], unit="a", epoch=1))
        one.update(frame([9], unit="b"))
        one.note_alive("a", False)
    clock.now_s += 3.0
    carried = {one.unit_id: one for one in latest.frames()}["a"]
    assert carried.status.tolist() == [COASTING, COASTING]
    assert carried.t_ns == frame([1]).t_ns + 3 * SECOND_NS
    before = frame([1, 2], epoch=1)
    np.testing.assert_allclose(carried.state[:, :2], before.state[:, :2] + 3.0 * before.state[:, 2:4])
    picture = merged.picture()
    assert picture.status.tolist() == [COASTING, COASTING, CONFIRMED]
    np.testing.assert_allclose(picture.state[:2], carried.state)
    for one in (latest, merged):
        one.update(frame([1, 2, 9], unit="b", epoch=2, seq=1, t_ns=before.t_ns + 3 * SECOND_NS))
    assert told(latest.frames()) == {"a": [], "b": [1, 2, 9]}
    assert merged.picture().status.tolist() == [CONFIRMED] * 3


def test_a_dead_units_tracks_are_not_carried_on_for_ever() -> None:
    clock = Clock()
    latest, merged = LatestFrames(clock=clock), TrackPicture(clock=clock)
    for one in (latest, merged):
        one.update(frame([1], unit="a"))
        one.note_alive("a", False)
    clock.now_s += 6.5
    assert latest.frames() == []
    assert len(merged.picture()) == 0
    for one in (latest, merged):
        one.note_alive("a", True)
        one.update(frame([1], unit="a", seq=1))
    assert told(latest.frames()) == {"a": [1]}
    assert merged.picture().status.tolist() == [CONFIRMED]


@pytest.mark.parametrize(("later_s", "shown"), [(2, [1, 2]), (5, [2])])
def test_a_missing_track_has_not_ended_until_its_unit_was_silent_of_it_for_two_cycles(
    later_s: int, shown: list[int]
) -> None:
    merged = TrackPicture()
    merged.update(frame([1, 2], t_ns=10 * SECOND_NS))
    merged.update(frame([2], seq=1, t_ns=(10 + later_s) * SECOND_NS))
    assert merged.picture().track_id.tolist() == shown


def test_an_end_told_by_who_was_cut_off_does_not_end_the_track_of_another() -> None:
    merged = TrackPicture()
    merged.update(frame([7], unit="cut-off", epoch=3, t_ns=10 * SECOND_NS, status=ENDED))
    merged.update(frame([7], unit="owner", epoch=2, t_ns=11 * SECOND_NS))
    assert merged.picture().track_id.tolist() == []
    merged.update(frame([7], unit="owner", epoch=2, seq=1, t_ns=15 * SECOND_NS))
    assert merged.picture().track_id.tolist() == [7]


def test_a_frame_that_comes_late_is_left_out() -> None:
    latest = LatestFrames()
    latest.update(frame([1, 2], seq=5))
    latest.update(frame([3], seq=4))
    assert told(latest.frames()) == {frame([1]).unit_id: [1, 2]}
