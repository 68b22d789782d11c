"""A network of readers: it tells who its readers are, and what they measure."""

from __future__ import annotations

import numpy as np
import pytest

from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.memory_bus import MemoryBus
from trackmesh.protocol.messages import RangeBatch, SensorInfo
from trackmesh.protocol.ranging import RangePublisher

KEYS = Keys("test")


def reader(name: str, east: float = 0.0, kind: str = "ranging") -> SensorInfo:
    return SensorInfo.model_validate(
        {"sensor_id": name, "kind": kind, "site_enu_m": [east, 0.0, 0.0], "period_s": 1.0, "p_detect": 1.0,
         "max_range_m": 30.0, "sigma": {}}
    )  # fmt: skip


def test_readers_are_there_with_their_network_and_may_move_and_leave() -> None:
    with MemoryBus() as bus:
        client = Client(bus, "test")
        with RangePublisher(bus, "test", "hall", [reader("a"), reader("b")]) as network:
            assert [info.sensor_id for info in client.sensors()] == ["a", "b"]
            assert client.alive("sensor") == [("sensor", "a"), ("sensor", "b")]
            network.announce(reader("a", 7.0))
            assert client.sensors("a")[0].site_enu_m == [7.0, 0.0, 0.0]
            network.withdraw("b")
            assert client.alive("sensor") == [("sensor", "a")]
        assert client.alive("sensor") == [] and client.sensors() == []


def test_ranges_are_numbered() -> None:
    with MemoryBus() as bus, RangePublisher(bus, "test", "hall", boot_id="b") as network:
        heard = bus.subscribe(KEYS.ranges("*"))
        for k in range(3):
            network.publish([k], ["t"], ["a"], [0], [0], range_m=[5.0 + k])
        network.publish([9], ["t"], ["a"], [0], [0], rssi_dbm=[-60.0])
        samples = [heard.receive(1.0) for _ in range(4)]
    batches = [decode(s.payload, RangeBatch, s.encoding) for s in samples if s]
    assert [(b.network_id, b.boot_id, b.seq) for b in batches] == [("hall", "b", k) for k in range(4)]
    assert batches[1].range_m is not None and batches[1].range_m.tolist() == [6.0]
    assert batches[3].range_m is None and batches[3].rssi_dbm is not None


def test_a_batch_made_elsewhere_keeps_its_number() -> None:
    with MemoryBus() as bus, RangePublisher(bus, "test", "hall", boot_id="b") as network:
        made = network.publish([1], ["t"], ["a"], [0], [0], range_m=[5.0])
        network.publish_batch(made.model_copy(update={"seq": 7}))
        assert network.publish([1], ["t"], ["a"], [0], [0], range_m=[5.0]).seq == 8
        with pytest.raises(RefusedMessage, match="cannot publish ranges of yard"):
            network.publish_batch(made.model_copy(update={"network_id": "yard"}))


def test_what_is_no_batch_is_refused_before_it_is_sent() -> None:
    with MemoryBus() as bus, RangePublisher(bus, "test", "hall") as network:
        with pytest.raises(RefusedMessage, match="give range_m or rssi_dbm"):
            network.publish([1], ["t"], ["a"], [0], [0])
        with pytest.raises(RefusedMessage, match="beyond tags or readers"):
            network.publish([1], ["t"], ["a"], [1], [0], range_m=np.ones(1))
        with pytest.raises(RefusedMessage, match="not a reader"):
            network.announce(reader("north", kind="radar"))


def test_who_comes_late_hears_what_was_kept() -> None:
    with MemoryBus() as bus, RangePublisher(bus, "test", "hall", history=2) as network:
        for k in range(5):
            network.publish([k], ["t"], ["a"], [0], [0], range_m=[1.0])
        late = bus.subscribe(KEYS.ranges("*"), history=True)
        assert len(list(iter(lambda: late.receive(0.0), None))) == 2
