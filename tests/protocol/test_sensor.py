"""A sensor that publishes batches made elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from trackmesh.protocol.codec import decode
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.memory_bus import MemoryBus
from trackmesh.protocol.messages import PlotBatch, SensorInfo
from trackmesh.protocol.sensor import PLOT_HISTORY_S, SensorPublisher, plot_history

INFO = SensorInfo(
    sensor_id="north", kind="radar", site_enu_m=[0.0, 0.0, 0.0], period_s=0.5, p_detect=0.9, max_range_m=1e5,
    sigma={"range_m": 50.0, "azimuth_rad": 1e-3},
)  # fmt: skip


def batch(seq: int, sensor_id: str = "north") -> PlotBatch:
    return PlotBatch(
        sensor_id=sensor_id,
        boot_id="b",
        seq=seq,
        t_ns=np.array([seq]),
        columns=["range_m", "azimuth_rad"],
        values=np.array([[1000.0, 0.5]]),
    )


def test_a_batch_made_elsewhere_keeps_its_number_and_others_go_on_from_it() -> None:
    with MemoryBus() as bus, SensorPublisher(bus, "test", INFO, boot_id="b") as sensor:
        plots = bus.subscribe(Keys("test").plots("*"))
        sensor.publish_batch(batch(7))
        sensor.publish([8], ["range_m", "azimuth_rad"], [[1000.0, 0.5]])
        samples = [plots.receive(1.0) for _ in range(2)]
    received = [decode(s.payload, PlotBatch, s.encoding) for s in samples if s]
    assert received[0] == batch(7)
    assert [(b.boot_id, b.seq) for b in received] == [("b", 7), ("b", 8)]


def test_a_sensor_that_moves_says_where_it_stood() -> None:
    with MemoryBus() as bus, SensorPublisher(bus, "test", INFO) as sensor:
        plots = bus.subscribe(Keys("test").plots("*"))
        sent = sensor.publish(
            [8], ["range_m", "azimuth_rad"], [[1000.0, 0.5]], site_enu_m=(1.0, 2.0, 3.0),
            site_velocity_enu_mps=(8.0, 0.0, 0.0),
        )  # fmt: skip
        received = plots.receive(1.0)
    assert received is not None
    assert decode(received.payload, PlotBatch, received.encoding) == sent
    assert (sent.site_enu_m, sent.site_velocity_enu_mps) == ([1.0, 2.0, 3.0], [8.0, 0.0, 0.0])


def test_a_batch_of_another_sensor_is_refused() -> None:
    refused = pytest.raises(RefusedMessage, match="cannot publish plots of east")
    with MemoryBus() as bus, SensorPublisher(bus, "test", INFO) as sensor, refused:
        sensor.publish_batch(batch(0, "east"))


def test_a_sensor_keeps_what_an_outage_withholds_and_no_more() -> None:
    assert plot_history(8.0) == PLOT_HISTORY_S * 8
    assert plot_history(0.01) < plot_history(1e9) < 10_000
    with MemoryBus() as bus, SensorPublisher(bus, "test", INFO) as sensor:
        for seq in range(100):
            sensor.publish_batch(batch(seq))
        late = bus.subscribe(Keys("test").plots("*"), history=True)
        kept = list(iter(lambda: late.receive(0.0), None))
    assert len(kept) == plot_history(1.0 / INFO.period_s) == 20


def test_who_hears_of_a_sensor_can_already_know_it() -> None:
    with MemoryBus() as bus:
        infos, tokens = bus.subscribe(Keys("test").sensor("*")), bus.watch_alive(Keys("test").live("sensor", "*"))
        with SensorPublisher(bus, "test", INFO):
            assert tokens.receive(1.0) is not None
            assert infos.receive(0.0) is not None
