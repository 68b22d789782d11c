"""The side of a network of readers: who they are, that they are alive, and the ranges they measure."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Iterable, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from trackmesh.protocol.bus import Bus
from trackmesh.protocol.codec import encode, encoding, refusal
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import RangeBatch, SensorInfo
from trackmesh.protocol.sensor import Presence

KEPT = 64
"""How many batches are kept to fill the gaps of an outage."""


class RangePublisher:
    """A network of readers on the bus: a gateway that speaks for them, or one reader by itself.

    Args:
        bus: a way into the network; it is not closed.
        realm: the deployment's key space.
        network_id: names the stream of ranges.
        readers: those that stand here; others may join, move and leave later. None at all where the tag service has
            their places from a file.
        history: how many batches are kept to fill the gaps of an outage.
        boot_id: tells this start from others; drawn anew if not given.
    """

    def __init__(
        self,
        bus: Bus,
        realm: str,
        network_id: str,
        readers: Iterable[SensorInfo] = (),
        *,
        history: int = KEPT,
        boot_id: str | None = None,
    ) -> None:
        self.network_id = network_id
        self.boot_id = boot_id or uuid.uuid4().hex[:16]
        self._bus = bus
        self._keys = Keys(realm)
        self._seq = 0
        self._lock = threading.Lock()
        self._readers: dict[str, Presence] = {}
        self._ranges = bus.publisher(self._keys.ranges(network_id), history=history)
        for info in readers:
            self.announce(info)

    def announce(self, info: SensorInfo) -> None:
        """A reader stands here now: a new one, or one that has moved.

        Raises:
            RefusedMessage: ``invalid``, it is no reader.
        """
        if info.kind != "ranging":
            raise RefusedMessage("invalid", f"{info.sensor_id} is a {info.kind}, not a reader of tags.")
        known = self._readers.get(info.sensor_id)
        if known is None:
            self._readers[info.sensor_id] = Presence(self._bus, self._keys, info)
        else:
            known.announce(info)

    def withdraw(self, reader_id: str) -> None:
        """A reader is there no longer."""
        self._readers.pop(reader_id).close()

    def publish(
        self,
        t_ns: npt.ArrayLike,
        tags: Sequence[str],
        readers: Sequence[str],
        tag: npt.ArrayLike,
        reader: npt.ArrayLike,
        *,
        range_m: npt.ArrayLike | None = None,
        variance_m2: npt.ArrayLike | None = None,
        rssi_dbm: npt.ArrayLike | None = None,
    ) -> RangeBatch:
        """Publish ranges or signal strengths; the batch as published.

        Raises:
            RefusedMessage: they are no valid ``RangeBatch``.
        """
        with self._lock:
            try:
                batch = RangeBatch(
                    network_id=self.network_id,
                    boot_id=self.boot_id,
                    seq=self._seq,
                    t_ns=np.asarray(t_ns, np.int64),
                    tags=list(tags),
                    readers=list(readers),
                    tag=np.asarray(tag, np.uint32),
                    reader=np.asarray(reader, np.uint32),
                    range_m=None if range_m is None else np.asarray(range_m, np.float64),
                    variance_m2=None if variance_m2 is None else np.asarray(variance_m2, np.float64),
                    rssi_dbm=None if rssi_dbm is None else np.asarray(rssi_dbm, np.float64),
                )
            except ValidationError as error:
                raise refusal("RangeBatch", error) from None
            self._put(batch)
        return batch

    def publish_batch(self, batch: RangeBatch) -> None:
        """Publish a batch that was made elsewhere, with the numbering of its maker.

        Raises:
            RefusedMessage: ``wrong_sensor``, the batch is of another network.
        """
        if batch.network_id != self.network_id:
            detail = f"The network {self.network_id} cannot publish ranges of {batch.network_id}."
            raise RefusedMessage("wrong_sensor", detail)
        with self._lock:
            self._put(batch)

    def _put(self, batch: RangeBatch) -> None:
        self._seq = batch.seq + 1
        self._ranges.put(encode(batch), encoding(batch))

    def close(self) -> None:
        """Be there no longer, with all readers."""
        for presence in self._readers.values():
            presence.close()
        self._readers.clear()
        self._ranges.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
