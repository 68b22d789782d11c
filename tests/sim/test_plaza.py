"""The Plaza recording: converted, and located with and without the common errors of its ranges."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import LOCATED, RangeBatch, SensorInfo, TagFrame, TruthFrame
from trackmesh.services.tags.offline import OfflineRun
from trackmesh.services.tags.settings import TagEngineSettings, TagSettings
from trackmesh.sim.plaza import Plaza, convert_plaza

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / ".." / "shared" / "data" / "plaza" / "Plaza1.mat"
CONFIG = ROOT / "examples" / "plaza.toml"

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """A small recording in the same format, its tables changed."""

    def file(**change: object) -> Path:
        t = np.arange(0.0, 10.0, 0.5)
        tables: dict[str, object] = {
            "TD": np.column_stack([t[::-1], np.full(20, 2.0), np.arange(20) % 4, np.linspace(10.0, 20.0, 20)]),
            "TL": np.array([[0.0, 0, 0], [1, 40, 0], [2, 40, 40], [3, 0, 40]]),
            "GT": np.column_stack([t, t, 2 * t, np.zeros(20)]),
        }
        path = tmp_path / "small.mat"
        scipy.io.savemat(path, {name: table for name, table in (tables | change).items() if table is not None})
        return path

    return file


def test_beacons_become_readers_and_ranges_come_in_order(write: Write, tmp_path: Path) -> None:
    assert convert_plaza(write(), tmp_path / "r.jsonl", tmp_path / "t.jsonl") == 20
    records = list(read_records(tmp_path / "r.jsonl"))
    infos = [record for record in records if isinstance(record, SensorInfo)]
    assert [info.sensor_id for info in infos] == [f"beacon-{k}" for k in range(4)]
    assert infos[2].site_enu_m == [40.0, 40.0, 0.0]
    batches = [record for record in records if isinstance(record, RangeBatch)]
    times = [int(b.t_ns[0]) for b in batches]
    assert times == sorted(times) and [b.seq for b in batches] == list(range(20))
    # The last row of the file is the first in time.
    assert batches[0].range_m is not None and batches[0].range_m[0] == 20.0
    truth = [frame for frame in read_records(tmp_path / "t.jsonl") if isinstance(frame, TruthFrame)]
    assert len(truth) == 20 and truth[6].state[0].tolist() == pytest.approx([3.0, 6.0, 1.0, 2.0])
    assert Plaza(tmp_path / "small.mat").positions(np.array([truth[6].t_ns])).tolist() == [[3.0, 6.0]]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"TD": None}, "has no table TD of 4 columns"),
        ({"TL": np.zeros((4, 2))}, "has no table TL of 3 columns"),
        ({"GT": np.full((3, 4), np.nan)}, "not finite"),
        ({"TL": np.array([[7.0, 0.0, 0.0]])}, "beacons that it does not place"),
    ],
)
def test_another_file_is_refused_in_one_sentence(write: Write, change: dict[str, object], sentence: str) -> None:
    with pytest.raises(TrackmeshError, match=sentence):
        Plaza(write(**change))


def test_no_file_and_no_matlab_are_told(tmp_path: Path) -> None:
    (tmp_path / "text.mat").write_text("hello")
    for name, sentence in (("missing.mat", "Cannot read"), ("text.mat", "no MATLAB file")):
        with pytest.raises(TrackmeshError, match=sentence):
            Plaza(tmp_path / name)


def errors(plaza: Plaza, **change: float) -> tuple[float, TagFrame]:
    """RMS error right after each range, and the last frame."""
    settings = TagSettings.load(CONFIG).engine.model_dump() | change
    run = OfflineRun(TagEngineSettings(**settings))
    off, last = [], None
    for frame in run.frames(plaza.records()):
        if frame.status.tolist() == [LOCATED]:
            last = frame
            off.append(frame.state[0, :2] - plaza.positions(np.array([frame.t_ns]))[0])
    assert last is not None and len(off) > 0.98 * len(plaza.ranges)
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))), last


@pytest.mark.skipif(not RECORDING.exists(), reason="the Plaza recording is not here")
def test_bias_and_scale_found_without_the_truth_halve_the_error_at_least() -> None:
    plaza = Plaza(RECORDING)
    plain, _ = errors(plaza, range_bias_sd_m=0.0, range_scale_sd=0.0)
    ours, last = errors(plaza)
    # 1.01 m and 4.7 m when this was written.
    assert ours < 1.15 and plain > 2.0 * ours
    assert last.range_scale is not None and last.range_bias_m is not None
    # A line through the errors of the ranges against the truth: 7 % of the distance and 3 cm.
    assert last.range_scale[0] == pytest.approx(0.07, abs=0.015)
    assert abs(last.range_bias_m[0]) < 0.7
    assert json.loads(last.model_dump_json())["tag_id"] == ["tag-1"]
