"""Whatever other units tell: it is taken or refused with a reason, and what we publish stays a right message."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.services.fusion.makers import NORTH, ONE, ns, scans
from tests.services.fusion.units import IDENT, frame, take, unit, upper

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, TrackFrame, TrackQuery

FAR_FUTURE_S = 1e8


def real(*values: float) -> st.SearchStrategy[float]:
    """Up to the greatest of these, and these themselves."""
    most = max(values)
    return st.sampled_from([*values, *(-v for v in values)]) | st.floats(-most, most, allow_nan=False)


places = st.builds(
    Geodetic, latitude_deg=real(90.0, 0.0), longitude_deg=real(180.0, 0.0), height_m=real(0.0, 1e3)
)  # fmt: skip


@st.composite
def frames(draw: st.DrawFn, t_s: float, seq: int) -> TrackFrame:
    n = draw(st.integers(0, 3))
    ids = draw(st.lists(st.integers(0, 4), min_size=n, max_size=n))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.normal(size=(n, 4, 4)) * 10.0 ** rng.uniform(*draw(st.sampled_from([(0, 2), (-6, 18), (1, 1)])), (n, 4, 1))
    P = np.clip(A @ np.swapaxes(A, 1, 2), -3e38, 3e38)
    state = np.array([[draw(real(0.0, 1e5, 1e9)), draw(real(0.0, 1e5, 1e9)), 0.0, 0.0] for _ in range(n)])
    state = state.reshape(n, 4) + np.array([0.0, 0.0, draw(real(0.0, 300.0, 1e6)), draw(real(0.0, 300.0, 1e6))])
    own = ns(t_s)
    updated = [max(0, own - draw(st.sampled_from([0, 1, 10**9, 14 * 10**9, 16 * 10**9, own, -1]))) for _ in range(n)]
    heights = {"height_m": np.full(n, 1e4), "height_variance_m2": np.full(n, draw(st.sampled_from([0.0, 1e4, 1e18])))}
    return frame(
        t_s, state, seq=seq, track_id=IDENT + np.array(ids, np.int64), covariance=upper(P),
        status=np.array(draw(st.lists(st.integers(0, 3), min_size=n, max_size=n)), np.uint8),
        updated_t_ns=np.array(updated, np.int64), origin=draw(st.none() | places),
        members=rng.integers(-1, 2, (n, 2)), sensors=["main", "far"],
        **(heights if draw(st.booleans()) else {}),
    )  # fmt: skip


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_frames_are_taken_or_refused_and_ours_stay_right(data: st.DataObject) -> None:
    tracker = unit("main", 1, NORTH)
    batches = iter(list(scans(NORTH, ONE, 60.0)))
    for k in range(8):
        t_s = 4.0 * k
        take(tracker, next(batches))
        told = data.draw(frames(t_s + data.draw(st.sampled_from([0.5, 0.5, -20.0, 0.0])), k))
        assert decode(encode(told), TrackFrame) == told
        try:
            take(tracker, told)
        except RefusedMessage as error:
            assert error.reason in (
                "invalid_covariance", "duplicate_track", "future_update", "old_frame", "out_of_bounds", "not_finite",
            )  # fmt: skip
    for t_s in (30.0, 31.0, FAR_FUTURE_S, -50.0):
        picture = tracker.query(TrackQuery(at_t_ns=ns(t_s)))
        assert decode(encode(picture), TrackFrame) == picture
    kept = tracker.snapshot()
    assert kept is not None
    again = unit("main", 1)
    again.restore(kept)
    last = again.tick(ns(60.0))
    assert last is not None and decode(encode(last), TrackFrame) == last
