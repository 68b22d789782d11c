"""The running service with the tracks of another: what it takes, tells and records."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.network.processes import wait_until
from tests.services.fusion.makers import EAST, FAR_APART, NORTH, live, ns, scans
from tests.services.fusion.running import KEYS, Running
from tests.services.fusion.units import IDENT, Sender, frame
from typer.testing import CliRunner

from trackmesh.protocol.codec import encode, encoding
from trackmesh.protocol.files import read_records, to_line
from trackmesh.protocol.memory_bus import MemoryHub
from trackmesh.protocol.messages import SensorHealth, TrackFrame
from trackmesh.services.cli.main import app
from trackmesh.services.fusion.offline import OfflineRun
from trackmesh.services.fusion.settings import EngineSettings, FusionSettings
from trackmesh.services.runtime import SettingsError

TRACKS = encoding(TrackFrame)


def told(running: Running, one: TrackFrame, unit: str = "other") -> None:
    """A frame at the key of a unit."""
    running.put(KEYS.tracks(unit), encode(one), TRACKS)


def taken(running: Running) -> int:
    return running.service.engine.counters["input_frames"]


def health(running: Running, name: str) -> SensorHealth:
    return {sensor.sensor_id: sensor for sensor in running.status().sensors}[name]


def test_frames_of_an_input_are_taken_and_counted() -> None:
    with Running("data", inputs=["other", "third"]) as running:
        sender = Sender(FAR_APART)
        for t in np.arange(0.5, 12.0).tolist():
            told(running, sender.at(t))
        wait_until(lambda: taken(running) == 12, "all frames are taken")
        assert health(running, "other").batches == 12 and health(running, "other").plots == 48
        assert health(running, "other").last_t_ns == ns(11.5)
        assert health(running, "third").batches == 0
        figures = running.status().figures
        assert figures["input_tracks.other"] == 4.0 and figures["input_pairs.other"] == 0.0
        frames = list(iter(lambda: running.frames.receive(0.2), None))
    assert [f.unit_id for f in frames if f.unit_id == "main"]
    last = [f for f in frames if f.unit_id == "main"][-1]
    assert len(live(last)) == 4 and last.sensors == ["other", "third"]
    assert sorted(last.members[:, 0].tolist()) == [IDENT + k for k in range(4)]


def test_what_is_wrong_is_refused_by_reason_and_the_service_goes_on() -> None:
    states = np.array([[1e4, 2e4, 100.0, 0.0]])
    with Running("data", inputs=["other"]) as running:
        told(running, frame(1.0, states, unit_id="another"))
        running.put(KEYS.tracks("other"), b"\xc1", TRACKS)
        running.put(KEYS.tracks("other"), encode(frame(1.0, states)), "application/msgpack;trackmesh.PlotBatch.v1")
        told(running, frame(2.0, states, covariance=np.zeros((1, 21), np.float32)))
        told(running, frame(3.0, states))
        told(running, frame(3.0, states))
        # Of a unit that is no input nothing is heard at all.
        told(running, frame(3.0, states, unit_id="stranger"), "stranger")
        wait_until(lambda: sum(running.refused.values()) == 5, "all wrong frames are refused")
        assert running.refused == {
            "wrong_unit": 1, "malformed": 1, "wrong_schema": 1, "invalid_covariance": 1, "duplicate_seq": 1,
        }  # fmt: skip
        assert taken(running) == 1
        assert health(running, "other").refused == 5


@pytest.mark.parametrize(("offset_s", "reason"), [(30.0, "future"), (-100.0, "past")])
def test_by_the_wall_clock_frames_must_be_of_now(offset_s: float, reason: str) -> None:
    with Running("wall", inputs=["other"]) as running:
        t_ns = time.time_ns() + round(offset_s * 1e9)
        states = np.array([[1e4, 2e4, 100.0, 0.0]])
        told(running, frame(1.0, states, t_ns=t_ns, updated_t_ns=np.array([t_ns])))
        wait_until(lambda: running.refused == {reason: 1}, "the frame is refused")


def test_it_knows_whether_an_input_is_alive() -> None:
    hub = MemoryHub()
    with Running("data", hub=hub, inputs=["other"]) as running:
        assert not health(running, "other").alive
        token = running.bus.declare_alive(KEYS.live("fusion", "other"))
        wait_until(lambda: health(running, "other").alive, "it is alive")
        token.close()
        wait_until(lambda: not health(running, "other").alive, "it is gone")


def test_sensors_that_are_not_wanted_are_not_heard() -> None:
    with Running("data", sensors=["east"]) as running:
        running.put(KEYS.sensor("north"), encode(NORTH), encoding(NORTH))
        running.sensor(EAST)
        for batch in scans(NORTH, FAR_APART, 20.0):
            running.plots("north", batch)
        for batch in scans(EAST, FAR_APART, 20.0):
            running.plots("east", batch)
        wait_until(lambda: running.accepted == 4, "the batches of one are taken")
        assert list(running.service.engine.sensors) == ["east"] and not running.refused
        assert [sensor.sensor_id for sensor in running.status().sensors] == ["east"]


def test_two_units_a_radar_each_and_the_black_box_of_the_second(tmp_path: Path) -> None:
    box, hub = tmp_path / "box.jsonl", MemoryHub()
    # The second radar sees half of the targets.
    half = EAST.model_copy(update={"max_range_m": 60e3})
    with (
        Running("data", hub=hub, unit_id="first", unit_number=1, sensors=["north"]) as first,
        Running(
            "data", hub=hub, unit_id="second", unit_number=2, sensors=["east"], inputs=["first"], black_box=box
        ) as second,
    ):
        first.sensor(NORTH)
        second.sensor(half)
        east, north = scans(half, FAR_APART, 60.0, seed=2), scans(NORTH, FAR_APART, 60.0)
        for a, b in zip(north, east, strict=False):
            first.plots("north", a)
            wait_until(lambda: taken(second) == first.sent, "the first's picture has come")
            seen = b.values[:, 0] < half.max_range_m
            second.plots("east", b.model_copy(update={"values": b.values[seen], "t_ns": b.t_ns[seen]}))
            wait_until(lambda: second.accepted == second.sent, "the second has seen it")
        frames = [f for f in iter(lambda: second.frames.receive(0.2), None) if f.unit_id == "second"]
        refused = second.refused
    assert not refused
    assert len(live(frames[-1])) == 4
    members = frames[-1].members
    assert (members[:, 0] >= 0).sum() == 4 and 0 < (members[:, 1] >= 0).sum() < 4
    assert {int(k) >> 41 for k in frames[-1].track_id} == {2}

    again = list(OfflineRun(EngineSettings()).frames(read_records(box)))
    assert [encode(one) for one in again] == [encode(one) for one in frames]


def test_a_recording_may_hold_the_tracks_of_named_units() -> None:
    sender = Sender(FAR_APART)
    records = [sender.at(t) for t in np.arange(0.5, 12.0).tolist()]
    run = OfflineRun(EngineSettings(), "main", 1, inputs=["other"])
    frames = list(run.frames(records))
    assert len(live(frames[-1])) == 4 and not run.refused
    unnamed = OfflineRun(EngineSettings(), "main", 1)
    assert not list(unnamed.frames(records))
    assert unnamed.refused == {"unknown_input": 12}


def test_the_command_track_takes_them_when_told_to(tmp_path: Path) -> None:
    file, out = tmp_path / "in.jsonl", tmp_path / "out.jsonl"
    sender = Sender(FAR_APART)
    file.write_text("".join(to_line(sender.at(t)) + "\n" for t in np.arange(0.5, 12.0).tolist()), encoding="utf-8")
    result = CliRunner().invoke(app, ["track", str(file), "--out", str(out), "--inputs", "other"])
    assert result.exit_code == 0, result.output
    *_, last = read_records(out, TrackFrame)
    assert isinstance(last, TrackFrame) and len(live(last)) == 4
    result = CliRunner().invoke(app, ["track", str(file), "--out", str(out)])
    assert result.exit_code == 0 and "12 refused: unknown_input" in result.stderr


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"inputs": "main"}, "a unit cannot take its own tracks"),
        ({"inputs": "a,b,a"}, "a name is given twice"),
        ({"inputs": "North"}, "'North' is no name"),
        ({"sensors": "a/b"}, "'a/b' is no name"),
    ],
)
def test_settings_that_cannot_be_are_told_in_a_sentence(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SettingsError, match=sentence):
        FusionSettings.load(None, given)


def test_settings_name_units_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKMESH_INPUTS", "first, second")
    assert FusionSettings.load().inputs == ["first", "second"]
    assert FusionSettings.load(None, {"inputs": "third"}).inputs == ["third"]
