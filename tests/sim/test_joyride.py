"""The Joyride recording: converted, and whatever is not it refused in one sentence."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from tests.sim.conftest import SHARED

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import Tick, read_records
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TruthFrame
from trackmesh.sim.joyride import BOAT_SPEED_MPS, PERIOD_S, Joyride, convert_joyride, plot_variances_m2

RECORDING = SHARED / "data" / "joyride" / "joyride.mat"

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Three turns in the same format, tables changed."""

    def file(**change: object) -> Path:
        cells = np.empty((3, 1), object)
        cells[0, 0] = np.array([[30.0, 400.0], [np.inf, np.inf]])
        cells[1, 0] = np.array([[np.inf, np.inf]])
        cells[2, 0] = np.array([[31.0, 402.0], [900.0, -5.0]])
        tables: dict[str, object] = {
            "time": np.array([[1000.0], [1002.5], [1005.0]]),
            "measurements": cells,
            "target": np.array([[30.0, 1, 400, 2], [32.5, 1, 405, 2], [35, 1, 410, 2]]),
            "telemetron": np.array([[30.0, 0, 0, 0]] * 3),
        }
        path = tmp_path / "small.mat"
        scipy.io.savemat(path, {name: table for name, table in (tables | change).items() if table is not None})
        return path

    return file


def test_turns_become_batches_east_first_and_rows_of_inf_are_dropped(write: Write, tmp_path: Path) -> None:
    assert convert_joyride(write(), tmp_path / "p.jsonl", tmp_path / "t.jsonl") == (3, 3)
    records = list(read_records(tmp_path / "p.jsonl"))
    assert [type(record) for record in records] == [SensorInfo, PlotBatch, Tick, PlotBatch, PlotBatch]
    batches = [record for record in records if isinstance(record, PlotBatch)]
    assert [len(batch.t_ns) for batch in batches] == [1, 0, 2] and [batch.seq for batch in batches] == [0, 1, 2]
    assert batches[2].values.tolist() == [[402.0, 31.0], [-5.0, 900.0]]
    assert batches[2].t_ns.tolist() == [1005 * 10**9] * 2
    truth = [frame for frame in read_records(tmp_path / "t.jsonl") if isinstance(frame, TruthFrame)]
    assert [frame.t_ns for frame in truth] == [1000 * 10**9, 1002_500_000_000, 1005 * 10**9]
    assert truth[1].state.tolist() == [[405.0, 32.5, 2.0, 1.0]]


def test_plots_are_as_uncertain_as_range_bearing_and_the_time_of_a_turn_make_them() -> None:
    """Against noise drawn as it is described, for a boat due east and one north-east of the ship."""
    rng = np.random.default_rng(3)
    n = 200_000
    for east_m, north_m in ((400.0, 0.0), (300.0, 300.0)):
        range_m, bearing = np.hypot(east_m, north_m), np.arctan2(north_m, east_m)
        r, b = range_m + 5.0 * rng.standard_normal(n), bearing + np.deg2rad(1.0) * rng.standard_normal(n)
        way_m = BOAT_SPEED_MPS * PERIOD_S * (rng.random((2, n)) - 0.5)
        seen = np.array([r * np.cos(b), r * np.sin(b)]) + 6.6 * rng.standard_normal((2, n)) + way_m
        np.testing.assert_allclose(plot_variances_m2(np.array([[east_m, north_m]]))[0], seen.var(axis=1), rtol=0.02)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"target": None}, "target must be numbers in 4 columns"),
        ({"telemetron": np.zeros((3, 3))}, "telemetron must be numbers in 4 columns"),
        ({"time": np.array([[1.0], [np.nan], [2.0]])}, "time holds numbers that are not finite"),
        ({"time": np.array([[-1.0], [0.0], [2.0]])}, "time must not be negative"),
        ({"target": np.zeros((2, 4))}, "its tables must be equally long"),
        ({"measurements": None}, "its tables must be equally long"),
        ({"measurements": np.array([[1.0], [2.0], [3.0]])}, "measurements must be rows of north and east"),
    ],
)
def test_another_file_is_refused(write: Write, change: dict[str, object], sentence: str) -> None:
    with pytest.raises(TrackmeshError, match=re.escape(sentence)) as told:
        Joyride(write(**change))
    assert "\n" not in str(told.value)


def test_no_matlab_file_and_no_file(tmp_path: Path) -> None:
    (tmp_path / "text.mat").write_text("no recording")
    with pytest.raises(TrackmeshError, match=r"text\.mat is no MATLAB file"):
        Joyride(tmp_path / "text.mat")
    with pytest.raises(TrackmeshError, match=r"Cannot read .*none\.mat: No such file"):
        Joyride(tmp_path / "none.mat")


@pytest.mark.skipif(not RECORDING.exists(), reason="the Joyride recording is not here")
def test_the_recording() -> None:
    found = Joyride(RECORDING)
    batches = [record for record in found.records() if isinstance(record, PlotBatch)]
    assert len(batches) == 238 and sum(len(batch.t_ns) for batch in batches) == 432
    frames = list(found.truth())
    nearest = [
        np.linalg.norm(batch.values - frame.state[0, :2], axis=1).min()
        for batch, frame in zip(batches, frames, strict=True)
        if len(batch.t_ns)
    ]
    assert np.median(nearest) < 25.0
