"""The running service tells the biases, keeps them over a restart, and its black box gives the same frames again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tests.services.fusion.makers import EAST, NORTH
from tests.services.fusion.running import Running
from tests.services.fusion.test_engine_registration import biased, both

from trackmesh.protocol.codec import encode
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import Registration, TrackFrame
from trackmesh.services.fusion.offline import OfflineRun
from trackmesh.services.fusion.settings import EngineSettings


def run(**settings: Any) -> tuple[list[TrackFrame], Registration]:
    """A service that tracks a minute of two radars of which one is biased: its frames, and the last it told."""
    with Running("data", **settings) as running:
        biases = running.client.watch_registration()
        for info in (NORTH, EAST):
            running.sensor(info)
        for batch in both(60.0, biased):
            running.plots(batch.sensor_id, batch)
        running.settle()
        told = None
        while (one := biases.receive(0.2)) is not None:
            told = one
        frames = list(iter(lambda: running.frames.receive(0.2), None))
    assert told is not None
    return frames, told


def test_biases_are_told_and_kept_over_a_restart(tmp_path: Path) -> None:
    file = tmp_path / "biases.jsonl"
    _, first = run(registration_file=file)
    assert [sensor.sensor_id for sensor in first.sensors] == ["north", "east"]
    assert any(sensor.locked for sensor in first.sensors)
    assert file.exists()

    box = tmp_path / "box.jsonl"
    frames, second = run(registration_file=file, black_box=box)
    assert all(sensor.locked for sensor in second.sensors)
    assert second.sensors[1].pairs > first.sensors[1].pairs, "it goes on where the first has stopped"

    offline = OfflineRun(EngineSettings())
    again = list(offline.frames(read_records(box)))
    assert [encode(frame) for frame in again] == [encode(frame) for frame in frames]


def test_a_file_that_holds_something_else_ends_the_start_in_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "biases.jsonl"
    file.write_text('{"type": "tick", "t_ns": 5}\n', encoding="utf-8")
    with pytest.raises(TrackmeshError, match="registration"), Running("data", registration_file=file):
        pass
