"""The SDK, against servers that behave and servers that do not."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from tests.protocol.builders import emi_result, frame, scans, sensor_info

from trackmesh.protocol.bus import Query
from trackmesh.protocol.client import Client, Incomplete, SensorPublisher
from trackmesh.protocol.codec import answer, decode, encode, encoding, end, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage, Unavailable
from trackmesh.protocol.memory_bus import MemoryBus, MemoryHub
from trackmesh.protocol.messages import (
    EmiResult,
    EmiScanBatch,
    Envelope,
    HistoryQuery,
    PlotBatch,
    Registration,
    SensorInfo,
    ServiceStatus,
    TrackFrame,
    TrackQuery,
)
from trackmesh.protocol.serving import answers

Reply = tuple[bytes, str]
WRAPPED = encoding(Envelope)


@pytest.fixture
def bus() -> MemoryBus:
    return MemoryBus(MemoryHub())


@pytest.fixture
def client(bus: MemoryBus) -> Client:
    return Client(bus, "test")


def serve_tracks(bus: MemoryBus, client: Client, unit: str, refused: list[str] | None = None) -> None:
    bus.declare_alive(client.keys.live("fusion", unit))

    def handle(asked: TrackQuery) -> Iterator[TrackFrame]:
        yield frame(asked.track_ids or [1, 2, 3], unit=unit)

    count = refused if refused is not None else []
    bus.serve(client.keys.service("tracks", unit), lambda query: answers(query, TrackQuery, handle, count.append))


# --- watching


def test_frames_come_as_they_are_published(bus: MemoryBus, client: Client) -> None:
    watch = client.watch_tracks()
    publisher = bus.publisher(client.keys.tracks("main"))
    for seq in range(3):
        publisher.put(encode(frame([seq], seq=seq)), encoding(TrackFrame))
    assert [watch.receive(1.0) for _ in range(3)] == [frame([seq], seq=seq) for seq in range(3)]
    assert watch.receive(0.01) is None


def test_a_late_watcher_gets_the_last_frames(bus: MemoryBus, client: Client) -> None:
    publisher = bus.publisher(client.keys.tracks("main"), history=2)
    for seq in range(5):
        publisher.put(encode(frame(seq=seq)), encoding(TrackFrame))
    watch = client.watch_tracks()
    seen = [watch.receive(1.0), watch.receive(1.0)]
    assert [f.seq for f in seen if f] == [3, 4]


def test_bad_frames_are_counted_and_the_watch_goes_on(bus: MemoryBus, client: Client) -> None:
    watch = client.watch_tracks()
    publisher = bus.publisher(client.keys.tracks("main"))
    publisher.put(b"\xc1", encoding(TrackFrame))
    publisher.put(encode(frame()), encoding(PlotBatch))
    publisher.put(encode(frame(unit="other")), encoding(TrackFrame))
    publisher.put(encode(frame(seq=7)), encoding(TrackFrame))
    good = watch.receive(1.0)
    assert good is not None and good.seq == 7
    assert watch.refused == {"malformed": 1, "wrong_schema": 1, "wrong_key": 1}


def test_a_closed_watch_ends(client: Client) -> None:
    with client.watch_tracks() as watch:
        threading.Timer(0.05, watch.close).start()
        assert list(watch) == []


# --- asking for tracks


def test_every_unit_answers_with_its_frame(bus: MemoryBus, client: Client) -> None:
    serve_tracks(bus, client, "west")
    serve_tracks(bus, client, "east")
    assert client.query_tracks() == [frame([1, 2, 3], unit="east"), frame([1, 2, 3], unit="west")]
    assert client.query_tracks(TrackQuery(track_ids=[9]), "west") == [frame([9], unit="west")]


def test_nobody_there(client: Client) -> None:
    with pytest.raises(Unavailable, match="No fusion service is alive"):
        client.query_tracks()
    with pytest.raises(Unavailable, match="The fusion service west is not alive, nor is any other"):
        client.query_tracks(unit="west")


def test_the_one_asked_is_not_there(bus: MemoryBus, client: Client) -> None:
    serve_tracks(bus, client, "east")
    with pytest.raises(Unavailable, match="The fusion service west is not alive; alive: east"):
        client.query_tracks(unit="west")


def test_alive_but_silent(bus: MemoryBus, client: Client) -> None:
    bus.declare_alive(client.keys.live("fusion", "west"))
    bus.declare_alive(client.keys.live("fusion", "east"))
    with pytest.raises(Unavailable, match="services east, west are alive but did not answer within 2 s"):
        client.query_tracks()


def test_a_silent_unit_is_told_of(bus: MemoryBus, client: Client, caplog: pytest.LogCaptureFixture) -> None:
    serve_tracks(bus, client, "east")
    bus.declare_alive(client.keys.live("fusion", "west"))
    assert len(client.query_tracks()) == 1
    assert "the fusion service west is alive but did not answer" in caplog.text


def test_an_error_becomes_an_exception(bus: MemoryBus, client: Client) -> None:
    def handle(_asked: TrackQuery) -> Iterator[TrackFrame]:
        raise QueryFailed("no_origin", "The unit has no origin yet.")

    key = client.keys.service("tracks", "main")
    bus.serve(key, lambda query: answers(query, TrackQuery, handle, lambda _reason: None))
    with pytest.raises(QueryFailed, match="The unit has no origin yet") as failed:
        client.query_tracks()
    assert failed.value.code == "no_origin"


def test_history_is_streamed(bus: MemoryBus, client: Client) -> None:
    def handle(asked: HistoryQuery) -> Iterator[TrackFrame]:
        return (frame(t_ns=t) for t in range(asked.from_t_ns, asked.to_t_ns))

    key = client.keys.service("history", "a")
    bus.serve(key, lambda query: answers(query, HistoryQuery, handle, lambda _reason: None))
    times = [f.t_ns for f in client.history(HistoryQuery(from_t_ns=5, to_t_ns=9))]
    assert times == [5, 6, 7, 8]


# --- inverting


def serve_scans(bus: MemoryBus, client: Client, unit: str, stop_after: int | None = None, say_end: bool = True) -> None:
    bus.declare_alive(client.keys.live("emi", unit))

    def handler(query: Query) -> Iterator[Reply]:
        n = len(decode(query.payload, EmiScanBatch, query.encoding).field)
        for i in range(n if stop_after is None else stop_after):
            yield answer(emi_result(i)), WRAPPED
        if say_end:
            yield end(n), WRAPPED

    bus.serve(client.keys.service("emi", unit), handler)


def test_one_result_a_scan(bus: MemoryBus, client: Client) -> None:
    serve_scans(bus, client, "a")
    assert list(client.invert(scans(4))) == [emi_result(i) for i in range(4)]


def test_results_come_before_the_end(bus: MemoryBus, client: Client) -> None:
    go_on = threading.Event()

    def handle(_batch: EmiScanBatch) -> Iterator[EmiResult]:
        yield emi_result(0)
        go_on.wait(5.0)
        yield emi_result(1)

    key = client.keys.service("emi", "a")
    bus.serve(key, lambda query: answers(query, EmiScanBatch, handle, lambda _reason: None))
    results = client.invert(scans(2))
    assert next(results).index == 0
    go_on.set()
    assert [r.index for r in results] == [1]


@pytest.mark.parametrize(("sent", "say_end"), [(2, False), (0, True), (3, True)])
def test_a_stream_that_breaks_off_is_told_from_one_that_is_done(
    bus: MemoryBus, client: Client, sent: int, say_end: bool
) -> None:
    serve_scans(bus, client, "a", stop_after=sent, say_end=say_end)
    with pytest.raises(Incomplete, match=f"The emi service a ended half-way: {sent} of 5 answers") as broken:
        list(client.invert(scans(5)))
    assert broken.value.received == sent


def test_a_stream_that_takes_too_long(bus: MemoryBus, client: Client) -> None:
    release = threading.Event()

    def handle(_batch: EmiScanBatch) -> Iterator[EmiResult]:
        yield emi_result(0)
        release.wait(20.0)

    key = client.keys.service("emi", "a")
    bus.serve(key, lambda query: answers(query, EmiScanBatch, handle, lambda _reason: None))
    with pytest.raises(Incomplete, match=r"did not finish within 0\.1 s: 1 of 5 answers"):
        list(client.invert(scans(5), timeout_s=0.1))
    release.set()


# --- serving


def ask(
    bus: MemoryBus, client: Client, payload: bytes, kind: str = "", parameters: str = ""
) -> list[tuple[str, bytes]]:
    key = client.keys.service("tracks", "main")
    return [(s.encoding, s.payload) for s in bus.query(key, payload, kind, parameters=parameters)]


def test_an_empty_question_is_one_without_conditions(bus: MemoryBus, client: Client) -> None:
    serve_tracks(bus, client, "main")
    (kind, payload), _ = ask(bus, client, b"")
    assert open_envelope(payload, kind, TrackFrame) == frame([1, 2, 3])


def test_json_is_answered_where_asked_for(bus: MemoryBus, client: Client) -> None:
    serve_tracks(bus, client, "main")
    replies = ask(bus, client, b'{"track_ids": [5]}', "application/json", "fmt=json")
    assert {kind for kind, _ in replies} == {"application/json;trackmesh.Envelope.v1"}
    assert open_envelope(replies[0][1], replies[0][0], TrackFrame) == frame([5])
    assert open_envelope(replies[1][1], replies[1][0], TrackFrame) == 1


@pytest.mark.parametrize(
    ("payload", "kind", "reason"),
    [
        (b"\xc1", "", "malformed"),
        (b"{}", encoding(TrackQuery), "malformed"),
        (encode(TrackQuery()), encoding(PlotBatch), "wrong_schema"),
        (b'{"colour": 1}', "application/json", "unknown_field"),
    ],
)
def test_a_wrong_question_is_refused_counted_and_answered(
    bus: MemoryBus, client: Client, payload: bytes, kind: str, reason: str
) -> None:
    refused: list[str] = []
    serve_tracks(bus, client, "main", refused)
    (first, last) = ask(bus, client, payload, kind)
    with pytest.raises(QueryFailed) as failed:
        open_envelope(first[1], first[0], TrackFrame)
    assert open_envelope(last[1], last[0], TrackFrame) == 0
    assert failed.value.code == reason
    assert refused == [reason]


def test_a_question_too_large_is_refused(bus: MemoryBus) -> None:
    refused: list[str] = []
    query = Query("k", {}, encode(TrackQuery(track_ids=list(range(1000)))), encoding(TrackQuery))
    list(answers(query, TrackQuery, lambda _asked: [], refused.append, max_bytes=1000))
    assert refused == ["too_large"]


# --- sensors


def test_a_sensor_is_alive_says_who_it_is_and_publishes(bus: MemoryBus, client: Client) -> None:
    plots, infos = bus.subscribe(client.keys.plots("*")), bus.subscribe(client.keys.sensor("*"), history=True)
    with SensorPublisher(bus, "test", sensor_info()) as sensor:
        assert client.alive() == [("sensor", "north")]
        assert client.sensors() == [sensor_info()]
        for i in range(2):
            sensor.publish([i], ["range_m", "azimuth_rad"], [[1000.0, 0.5]])
        empty = sensor.publish([], ["range_m", "azimuth_rad"], [])
    assert empty.values.shape == (0, 2)
    samples = [plots.receive(1.0) for _ in range(3)]
    batches = [decode(s.payload, PlotBatch, s.encoding) for s in samples if s]
    assert [(b.sensor_id, b.boot_id, b.seq) for b in batches] == [("north", sensor.boot_id, i) for i in range(3)]
    info = infos.receive(1.0)
    assert info is not None and decode(info.payload, SensorInfo, info.encoding) == sensor_info()
    assert client.alive() == [] and client.sensors() == []


def test_each_start_of_a_sensor_has_its_own_boot_id(bus: MemoryBus) -> None:
    first, second = (SensorPublisher(bus, "test", sensor_info(name)) for name in ("a", "b"))
    assert first.boot_id != second.boot_id


def test_wrong_plots_are_refused_and_take_no_number(bus: MemoryBus) -> None:
    with SensorPublisher(bus, "test", sensor_info()) as sensor:
        with pytest.raises(RefusedMessage, match="not a finite number"):
            sensor.publish([1], ["range_m", "azimuth_rad"], [[np.nan, 0.5]])
        assert sensor.publish([1], ["range_m", "azimuth_rad"], [[1.0, 0.5]]).seq == 0


def test_a_changed_sensor_announces_itself(bus: MemoryBus, client: Client) -> None:
    with SensorPublisher(bus, "test", sensor_info()) as sensor:
        sensor.announce(sensor_info(period_s=8.0))
        assert [info.period_s for info in client.sensors()] == [8.0]


# --- statuses


def status(kind: str, unit: str) -> ServiceStatus:
    return ServiceStatus(kind=kind, unit_id=unit, boot_id="b", seq=0, t_ns=0, state="ready", uptime_s=1.0)


def test_statuses_of_those_alive(bus: MemoryBus, client: Client) -> None:
    for kind, unit in (("fusion", "west"), ("emi", "a"), ("gone", "long")):
        publisher = bus.publisher(client.keys.status(kind, unit), history=1)
        publisher.put(encode(status(kind, unit)), encoding(ServiceStatus))
    for kind, unit in (("fusion", "west"), ("emi", "a"), ("sensor", "north")):
        bus.declare_alive(client.keys.live(kind, unit))
    assert client.statuses() == [status("emi", "a"), status("fusion", "west")]


def test_registrations_of_units_that_are_alive(bus: MemoryBus, client: Client) -> None:
    told = [Registration(unit_id=unit, boot_id="b", seq=0, t_ns=0, sensors=[]) for unit in ("east", "gone", "west")]
    for one in told:
        bus.publisher(client.keys.registration(one.unit_id), history=1).put(encode(one), encoding(one))
    for unit in ("west", "east", "mute"):
        bus.declare_alive(client.keys.live("fusion", unit))
    assert client.registrations(timeout_s=0.05) == [told[0], told[2]]


def test_a_service_without_status_does_not_hold_up_the_others(bus: MemoryBus, client: Client) -> None:
    bus.declare_alive(client.keys.live("fusion", "mute"))
    assert client.statuses(timeout_s=0.05) == []
