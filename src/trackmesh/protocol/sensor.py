"""The sensor's side: who it is, that it is alive, and its plots."""

from __future__ import annotations

import math
import threading
import uuid
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from trackmesh.protocol.arrays import IntArray
from trackmesh.protocol.bus import Bus, Query
from trackmesh.protocol.codec import answer, encode, encoding, end, refusal
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import Envelope, Geodetic, PlotBatch, ScanPart, SensorInfo
from trackmesh.protocol.serving import asked_format

PLOT_HISTORY_S = 10.0
"""What an outage of this length withheld is sent afterwards; older plots are of no use to a tracker."""

_LEAST_HISTORY = 16
_MOST_HISTORY = 4096


def plot_history(batches_per_s: float) -> int:
    """How many batches a sensor must keep to lose none in an outage of ``PLOT_HISTORY_S``."""
    return min(max(math.ceil(PLOT_HISTORY_S * batches_per_s), _LEAST_HISTORY), _MOST_HISTORY)


class Presence:
    """That a sensor is there: who it is, published and told to whoever asks, and that it is alive.

    Args:
        bus: a way into the network; it is not closed.
        keys: of the realm.
        info: who the sensor is.
    """

    def __init__(self, bus: Bus, keys: Keys, info: SensorInfo) -> None:
        self.info = info
        self._publisher = bus.publisher(keys.sensor(info.sensor_id), history=1)
        self._server = bus.serve(keys.sensor(info.sensor_id), self._who, workers=1)
        # First who it is, then that it is there: who hears of it can already know it.
        self.announce(info)
        self._token = bus.declare_alive(keys.live("sensor", info.sensor_id))

    def announce(self, info: SensorInfo) -> None:
        """Publish who the sensor is, when it has changed."""
        self.info = info
        self._publisher.put(encode(info), encoding(info))

    def close(self) -> None:
        """Be there no longer."""
        for declared in (self._token, self._server, self._publisher):
            declared.close()

    def _who(self, query: Query) -> Iterator[tuple[bytes, str]]:
        fmt = asked_format(query)
        yield answer(self.info, fmt), encoding(Envelope, fmt)
        yield end(1, fmt), encoding(Envelope, fmt)


class SensorPublisher:
    """A sensor on the bus: it is alive, publishes and answers who it is, and publishes its plots.

    Args:
        bus: a way into the network; it is not closed.
        realm: the deployment's key space.
        info: who the sensor is.
        history: how many batches are kept to fill the gaps of an outage, 0 for none; None counts one batch a period of
            the sensor (a sensor that sends sectors says ``plot_history(sectors / period_s)``).
        boot_id: tells this start of the sensor from others; drawn anew if not given.
    """

    def __init__(
        self, bus: Bus, realm: str, info: SensorInfo, *, history: int | None = None, boot_id: str | None = None
    ) -> None:
        keys = Keys(realm)
        self.boot_id = boot_id or uuid.uuid4().hex[:16]
        self._seq = 0
        self._lock = threading.Lock()
        kept = plot_history(1.0 / info.period_s) if history is None else history
        self._plots = bus.publisher(keys.plots(info.sensor_id), history=kept)
        self._presence = Presence(bus, keys, info)

    @property
    def info(self) -> SensorInfo:
        """Who the sensor is."""
        return self._presence.info

    def announce(self, info: SensorInfo) -> None:
        """Publish who the sensor is, when it has changed."""
        self._presence.announce(info)

    def publish(
        self,
        t_ns: IntArray | Sequence[int],
        columns: Sequence[str],
        values: npt.ArrayLike,
        *,
        variances: npt.ArrayLike | None = None,
        labels: Sequence[str] | None = None,
        scan: ScanPart | None = None,
        site: Geodetic | None = None,
        site_enu_m: Sequence[float] | None = None,
        site_velocity_enu_mps: Sequence[float] | None = None,
    ) -> PlotBatch:
        """Publish the plots of a scan or sector, also when there are none; the batch as published.

        A sensor that moves says where it stood, ``site`` or ``site_enu_m``, and if it measures range rates how it
        moved.

        Raises:
            RefusedMessage: the plots are no valid ``PlotBatch``.
        """
        table = np.asarray(values, np.float64)
        with self._lock:
            try:
                batch = PlotBatch(
                    sensor_id=self.info.sensor_id,
                    boot_id=self.boot_id,
                    seq=self._seq,
                    t_ns=np.asarray(t_ns, np.int64),
                    columns=list(columns),
                    values=table if table.size else table.reshape(0, len(columns)),
                    variances=None if variances is None else np.asarray(variances, np.float64),
                    labels=None if labels is None else list(labels),
                    scan=scan,
                    site=site,
                    site_enu_m=None if site_enu_m is None else list(site_enu_m),
                    site_velocity_enu_mps=None if site_velocity_enu_mps is None else list(site_velocity_enu_mps),
                )
            except ValidationError as error:
                raise refusal("PlotBatch", error) from None
            self._put(batch)
        return batch

    def publish_batch(self, batch: PlotBatch) -> None:
        """Publish a batch that was made elsewhere, with the numbering of its maker.

        Raises:
            RefusedMessage: ``wrong_sensor``, the batch is of another sensor.
        """
        if batch.sensor_id != self.info.sensor_id:
            detail = f"Sensor {self.info.sensor_id} cannot publish plots of {batch.sensor_id}."
            raise RefusedMessage("wrong_sensor", detail)
        with self._lock:
            self._put(batch)

    def _put(self, batch: PlotBatch) -> None:
        self._seq = batch.seq + 1
        self._plots.put(encode(batch), encoding(batch))

    def close(self) -> None:
        """Be alive no longer."""
        self._presence.close()
        self._plots.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
