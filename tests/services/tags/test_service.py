"""The tag service on a bus: what it tells, what it refuses and why, readers from file and network, the black box."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from tests.network.processes import wait_until
from tests.services.tags.running import KEYS, Running
from tests.services.tags.worlds import CORNERS, S, batch, reader

from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records, to_line
from trackmesh.protocol.messages import LOCATED, Message, RangeBatch, TagFrame, TrackFrame
from trackmesh.protocol.ranging import RangePublisher
from trackmesh.services.tags.offline import OfflineRun
from trackmesh.services.tags.reader_file import ReaderFile, read_readers
from trackmesh.services.tags.settings import TagEngineSettings

PLACE = (10.0, 15.0)
GOOD_SEQ = 10


def heard(seq: int, t_s: float = 0.0, place: tuple[float, float] = PLACE, **change: Any) -> RangeBatch:
    """What the four corners measure of one tag."""
    rows = [(t_s, "tag-1", name, float(np.hypot(*np.subtract(place, at)))) for name, at in CORNERS.items()]
    return batch(seq, rows, **change)


def now(seq: int = GOOD_SEQ + 1, seconds: float = 0.0, **change: Any) -> RangeBatch:
    t_ns = np.full(4, time.time_ns() + int(seconds * S))
    return heard(seq, **({"t_ns": t_ns} | change))


def fields(**change: Any) -> bytes:
    """The next batch with some fields replaced."""
    return bytes(msgpack.packb(now().model_dump() | change))


@pytest.fixture
def running() -> Iterator[Running]:
    """A service that knows four readers and has accepted batch 10."""
    with Running("wall", max_batch_bytes=50_000) as service:
        service.reader(*[reader(name, *place) for name, place in CORNERS.items()])
        service.ranges(now(GOOD_SEQ))
        service.settle()
        assert (service.accepted, service.refused) == (1, {})
        yield service


CASES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "truncated bytes": ("malformed", lambda: encode(now())[:-5]),
    "no bytes": ("malformed", lambda: b""),
    "random bytes": ("malformed", lambda: b"\xc1" + os.urandom(100)),
    "a whole other message": ("missing_field", lambda: encode(reader("sw", 0.0, 0.0))),
    "another version": ("wrong_version", lambda: fields(schema_version=2)),
    "an unknown field": ("unknown_field", lambda: fields(speed=1.0)),
    "neither ranges nor strengths": ("missing_field", lambda: fields(range_m=None)),
    "a reader that is not in the list": ("out_of_bounds", lambda: fields(reader=[0, 1, 2, 9])),
    "fewer times than ranges": ("wrong_length", lambda: fields(t_ns=[time.time_ns()])),
    "NaN": ("not_finite", lambda: fields(range_m=[1.0, 2.0, 3.0, math.nan])),
    "a range beyond all bounds": ("out_of_bounds", lambda: fields(range_m=[1.0, 2.0, 3.0, 1e7])),
    "a range far below nought": ("out_of_bounds", lambda: fields(range_m=[1.0, 2.0, 3.0, -1e4])),
    "far in the future": ("future", lambda: encode(now(seconds=60.0))),
    "a clock that is an hour behind": ("past", lambda: encode(now(seconds=-3600.0))),
    "the beginning of time": ("past", lambda: encode(now(t_ns=np.zeros(4, np.int64)))),
    "the end of time": ("future", lambda: encode(now(t_ns=np.full(4, 2**63 - 1)))),
    "a duplicate": ("duplicate_seq", lambda: encode(now(GOOD_SEQ))),
    "an old batch": ("out_of_order_seq", lambda: encode(now(GOOD_SEQ - 1))),
    "another network's id": ("wrong_sensor", lambda: encode(now(network_id="yard"))),
    "an invalid tag": ("invalid_id", lambda: fields(tags=["../tag"])),
    "a batch over the limit": ("too_large", lambda: bytes(50_001)),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_ranges_are_refused_and_counted(running: Running, case: str) -> None:
    reason, make = CASES[case]
    running.ranges(make())
    running.settle()
    status = running.status()
    assert status.refused == {reason: 1}
    (hall,) = status.sensors
    assert (hall.sensor_id, hall.alive, hall.refused) == ("hall", True, 1)
    # And the next good one is welcome.
    running.ranges(now(GOOD_SEQ + 2))
    running.settle()
    assert (running.accepted, running.refused) == (2, {reason: 1})


def test_another_schema_is_refused(running: Running) -> None:
    running.ranges(encode(now()), kind=encoding(TrackFrame))
    running.settle()
    assert running.refused == {"wrong_schema": 1}


def test_frames_are_published_and_the_status_tells_of_them(running: Running) -> None:
    frames = [running.frames.receive(5.0)]
    for k in range(1, 6):
        running.ranges(now(GOOD_SEQ + k))
        frames.append(running.frames.receive(5.0))
    last = frames[-1]
    assert last is not None and last.tag_id == ["tag-1"] and last.status.tolist() == [LOCATED]
    assert math.dist(last.state[0, :2], PLACE) < 0.5
    assert last.boot_id == running.runtime.boot_id
    # A frame is out before its ranges are counted.
    wait_until(lambda: running.status().counters["ranges"] == 24, "all ranges are counted")
    status = running.status()
    assert (status.figures["located"], status.figures["readers"]) == (1, 4)
    assert status.latency_ms["p50"] < 10_000
    assert running.frames.refused == {}


def test_time_goes_on_without_data() -> None:
    with Running("wall", engine={"idle_frame_s": 0.2, "lost_s": 0.4}, tick_s=0.05) as service:
        service.reader(*[reader(name, *place) for name, place in CORNERS.items()])
        service.ranges(now(0))
        lost = None
        deadline = time.monotonic() + 20.0
        while time.monotonic() < deadline and (lost is None or lost.status.tolist() != [2]):
            lost = service.frames.receive(1.0) or lost
        assert lost is not None and lost.status.tolist() == [2]


def test_a_reader_that_comes_with_its_network_is_known_at_once_and_one_that_moves_again() -> None:
    with Running() as service:
        infos = [reader(name, *place) for name, place in CORNERS.items()]
        with RangePublisher(service.bus, "test", "hall", infos):
            wait_until(lambda: all(map(service.knows, infos)), "all readers are known")
            moved = reader("sw", 1.0, 2.0)
            service.reader(moved)
            assert service.service.engine.readers.place[-1].tolist() == [1.0, 2.0, 0.0]
            wait_until(lambda: service.status().figures["readers_alive"] == 4, "all are alive")
        wait_until(lambda: service.status().figures["readers_alive"] == 0, "all are gone")
        # Gone from the network is not forgotten: where they stood is known.
        assert service.status().figures["readers"] == 4


def test_a_reader_that_nobody_announced_is_asked() -> None:
    with Running() as service:
        info = reader("sw", 0.0, 0.0)
        # The network is there before the service subscribes again, so only a question helps.
        with RangePublisher(service.bus, "test", "hall", [info]):
            wait_until(lambda: service.knows(info), "the reader is known")
        service.service.engine.drop_reader("sw")
        with RangePublisher(service.bus, "test", "other", [info]):
            service.service.engine.drop_reader("sw")
            service.ranges(batch(0, [(0.0, "tag-1", "sw", 5.0)]))
            wait_until(lambda: service.knows(info), "the reader was asked", 10.0)


def test_what_is_no_reader_is_passed_over_and_rubbish_refused(running: Running) -> None:
    radar = reader("north", 0.0, 0.0).model_copy(update={"kind": "radar"})
    running.put(KEYS.sensor("north"), encode(radar), encoding(radar))
    running.put(KEYS.sensor("x"), encode(reader("y", 0.0, 0.0)), encoding(radar))
    wait_until(lambda: running.refused == {"wrong_sensor": 1}, "a reader that is another is refused")
    assert set(running.service.engine.readers.infos) == set(CORNERS)


def test_no_more_readers_than_there_may_be() -> None:
    with Running(max_readers=2) as service:
        service.reader(reader("a", 0.0, 0.0), reader("b", 1.0, 0.0))
        third = reader("c", 2.0, 0.0)
        service.put(KEYS.sensor("c"), encode(third), encoding(third))
        wait_until(lambda: service.refused == {"too_many_sensors": 1}, "the third is refused")


# --- readers from a file

FILE = """
[defaults]
max_range_m = 60.0
sigma_m = 0.3

