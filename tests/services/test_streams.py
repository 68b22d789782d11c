"""Sequences of batches: what repeats, is out of order, of another boot, or of another time."""

from __future__ import annotations

import numpy as np
import pytest

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.services.streams import Streams

S = 1_000_000_000
NOW = 1_700_000_000 * S


def put(streams: Streams, seq: int, *, boot: str = "b", t_s: tuple[float, ...] = (0.0,), now: bool = False) -> str:
    """The reason for which a batch is refused, or nothing."""
    t_ns = np.array([NOW + round(t * S) for t in t_s], np.int64)
    try:
        streams.check("hall", boot, seq, t_ns, NOW if now else None)
    except RefusedMessage as error:
        return error.reason
    return ""


def test_batches_in_order_are_counted_and_gaps_too() -> None:
    streams = Streams()
    assert [put(streams, seq, t_s=(0.0, 1.0)) for seq in (0, 1, 4)] == ["", "", ""]
    stream = streams.known["hall"]
    assert (stream.batches, stream.rows, stream.gaps, stream.seq) == (3, 6, 2, 4)
    assert stream.last_t_ns == NOW + S


@pytest.mark.parametrize(("seq", "reason"), [(4, "duplicate_seq"), (3, "out_of_order_seq")])
def test_what_comes_again_or_late_is_refused(seq: int, reason: str) -> None:
    streams = Streams()
    put(streams, 4)
    assert put(streams, seq) == reason
    assert streams.known["hall"].duplicates == (reason == "duplicate_seq")
    assert put(streams, 5) == ""


def test_two_processes_do_not_take_turns() -> None:
    streams = Streams()
    assert [put(streams, 0, boot="a"), put(streams, 0, boot="b"), put(streams, 1, boot="a")] == ["", "", "old_boot"]
    assert put(streams, 1, boot="b") == ""


def test_times_must_be_of_now_where_that_is_known() -> None:
    streams = Streams(60 * S, 2 * S)
    assert put(streams, 0, t_s=(-59.0, 1.9), now=True) == ""
    assert put(streams, 1, t_s=(-61.0, 0.0), now=True) == "past"
    assert put(streams, 1, t_s=(0.0, 2.1), now=True) == "future"
    assert put(streams, 1, t_s=(), now=True) == ""
    assert put(streams, 2, t_s=(9e3,)) == ""
