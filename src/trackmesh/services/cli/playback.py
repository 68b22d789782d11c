"""Publishing a recording with the rhythm in which it was made."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable

from trackmesh.protocol.bus import Bus, Closeable
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import Message, PlotBatch, RangeBatch, SensorInfo
from trackmesh.protocol.ranging import RangePublisher
from trackmesh.protocol.sensor import Presence, SensorPublisher

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
    """Publish sensors, plots and ranges until the end or until ``stop`` is set; returns how many batches.

    Args:
        bus: where to.
        keys: of the realm.
        records: of a PLOTS.jsonl or RANGES.jsonl.
        speed: 2 is twice as fast as it happened; 0 as fast as possible.
        keep_time: keep the recorded times; otherwise the first measurement is moved to now.
        stop: ends it.

    Raises:
        TrackmeshError: plots of a sensor come before it is described, or the speed is negative.
    """
    if speed < 0:
        raise TrackmeshError("The speed must not be negative.")
    stage, sent = _Stage(bus, keys), 0
    first_ns: int | None = None
    started_ns = 0
    for record in records:
        if stop.is_set():
            break
        if isinstance(record, SensorInfo):
            stage.announce(record)
        elif isinstance(record, PlotBatch | RangeBatch):
            stage.check(record)
            if not started_ns:
                stop.wait(_SETTLE_S)
                started_ns = time.time_ns()
            if len(record.t_ns):
                first_ns = int(record.t_ns.min()) if first_ns is None else first_ns
                _wait(started_ns, int(record.t_ns.max()) - first_ns, speed, stop)
            stage.publish(record, 0 if keep_time or first_ns is None else started_ns - first_ns)
            sent += 1
            if not speed:
                stop.wait(_GAP_S)
    # The network library sends in the background; what is last, or was lost on the way, must get out too.
    stop.wait(_FLUSH_S)
    stage.close()
    return sent


class _Stage:
    """The publishers of a recording: sensors, readers of tags, and the networks that tell their ranges."""

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._bus = bus
        self._keys = keys
        self._sensors: dict[str, SensorPublisher] = {}
        self._readers: dict[str, Presence] = {}
        self._networks: dict[str, RangePublisher] = {}

    def announce(self, info: SensorInfo) -> None:
        """Say who a sensor is, or who it is now."""
        known = self._readers.get(info.sensor_id) or self._sensors.get(info.sensor_id)
        if known is not None:
            known.announce(info)
        elif info.kind == "ranging":
            self._readers[info.sensor_id] = Presence(self._bus, self._keys, info)
        else:
            self._sensors[info.sensor_id] = SensorPublisher(self._bus, self._keys.realm, info, history=_KEPT)

    def check(self, batch: PlotBatch | RangeBatch) -> None:
        """Open what a batch needs.

        Raises:
            TrackmeshError: it is of a sensor that was not described.
        """
        if isinstance(batch, PlotBatch):
            if batch.sensor_id not in self._sensors:
                raise TrackmeshError(f"Plots of {batch.sensor_id} come before its description.")
        elif batch.network_id not in self._networks:
            network = RangePublisher(self._bus, self._keys.realm, batch.network_id, history=_KEPT)
            self._networks[batch.network_id] = network

    def publish(self, batch: PlotBatch | RangeBatch, shift_ns: int) -> None:
        """Publish a batch, its times moved."""
        if isinstance(batch, PlotBatch):
            self._sensors[batch.sensor_id].publish(
                batch.t_ns + shift_ns,
                batch.columns,
                batch.values,
                variances=batch.variances,
                labels=batch.labels,
                scan=batch.scan,
                site=batch.site,
                site_enu_m=batch.site_enu_m,
                site_velocity_enu_mps=batch.site_velocity_enu_mps,
            )
        else:
            self._networks[batch.network_id].publish(
                batch.t_ns + shift_ns,
                batch.tags,
                batch.readers,
                batch.tag,
                batch.reader,
                range_m=batch.range_m,
                variance_m2=batch.variance_m2,
                rssi_dbm=batch.rssi_dbm,
            )

    def close(self) -> None:
        """Be there no longer."""
        publishers: list[Closeable] = [*self._sensors.values(), *self._networks.values(), *self._readers.values()]
        for publisher in publishers:
            publisher.close()


def _wait(started_ns: int, offset_ns: int, speed: float, stop: threading.Event) -> None:
    while speed and not stop.is_set():
        left_s = (started_ns + offset_ns / speed - time.time_ns()) / 1e9
        if left_s <= 0:
            return
        stop.wait(min(left_s, 1.0))