[[readers]]
id = "sw"
site_enu_m = [0.0, 0.0]

[[readers]]
id = "se"
site_enu_m = [40.0, 0.0, 2.5]
sigma_m = 1.0

[[readers]]
id = "ne"
site = {latitude_deg = 48.0, longitude_deg = 11.0}
"""


def test_readers_come_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "readers.toml"
    path.write_text(FILE)
    sw, se, ne = read_readers(path)
    assert (sw.site_enu_m, sw.sigma, sw.max_range_m) == ([0.0, 0.0, 0.0], {"range_m": 0.3}, 60.0)
    assert (se.site_enu_m, se.sigma) == ([40.0, 0.0, 2.5], {"range_m": 1.0})
    assert ne.site is not None and ne.site.latitude_deg == 48.0


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('id = "sw"', 'id = "S W"', "id"),
        ('id = "sw"', 'id = "se"', "names the reader 'se' more than once"),
        ("[0.0, 0.0]", "[0.0]", "site_enu_m"),
        ("[0.0, 0.0]", "[0.0, nan]", "site_enu_m"),
        ("site_enu_m = [0.0, 0.0]", "", "give either site_enu_m or site"),
        ("sigma_m = 0.3", "sigma_m = -0.3", "sigma_m"),
        ("sigma_m = 0.3", "speed = 0.3", "speed"),
        ("[[readers]]", "[[reader]]", "reader"),
        ("[defaults]", "[defaults", "is no TOML"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_in_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    path = tmp_path / "readers.toml"
    path.write_text(FILE.replace(old, new))
    with pytest.raises(TrackmeshError, match=sentence) as caught:
        read_readers(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_file_is_read_again_when_it_changes(tmp_path: Path) -> None:
    path = tmp_path / "readers.toml"
    path.write_text(FILE)
    file = ReaderFile(path)
    first = file.changes()
    assert first is not None and len(first[0]) == 3 and first[1] == []
    assert file.changes() is None
    path.write_text(FILE.replace('id = "sw"', 'id = "new-one"'))
    second = file.changes()
    assert second is not None and second[1] == ["sw"]
    path.write_text("nonsense")
    with pytest.raises(TrackmeshError):
        file.changes()
    assert file.changes() is None
    path.unlink()
    with pytest.raises(TrackmeshError, match="Cannot read"):
        file.changes()
    assert file.changes() is None


def test_readers_in_a_file_come_move_and_go_while_the_service_runs(tmp_path: Path) -> None:
    path = tmp_path / "readers.toml"
    path.write_text(FILE)
    with Running(readers=path, tick_s=0.05) as service:
        infos = service.service.engine.readers.infos
        assert set(infos) == {"sw", "se", "ne"}
        path.write_text(FILE.replace("[0.0, 0.0]", "[7.0, 0.0]").replace('id = "ne"', 'id = "nw"'))
        wait_until(lambda: set(infos) == {"sw", "se", "nw"}, "the file is read again")
        assert infos["sw"].site_enu_m == [7.0, 0.0, 0.0]
        path.write_text("nonsense")
        wait_until(lambda: service.runtime.counters.counts().get("reader_file_failures") == 1, "it is told")
        assert set(infos) == {"sw", "se", "nw"}


def test_a_service_without_its_file_does_not_start(tmp_path: Path) -> None:
    with pytest.raises(TrackmeshError, match="Cannot read"), Running(readers=tmp_path / "missing.toml"):
        pass


# --- the black box


def replayed(records: Iterator[Message] | list[Message]) -> list[str]:
    return [to_line(frame) for frame in OfflineRun(TagEngineSettings()).frames(records)]


def test_the_black_box_gives_exactly_the_frames_that_were_published(tmp_path: Path) -> None:
    path, box = tmp_path / "readers.toml", tmp_path / "box.jsonl"
    corners = "".join(f'[[readers]]\nid = "{name}"\nsite_enu_m = {list(at)}\n' for name, at in CORNERS.items())
    path.write_text(corners)
    frames: list[TagFrame] = []
    with Running("wall", readers=path, black_box=box, tick_s=0.05, engine={"idle_frame_s": 0.1}) as service:
        for k in range(30):
            if k == 15:
                path.write_text(corners.replace('"nw"', '"other"'))
                wait_until(lambda: "other" in service.service.engine.readers.infos, "the readers have changed")
            service.ranges(now(k))
            service.settle()
        wait_until(lambda: service.runtime.counters.counts()["frames"] > 35, "ticks make frames")
    while (frame := service.frames.receive(0.0)) is not None:
        frames.append(frame)
    lines = replayed(read_records(box))
    assert [to_line(frame) for frame in frames] == lines
    assert len(lines) > 35
    kinds = {type(record).__name__ for record in read_records(box)}
    assert kinds == {"UnitRecord", "SensorInfo", "RangeBatch", "Tick", "Gone"}


def test_offline_what_comes_twice_is_refused_and_other_records_are_no_inputs() -> None:
    run = OfflineRun(TagEngineSettings())
    infos: list[Message] = [reader(name, *place) for name, place in CORNERS.items()]
    assert len(list(run.frames([*infos, heard(0), heard(0), heard(1, 0.5)]))) == 2
    assert run.refused == {"duplicate_seq": 1}
    with pytest.raises(TrackmeshError, match="no input of the tag engine"):
        list(run.frames([TagFrame.model_validate(next(OfflineRun(TagEngineSettings()).frames([*infos, heard(0)])))]))


@pytest.mark.parametrize(
    "wrong",
    [
        {"update": "ukf-printed"},
        {"forget_s": 1.0},
        {"area_enu_m": [10.0, 0.0, 0.0, 10.0]},
        {"speed_mps": 0.0},
        {"filter": "tvimm"},
        {"references": {"A B": [0.0, 0.0]}},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="validation error"):
        TagEngineSettings(**wrong)
    assert TagEngineSettings(update="ukf-printed", motion="singer").description().update == "ukf-printed"
