"""A running fusion service under ten thousand broken messages: it goes on, counts all, and tracks as without them."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import msgpack
import numpy as np
import pytest
from tests.network.processes import wait_until
from tests.protocol.test_fuzz import ODD, REASONS, broken, transplanted
from tests.services.fusion.running import KEYS, PLOTS, Running, plot_batch, radar

from trackmesh.protocol.codec import decode, encode, encoding, open_envelope
from trackmesh.protocol.errors import QueryFailed, RefusedMessage
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame, TrackQuery
from trackmesh.protocol.messages.plots import COLUMN_BOUNDS, LARGEST_SIGMA

BROKEN = 10_000
LOOKS = 50
PERIOD_NS = 2_000_000_000
BEGIN_NS = 1_700_000_000 * 1_000_000_000
INTAKE = {"duplicate_seq", "out_of_order_seq", "wrong_sensor"}
EXTREME = [0.0, -1.0, 1e9, -1e9, 1e18, 1e300, -1e300, 5e-324, np.nan, np.inf, -np.inf]


def good_traffic() -> list[PlotBatch]:
    """Looks of a radar at four targets on straight lines."""
    rng = np.random.default_rng(3)
    starts = rng.uniform(-3e4, 3e4, (4, 2))
    speeds = rng.uniform(-200.0, 200.0, (4, 2))
    batches = []
    for k in range(LOOKS):
        place = starts + speeds * (k * PERIOD_NS * 1e-9)
        polar = np.stack([np.hypot(*place.T), np.arctan2(place[:, 0], place[:, 1])], axis=1)
        seen = polar + rng.normal(size=(4, 2)) * [20.0, 1e-3]
        batches.append(plot_batch("north", k, BEGIN_NS + k * PERIOD_NS, seen.tolist()))
    return batches


# --- the mutations: each takes a batch that was already accepted


def changed(batch: PlotBatch, **change: Any) -> bytes:
    return bytes(msgpack.packb(batch.model_dump() | change))


def other_seq(batch: PlotBatch, rng: random.Random) -> bytes:
    return changed(batch, seq=rng.choice([0, batch.seq, max(0, batch.seq - 1), -1, 2**64 - 1, True, 1.0, None, "1"]))


def other_sensor(batch: PlotBatch, rng: random.Random) -> bytes:
    return changed(batch, sensor_id=rng.choice(["east", "ghost", "North", "*", "", "a/b", 7, None]))


def other_columns(batch: PlotBatch, rng: random.Random) -> bytes:
    names = ["range_m", "azimuth_rad", "elevation_rad", "east_m", "speed", "", "range_m"]
    return changed(batch, columns=rng.sample(names, rng.randint(0, 5)))


def extreme_numbers(batch: PlotBatch, rng: random.Random) -> bytes:
    values = batch.values.copy()
    values[rng.randrange(len(values)), rng.randrange(2)] = rng.choice(EXTREME)
    times = batch.t_ns.copy()
    times[0] = rng.choice([-1, 0, 2**63 - 1, -(2**63), times[0]])
    return changed(
        batch,
        values={"dtype": "<f8", "shape": list(values.shape), "data": values.tobytes()},
        t_ns={"dtype": "<i8", "shape": list(times.shape), "data": times.tobytes()},
    )


def other_shape(batch: PlotBatch, rng: random.Random) -> bytes:
    field = rng.choice(["values", "t_ns"])
    array = batch.model_dump()[field]
    change = rng.choice(
        [
            {"dtype": rng.choice(["<f4", ">f8", "<i8", "<f8", "O", "", None])},
            {"shape": rng.choice([[], [4], [2, 4], [4, 2, 1], [-4, -2], [2**31 - 1, 2], [True, 2], "42", None])},
            {"data": rng.choice([b"", array["data"][:-1], array["data"] * 2, "text", None])},
        ]
    )
    return changed(batch, **{field: array | change})


def odd_field(batch: PlotBatch, rng: random.Random) -> bytes:
    return changed(batch, **{rng.choice([*PlotBatch.model_fields, "more"]): rng.choice(ODD)})


MUTATIONS = [
    lambda batch, rng: broken(encode(batch), rng),
    lambda batch, rng: encode(batch)[: rng.randrange(len(encode(batch)))],
    lambda batch, rng: bytes(msgpack.packb(transplanted(batch.model_dump(), rng))),
    lambda batch, rng: rng.randbytes(rng.randint(0, 300)),
    other_seq, other_sensor, other_columns, extreme_numbers, other_shape, odd_field,
]  # fmt: skip


def is_legal(data: bytes, kind: str, last: PlotBatch) -> bool:
    """Whether a broken message is by chance one that a sensor may send now: then it is data, and no error."""
    try:
        batch = decode(data, PlotBatch, kind)
    except RefusedMessage:
        return False
    return batch.sensor_id == "north" and (batch.boot_id != last.boot_id or batch.seq > last.seq)


def send_broken(service: Running, accepted: list[PlotBatch], rng: random.Random) -> None:
    batch, mutate = rng.choice(accepted), rng.choice(MUTATIONS)
    data = mutate(batch, rng)
    kind = rng.choice([PLOTS] * 8 + ["", "application/json", encoding(TrackFrame)])
    # A key of a sensor that is unknown: there the batches of north are somebody else's.
    key = "north" if rng.random() < 0.9 else "east"
    if key == "north" and is_legal(data, kind, accepted[-1]):
        return
    if key == "east" and b"east" in data:
        return
    service.plots(key, data, kind)


def run(broken_messages: int) -> tuple[list[TrackFrame], Counter[str]]:
    """The frames of the good traffic, with so many broken messages in between; and the refusals."""
    rng, accepted = random.Random(7), list[PlotBatch]()
    with Running("data") as service:
        service.sensor(radar("north"))
        for batch in good_traffic():
            service.plots("north", batch)
            accepted.append(batch)
            before = service.sent
            while service.sent < before + broken_messages // LOOKS:
                send_broken(service, accepted, rng)
            service.settle()
        assert service.accepted == LOOKS
        assert service.accepted + sum(service.refused.values()) == service.sent == LOOKS + broken_messages
        status = service.status()
        assert status.refused == service.refused
        (north,) = [sensor for sensor in status.sensors if sensor.sensor_id == "north"]
        assert (north.batches, north.gaps) == (LOOKS, 0)
        assert len(service.client.query_tracks(TrackQuery())) == 1
        frames = list(iter(lambda: service.frames.receive(0.0), None))
    return frames, Counter(service.refused)


def test_broken_messages_are_counted_and_change_no_track() -> None:
    alone, none_refused = run(0)
    frames, refused = run(BROKEN)
    assert not none_refused
    assert len(frames) == len(alone) == LOOKS
    assert len(alone[-1].track_id) == 4
    for with_broken, without in zip(frames, alone, strict=True):
        assert nameless(with_broken) == nameless(without)
    assert set(refused) <= REASONS | INTAKE
    # The mutations reach every reason but that of size, each many times.
    assert set(refused) == (REASONS | INTAKE) - {"too_large"}
    assert min(refused.values()) > 10


def nameless(frame: TrackFrame) -> TrackFrame:
    """The frame without what differs between two services: boot id, and the number its track ids begin at."""
    first = frame.track_id.min() if len(frame.track_id) else 0
    return frame.model_copy(update={"boot_id": "", "track_id": frame.track_id - first})


def test_broken_sensors_change_nothing() -> None:
    rng, info = random.Random(11), radar("north")
    sent = 0
    with Running("data") as service:
        service.sensor(info)
        while sent < 500:
            data = (
                broken(encode(info), rng) if rng.random() < 0.5 else msgpack.packb(transplanted(info.model_dump(), rng))
            )
            try:
                decode(data, SensorInfo)
            except RefusedMessage:
                service.put(KEYS.sensor("north"), data, encoding(SensorInfo))
                sent += 1
                if sent % 100 == 0:
                    wait_until(lambda: sum(service.refused.values()) == sent, "they are judged")  # noqa: B023
        service.plots("north", good_traffic()[0])
        service.sent += sent
        service.settle()
        assert (service.accepted, sum(service.refused.values())) == (1, sent)
        assert service.service.engine.sensors["north"].info == info


WILD = [
    ["range_m", "azimuth_rad"],
    ["east_m", "north_m"],
    ["range_m", "azimuth_rad", "elevation_rad", "range_rate_mps"],
]


def wild_batch(k: int, rng: np.random.Generator) -> PlotBatch:
    """Plots within the bounds of the protocol, many at its edges."""
    n, columns = int(rng.integers(0, 6)), WILD[k % 3]
    low, high = np.array([COLUMN_BOUNDS[name] for name in columns]).T
    shape = (n, len(columns))
    values = np.where(rng.random(shape) < 0.3, rng.choice([low[0], high[0], 0.0]), rng.uniform(low, high, shape))
    most = np.array([LARGEST_SIGMA.get(name, 1e9) ** 2 for name in columns])
    return PlotBatch(
        sensor_id="wild",
        boot_id="boot",
        seq=k,
        t_ns=BEGIN_NS + k * PERIOD_NS // 4 - rng.integers(0, 20 * 10**9, n),
        columns=columns,
        values=np.clip(values, low, high),
        variances=np.minimum(10.0 ** rng.uniform(-18, 18, shape), most),
    )


@pytest.mark.parametrize("lag", [0, 2])
def test_the_most_extreme_legal_plots_leave_every_frame_readable(lag: int) -> None:
    rng = np.random.default_rng(17)
    usual = good_traffic()
    with Running("data", engine={"lag": lag}) as service:
        looking_back = service.client.watch_refined(capacity=100_000)
        service.sensor(radar("north"))
        service.sensor(radar("wild"))
        for k in range(200):
            service.plots("wild", wild_batch(k, rng))
            if k % 4 == 0:
                service.plots("north", usual[k // 4])
            service.settle()
            far = TrackQuery(at_t_ns=int(rng.choice([0, BEGIN_NS + 10**15, 2**62, 2**63 - 1])), status=[0, 1, 2])
            service.client.query_tracks(far)
        frames = list(iter(lambda: service.frames.receive(0.0), None))
        refined = list(iter(lambda: looking_back.receive(0.0), None))
    assert not service.refused
    assert not service.frames.refused
    assert not looking_back.refused
    assert len(frames) >= 250
    assert (len(refined) > 20) == bool(lag)


@pytest.mark.parametrize("fmt", ["", "fmt=json"])
def test_broken_questions_are_answered(fmt: str) -> None:
    rng = random.Random(13)
    question = TrackQuery(track_ids=[1, 2], bbox_enu_m=[0.0, 0.0, 1.0, 1.0], max_age_s=3.0, at_t_ns=BEGIN_NS)
    outcomes: Counter[str] = Counter()
    with Running("data") as service:
        service.sensor(radar("north"))
        for batch in good_traffic()[:10]:
            service.plots("north", batch)
        service.settle()
        key = KEYS.service("tracks", "main")
        for _ in range(500):
            data = broken(encode(question), rng) if rng.random() < 0.5 else msgpack.packb(
                transplanted(question.model_dump(), rng)
            )  # fmt: skip
            replies = list(service.bus.query(key, data, encoding(TrackQuery), parameters=fmt))
            assert ("json" in replies[0].encoding) == bool(fmt)
            *answers, end = replies
            assert open_envelope(end.payload, end.encoding, TrackFrame) == sum(map(is_frame, answers))
            outcomes.update("frame" if is_frame(answer) else "error" for answer in answers)
        assert outcomes["error"] == sum(service.refused.values()) > 100
        assert set(service.refused) <= REASONS | {"no_origin"}
        assert outcomes["frame"] + outcomes["error"] == 500


def is_frame(reply: Any) -> bool:
    try:
        return isinstance(open_envelope(reply.payload, reply.encoding, TrackFrame), TrackFrame)
    except QueryFailed:
        return False
