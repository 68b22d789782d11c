from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import Tick, read_records
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo, TruthFrame
from trackmesh.sim.autoferry import Autoferry, convert_autoferry

OWN = [10.0, 100.0]  # north, east
BOAT = [{"targetID": 1, "position": [5.0, 50.0, 0.0], "time": 999.98}]


def entry(sensor: int, measurement: object, time: float = 1000.0) -> dict[str, object]:
    return {"sensorID": sensor, "time": time, "ownshipPosition": OWN, "measurement": measurement, "measurements": []}


def stored(folder: Path, entries: object, truth: object = None) -> Path:
    path = folder / "scenario9_detections.json"
    path.write_text(json.dumps(entries))
    boats = [BOAT] * len(entries) if truth is None and isinstance(entries, list) else truth
    (folder / "scenario9_groundTruth.json").write_text(json.dumps(boats))
    return path


@pytest.mark.parametrize(
    ("measurement", "expected"),
    [
        ([[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]], [[110.0, 11.0], [120.0, 12.0], [130.0, 13.0]]),
        ([[1.0, 2.0], [10.0, 20.0]], [[110.0, 11.0], [120.0, 12.0]]),
        ([1.0, 10.0], [[110.0, 11.0]]),
        ([[1.0], [10.0]], [[110.0, 11.0]]),
        ([], []),
        ([[], []], []),
    ],
)
def test_every_stored_layout(tmp_path: Path, measurement: object, expected: list[list[float]]) -> None:
    recording = Autoferry(stored(tmp_path, [entry(2, measurement)]))
    batch = next(r for r in recording.records() if isinstance(r, PlotBatch))
    assert batch.sensor_id == "autoferry-radar"
    assert batch.columns == ["east_m", "north_m"]
    np.testing.assert_allclose(batch.values.reshape(-1, 2), np.reshape(expected, (-1, 2)))


def test_order_of_arrival_numbering_and_empty_batches(tmp_path: Path) -> None:
    entries = [
        entry(1, [1.0, 2.0], 1000.5),
        entry(4, -2.2, 1000.6),
        entry(2, [3.0, 4.0], 1000.1),
        entry(1, [], 1001.0),
    ]
    records = list(Autoferry(stored(tmp_path, entries)).records())
    assert isinstance(records[0], Geodetic)
    assert [r.sensor_id for r in records if isinstance(r, SensorInfo)] == ["autoferry-radar", "autoferry-lidar"]
    tail = records[3:]
    assert [type(r) for r in tail] == [PlotBatch, PlotBatch, Tick, PlotBatch]
    batches = [r for r in tail if isinstance(r, PlotBatch)]
    assert [(b.sensor_id[10:], b.seq, len(b.t_ns)) for b in batches] == [
        ("lidar", 0, 1),
        ("radar", 0, 1),
        ("lidar", 1, 0),
    ]
    assert batches[0].t_ns.tolist() == [1000_500_000_000]
    assert batches[1].t_ns.tolist() == [1000_100_000_000]


def test_the_truth_is_sorted_and_has_velocities(tmp_path: Path) -> None:
    times = [1000.0, 1002.0, 1001.0]
    boats = [[{"targetID": 7, "position": [2.0 * t, -3.0 * t, 0.0], "time": t}] for t in times]
    path = stored(tmp_path, [entry(3, 0.1, t) for t in times], boats)
    frames = list(Autoferry(path).truth())
    assert [f.t_ns for f in frames] == [1000 * 10**9, 1001 * 10**9, 1002 * 10**9]
    np.testing.assert_allclose(frames[1].state, [[-3003.0, 2002.0, -3.0, 2.0]])
    np.testing.assert_allclose(frames[0].state[:, 2:], [[-3.0, 2.0]])
    assert frames[0].scenario_id == "autoferry-9"


@pytest.mark.parametrize(
    ("entries", "truth", "sentence"),
    [
        ([entry(2, [[1.0, 2.0], [1.0]])], None, "entry 0 is not a row of norths and a row of easts"),
        ([entry(2, [1.0, 2.0, 3.0])], None, "entry 0 is not a row"),
        ([entry(2, "x")], None, "no Autoferry recording"),
        ([entry(2, [None, 1.0])], None, "no Autoferry recording"),
        ([{"sensorID": 2}], None, "Field required"),
        ({}, [], "valid array"),
        ([entry(2, [])], [], "does not belong to"),
        ([entry(2, [])], [[{"targetID": 1}]], "groundTruth.json is no Autoferry recording"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path: Path, entries: object, truth: object, sentence: str) -> None:
    with pytest.raises(TrackmeshError, match=re.escape(sentence)) as caught:
        convert_autoferry(stored(tmp_path, entries, truth), tmp_path / "plots.jsonl")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(TrackmeshError, match=r"Cannot read .*scenario1_detections\.json: No such file"):
        Autoferry(tmp_path / "scenario1_detections.json")
    path = stored(tmp_path, [])
    (tmp_path / "scenario9_groundTruth.json").unlink()
    with pytest.raises(TrackmeshError, match=r"Cannot read .*scenario9_groundTruth\.json"):
        Autoferry(path)
    with pytest.raises(TrackmeshError, match="does not belong to"):
        (tmp_path / "other.json").write_text("[]")
        Autoferry(tmp_path / "other.json")


@pytest.mark.parametrize(("number", "batches", "backward"), [(2, 304, 0), (6, 393, 21)])
def test_the_recordings(tmp_path: Path, autoferry_data: Path, number: int, batches: int, backward: int) -> None:
    """Against a reading of the files in a few lines: the same plots at the same times, in the files' order."""
    source = autoferry_data / f"scenario{number}_detections.json"
    plots, truth = tmp_path / "plots.jsonl", tmp_path / "truth.jsonl"
    n_batches, n_plots = convert_autoferry(source, plots, truth)
    expected = [
        (d["time"], np.array(d["measurement"], float).reshape(2, -1).T + d["ownshipPosition"])
        for d in json.loads(source.read_text())
        if d["sensorID"] in (1, 2)
    ]
    found = [r for r in read_records(plots) if isinstance(r, PlotBatch)]
    assert n_batches == len(found) == len(expected) == batches
    assert n_plots == sum(len(z) for _, z in expected)
    for batch, (t_s, z) in zip(found, expected, strict=True):
        np.testing.assert_allclose(batch.values.reshape(-1, 2)[:, ::-1], z)
        np.testing.assert_allclose(batch.t_ns * 1e-9, t_s, atol=1e-6)
    assert int((np.diff([t for t, _ in expected]) < 0).sum()) == backward
    frames = [r for r in read_records(truth) if isinstance(r, TruthFrame)]
    assert [f.t_ns for f in frames] == sorted(f.t_ns for f in frames)
    speed = np.concatenate([np.hypot(f.state[:, 2], f.state[:, 3]) for f in frames])
    assert 0.5 < np.median(speed) < 10.0
    assert speed.max() < 20.0
