"""One picture out of many frames."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.protocol.builders import frame

from trackmesh.protocol.messages import ENDED, UNKNOWN_HEIGHT_M2, TrackFrame
from trackmesh.protocol.picture import TrackPicture


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def ids(picture: TrackPicture) -> list[int]:
    return [int(i) for i in picture.picture().track_id]


def test_the_empty_picture_has_its_shapes() -> None:
    picture = TrackPicture().picture()
    assert len(picture) == 0
    assert picture.state.shape == (0, 6) and picture.covariance.shape == (0, 6, 6)


def test_tracks_of_several_units_stand_side_by_side() -> None:
    merged = TrackPicture()
    merged.update(frame([3, 1], unit="a"))
    merged.update(frame([2], unit="b"))
    picture = merged.picture()
    assert picture.track_id.tolist() == [1, 2, 3]
    assert picture.unit_id == ["a", "b", "a"]
    assert picture.state[:, 0].tolist() == [1.0, 2.0, 3.0]
    assert np.array_equal(picture.covariance[0], frame([1]).covariance_matrices()[0])


def test_a_later_frame_of_a_unit_replaces_its_tracks_and_keeps_those_it_does_not_tell() -> None:
    merged = TrackPicture()
    merged.update(frame([1, 2], seq=0, t_ns=10))
    merged.update(frame([2, 3], seq=1, t_ns=20))
    picture = merged.picture()
    assert picture.track_id.tolist() == [1, 2, 3]
    assert picture.t_ns.tolist() == [10, 20, 20]


def test_the_higher_epoch_counts_whatever_comes_first() -> None:
    for frames in ((0, 1), (1, 0)):
        merged = TrackPicture()
        for epoch in frames:
            merged.update(frame([7], unit=f"unit{epoch}", epoch=epoch, t_ns=100 - epoch))
        picture = merged.picture()
        assert picture.unit_id == ["unit1"] and picture.epoch.tolist() == [1]


def test_an_ended_track_is_gone_and_does_not_come_back_from_an_older_owner() -> None:
    merged = TrackPicture()
    merged.update(frame([7], unit="new", epoch=2))
    merged.update(frame([7], unit="new", epoch=2, seq=1, t_ns=2_000, status=ENDED))
    merged.update(frame([7], unit="old", epoch=1, t_ns=3_000))
    assert ids(merged) == []


def test_an_owner_that_ends_a_track_it_gave_away_does_not_end_it() -> None:
    merged = TrackPicture()
    merged.update(frame([7], unit="new", epoch=2))
    merged.update(frame([7], unit="old", epoch=1, status=ENDED, t_ns=5_000))
    assert ids(merged) == [7]


def test_a_frame_that_comes_late_is_left_out() -> None:
    merged = TrackPicture()
    merged.update(frame([1], seq=5, t_ns=50))
    merged.update(frame([1, 2], seq=4, t_ns=40))
    assert ids(merged) == [1]
    merged.update(frame([1, 2], seq=0, t_ns=60, boot="restarted"))
    assert ids(merged) == [1, 2]


def test_silence_makes_stale_then_forgets() -> None:
    clock = Clock()
    merged = TrackPicture(stale_after_s=10.0, forget_after_s=30.0, clock=clock)
    merged.update(frame([1], unit="a"))
    clock.now_s += 11.0
    merged.update(frame([2], unit="b"))
    assert merged.picture().stale.tolist() == [True, False]
    merged.update(frame([1], unit="a", seq=1))
    assert merged.picture().stale.tolist() == [False, False]
    clock.now_s += 31.0
    assert ids(merged) == []


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b", "c"]),
            st.sets(st.integers(0, 5), max_size=4),
            st.integers(0, 3),
            st.integers(0, 3),
        ),
        max_size=12,
    )
)
def test_the_picture_is_that_of_a_plain_dictionary(told: list[tuple[str, set[int], int, int]]) -> None:
    merged = TrackPicture()
    best: dict[int, tuple[int, int, int, str]] = {}
    for order, (unit, members, epoch, status) in enumerate(told):
        new: TrackFrame = frame(sorted(members), unit=unit, seq=order, t_ns=order, epoch=epoch, status=status)
        merged.update(new)
        for member in members:
            best[member] = max(best.get(member, (-1, -1, 0, "")), (epoch, order, status, unit), key=lambda b: b[:2])
    want = {member: b for member, b in best.items() if b[2] != ENDED}
    picture = merged.picture()
    assert picture.track_id.tolist() == sorted(want)
    assert picture.unit_id == [want[m][3] for m in sorted(want)]
    assert picture.epoch.tolist() == [want[m][0] for m in sorted(want)]


def test_heights_that_are_not_known_are_not_told_as_heights() -> None:
    told = frame([1, 2], unit="a").model_copy(
        update={"height_m": np.array([8e3, 0.0]), "height_variance_m2": np.array([400.0, UNKNOWN_HEIGHT_M2])}
    )
    assert told.height_known().tolist() == [True, False]
    assert frame([3]).height_known().tolist() == [False]
    merged = TrackPicture()
    merged.update(told)
    merged.update(frame([3], unit="b"))
    np.testing.assert_array_equal(merged.picture().height_m, [8e3, np.nan, np.nan])
