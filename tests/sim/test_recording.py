from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import Geodetic, PlotBatch, SensorInfo, TruthFrame
from trackmesh.sim.recording import START_NS, write_recording
from trackmesh.sim.scenario import Scenario


def recorded(folder: Path, name: str, scenario: Scenario, seed: int) -> tuple[bytes, bytes]:
    plots, truth = folder / f"{name}.plots", folder / f"{name}.truth"
    write_recording(scenario, seed, plots, truth, duration_s=30.0)
    return plots.read_bytes(), truth.read_bytes()


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path, two_radars: Scenario) -> None:
    first = recorded(tmp_path, "a", two_radars, 1)
    assert recorded(tmp_path, "b", two_radars, 1) == first
    other = recorded(tmp_path, "c", two_radars, 2)
    assert other[0] != first[0]
    assert other[1] != first[1]


def test_a_recording_is_in_order_of_arrival(tmp_path: Path, two_radars: Scenario) -> None:
    path = tmp_path / "plots.jsonl"
    seconds: list[float] = []
    n_plots = write_recording(two_radars, 1, path, duration_s=30.0, progress=seconds.append)
    records = list(read_records(path))
    assert isinstance(records[0], Geodetic)
    assert [r.sensor_id for r in records[1:3] if isinstance(r, SensorInfo)] == ["north", "east"]
    batches = [r for r in records[3:] if isinstance(r, PlotBatch)]
    assert len(batches) == len(records) - 3 == 7 * 32 + 16 + 187
    assert sum(len(b.t_ns) for b in batches) == n_plots
    sector_s = {"north": 4.0 / 32, "east": 5.0 / 32}
    offset_s = {"north": 0.0, "east": 0.7}
    ends = [offset_s[b.sensor_id] + sector_s[b.sensor_id] * (b.seq + 1) for b in batches]
    assert (np.diff(ends) > -1e-9).all()
    assert ends[-1] <= 30.0
    for batch, end in zip(batches, ends, strict=True):
        assert ((batch.t_ns - START_NS) * 1e-9 <= end + 1e-9).all()
    assert seconds == sorted(seconds) or max(np.diff(seconds)) < 1.0


def test_the_truth_is_recorded_from_end_to_end(tmp_path: Path, two_radars: Scenario) -> None:
    truth = tmp_path / "truth.jsonl"
    write_recording(two_radars, 1, tmp_path / "plots.jsonl", truth, duration_s=30.0)
    frames = [r for r in read_records(truth) if isinstance(r, TruthFrame)]
    assert [f.t_ns - START_NS for f in frames] == [k * 500_000_000 for k in range(61)]
    assert {f.scenario_id for f in frames} == {"two-radars"}


def test_a_file_that_cannot_be_written_is_one_sentence(tmp_path: Path, two_radars: Scenario) -> None:
    with pytest.raises(TrackmeshError, match="Cannot write"):
        write_recording(two_radars, 1, tmp_path / "no" / "plots.jsonl", duration_s=1.0)
