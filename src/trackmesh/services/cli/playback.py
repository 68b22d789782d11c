"""Publishing a recording with the rhythm in which it was made."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable

from trackmesh.protocol.bus import Bus
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import Message, PlotBatch, SensorInfo
from trackmesh.protocol.sensor import SensorPublisher

# Who subscribes first asks a new sensor for what it has kept, and holds back the rest for so long: plots sent meanwhile
# would come one sensor after the other instead of in the order of the recording.
_SETTLE_S = 1.0
_FLUSH_S = 1.5
_KEPT = 1024
# Publishers drop what the network cannot take, so "as fast as possible" has a limit.
_GAP_S = 0.002


def play_records(
    bus: Bus, keys: Keys, records: Iterable[Message], speed: float, keep_time: bool, stop: threading.Event
) -> int:
    """Publish sensors and plots until the end or until ``stop`` is set; returns how many batches.

    Args:
        bus: where to.
        keys: of the realm.
        records: of a PLOTS.jsonl.
        speed: 2 is twice as fast as it happened; 0 as fast as possible.
        keep_time: keep the recorded times; otherwise the first plot is moved to now.
        stop: ends it.

    Raises:
        TrackmeshError: plots of a sensor come before it is described, or the speed is negative.
    """
    if speed < 0:
        raise TrackmeshError("The speed must not be negative.")
    sensors: dict[str, SensorPublisher] = {}
    sent = 0
    first_ns: int | None = None
    started_ns = 0
    for record in records:
        if stop.is_set():
            break
        if isinstance(record, SensorInfo):
            if record.sensor_id in sensors:
                sensors[record.sensor_id].announce(record)
            else:
                sensors[record.sensor_id] = SensorPublisher(bus, keys.realm, record, history=_KEPT)
        elif isinstance(record, PlotBatch):
            if record.sensor_id not in sensors:
                raise TrackmeshError(f"Plots of {record.sensor_id} come before its description.")
            if not started_ns:
                stop.wait(_SETTLE_S)
                started_ns = time.time_ns()
            if len(record.t_ns):
                first_ns = int(record.t_ns.min()) if first_ns is None else first_ns
                _wait(started_ns, int(record.t_ns.max()) - first_ns, speed, stop)
            shift_ns = 0 if keep_time or first_ns is None else started_ns - first_ns
            sensors[record.sensor_id].publish(
                record.t_ns + shift_ns,
                record.columns,
                record.values,
                variances=record.variances,
                labels=record.labels,
                scan=record.scan,
            )
            sent += 1
            if not speed:
                stop.wait(_GAP_S)
    # The network library sends in the background; what is last, or was lost on the way, must get out too.
    stop.wait(_FLUSH_S)
    for publisher in sensors.values():
        publisher.close()
    return sent


def _wait(started_ns: int, offset_ns: int, speed: float, stop: threading.Event) -> None:
    while speed and not stop.is_set():
        left_s = (started_ns + offset_ns / speed - time.time_ns()) / 1e9
        if left_s <= 0:
            return
        stop.wait(min(left_s, 1.0))
