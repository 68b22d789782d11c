"""What may enter the engine: each sensor's sequence of batches, and the plausibility of time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import PlotBatch

_BOOTS_REMEMBERED = 16


@dataclass
class Stream:
    """What is known of one sensor's batches: counts since start, and the last accepted one."""

    boot_id: str = ""
    seq: int = -1
    last_t_ns: int | None = None
    batches: int = 0
    plots: int = 0
    gaps: int = 0
    duplicates: int = 0
    refused: int = 0
    earlier_boots: deque[str] = field(default_factory=lambda: deque(maxlen=_BOOTS_REMEMBERED))


class Intake:
    """Refuses what repeats, comes out of sequence, or is not of this time; counts per sensor.

    Args:
        max_age_ns, max_ahead_ns: how far plots may lie before and after now.
    """

    def __init__(self, max_age_ns: int, max_ahead_ns: int) -> None:
        self._max_age_ns = max_age_ns
        self._max_ahead_ns = max_ahead_ns
        self.streams: dict[str, Stream] = {}

    def stream(self, sensor_id: str) -> Stream:
        """The stream of a sensor, new if it was never heard of."""
        return self.streams.setdefault(sensor_id, Stream())

    def kept(self) -> dict[str, list[Any]]:
        """By sensor the boot id, the number and the time of the last batch taken, for the next start."""
        return {name: [one.boot_id, one.seq, one.last_t_ns] for name, one in self.streams.items() if one.boot_id}

    def restore(self, kept: dict[str, list[Any]]) -> None:
        """Go on where an earlier run was, so that what it took is not taken again."""
        for name, (boot_id, seq, last_t_ns) in kept.items():
            self.streams[name] = Stream(boot_id=boot_id, seq=seq, last_t_ns=last_t_ns)

    def check(self, batch: PlotBatch, now_ns: int | None) -> None:
        """Let a batch in, or not; without ``now_ns`` its times are not judged.

        A boot id that was followed by another one is over: two processes that claim one sensor id do not take turns.

        Raises:
            RefusedMessage: ``future``, ``past``, ``duplicate_seq``, ``out_of_order_seq`` or ``old_boot``.
        """
        stream = self.stream(batch.sensor_id)
        if now_ns is not None and len(batch.t_ns):
            self._check_time(batch, now_ns)
        if batch.boot_id != stream.boot_id:
            self._new_boot(stream, batch)
        elif batch.seq == stream.seq:
            stream.duplicates += 1
            raise RefusedMessage("duplicate_seq", f"Batch {batch.seq} of {batch.sensor_id} came twice.")
        elif batch.seq < stream.seq:
            raise RefusedMessage("out_of_order_seq", f"Batch {batch.seq} of {batch.sensor_id} came after {stream.seq}.")
        else:
            stream.gaps += batch.seq - stream.seq - 1
        stream.seq = batch.seq
        stream.batches += 1
        stream.plots += len(batch.t_ns)
        if len(batch.t_ns):
            stream.last_t_ns = int(batch.t_ns.max())

    def _check_time(self, batch: PlotBatch, now_ns: int) -> None:
        ahead = int(batch.t_ns.max()) - now_ns
        if ahead > self._max_ahead_ns:
            raise RefusedMessage("future", f"A plot of {batch.sensor_id} lies {ahead / 1e9:.1f} s in the future.")
        age = now_ns - int(batch.t_ns.min())
        if age > self._max_age_ns:
            raise RefusedMessage("past", f"A plot of {batch.sensor_id} is {age / 1e9:.1f} s old.")

    def _new_boot(self, stream: Stream, batch: PlotBatch) -> None:
        if batch.boot_id in stream.earlier_boots:
            raise RefusedMessage("old_boot", f"Another process has taken over the sensor id {batch.sensor_id}.")
        if stream.boot_id:
            stream.earlier_boots.append(stream.boot_id)
        stream.boot_id = batch.boot_id
