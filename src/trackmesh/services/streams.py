"""The sequences in which batches come from others: what repeats, is out of order or not of this time is refused."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from trackmesh.protocol.arrays import IntArray
from trackmesh.protocol.errors import RefusedMessage

_BOOTS_REMEMBERED = 16


@dataclass
class Stream:
    """What is known of one sender's batches: counts since start, and the last accepted one."""

    boot_id: str = ""
    seq: int = -1
    last_t_ns: int | None = None
    batches: int = 0
    rows: int = 0
    gaps: int = 0
    duplicates: int = 0
    refused: int = 0
    earlier_boots: deque[str] = field(default_factory=lambda: deque(maxlen=_BOOTS_REMEMBERED))


class Streams:
    """One stream a sender.

    Args:
        max_age_ns, max_ahead_ns: how far the times of a batch may lie before and after now.
    """

    def __init__(self, max_age_ns: int = 0, max_ahead_ns: int = 0) -> None:
        self._max_age_ns = max_age_ns
        self._max_ahead_ns = max_ahead_ns
        self.known: dict[str, Stream] = {}

    def check(self, sender: str, boot_id: str, seq: int, t_ns: IntArray, now_ns: int | None) -> None:
        """Let a batch in, or not; without ``now_ns`` its times are not judged.

        A boot id that was followed by another one is over: two processes that claim one id do not take turns.

        Raises:
            RefusedMessage: ``future``, ``past``, ``duplicate_seq``, ``out_of_order_seq`` or ``old_boot``.
        """
        stream = self.known.setdefault(sender, Stream())
        if now_ns is not None and len(t_ns):
            self._check_time(sender, t_ns, now_ns)
        if boot_id != stream.boot_id:
            if boot_id in stream.earlier_boots:
                raise RefusedMessage("old_boot", f"Another process has taken over the id {sender}.")
            if stream.boot_id:
                stream.earlier_boots.append(stream.boot_id)
            stream.boot_id = boot_id
        elif seq == stream.seq:
            stream.duplicates += 1
            raise RefusedMessage("duplicate_seq", f"Batch {seq} of {sender} came twice.")
        elif seq < stream.seq:
            raise RefusedMessage("out_of_order_seq", f"Batch {seq} of {sender} came after {stream.seq}.")
        else:
            stream.gaps += seq - stream.seq - 1
        stream.seq = seq
        stream.batches += 1
        stream.rows += len(t_ns)
        if len(t_ns):
            stream.last_t_ns = int(t_ns.max())

    def _check_time(self, sender: str, t_ns: IntArray, now_ns: int) -> None:
        ahead = int(t_ns.max()) - now_ns
        if ahead > self._max_ahead_ns:
            raise RefusedMessage("future", f"A measurement of {sender} lies {ahead / 1e9:.1f} s in the future.")
        age = now_ns - int(t_ns.min())
        if age > self._max_age_ns:
            raise RefusedMessage("past", f"A measurement of {sender} is {age / 1e9:.1f} s old.")
