"""What the live benchmark measures: latencies by hand, and one short run of real processes."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from benchmarks.live import latencies_ms, run, usage

from trackmesh.protocol.messages import PlotBatch, TrackFrame

MS = 1_000_000


def batch(*t_ms: int) -> PlotBatch:
    t_ns = np.array(t_ms, np.int64) * MS
    values = np.tile([1e4, 1.0], (len(t_ns), 1))
    return PlotBatch(sensor_id="a", boot_id="x", seq=0, t_ns=t_ns, columns=["range_m", "azimuth_rad"], values=values)


def frame(*updated_ms: int) -> TrackFrame:
    n = len(updated_ms)
    updated = np.array(updated_ms, np.int64) * MS + 700
    return TrackFrame(
        unit_id="main", boot_id="x", seq=0, t_ns=2000 * MS, track_id=np.arange(n), epoch=np.zeros(n, np.uint32),
        status=np.ones(n, np.uint8), state=np.zeros((n, 6)), covariance=np.zeros((n, 21), np.float32),
        model_probability=np.ones((n, 1)), models=["cv"], sensors=["a"], members=np.full((n, 1), -1),
        updated_t_ns=updated, first_t_ns=updated,
    )  # fmt: skip


def test_a_plot_counts_until_the_first_frame_that_contains_it() -> None:
    plots = [(1010 * MS, batch(1000, 1005)), (1020 * MS, batch(1015)), (5000 * MS, batch(4990))]
    frames = [(1011 * MS, frame(900, 950)), (1013 * MS, frame(900, 1005)), (1030 * MS, frame(1015, 1005))]
    # The plot of 1000 was in no track; that of 4990 came after the time that is measured.
    assert latencies_ms(plots, frames, (0, 4000 * MS)).tolist() == [3.0, 10.0]
    assert latencies_ms(plots, [], (0, 4000 * MS)).tolist() == []


def test_what_this_process_uses_is_told() -> None:
    before, began_s = usage(os.getpid()), time.process_time()
    while time.process_time() - began_s < 0.2:
        pass
    after = usage(os.getpid())
    assert after.cpu_s - before.cpu_s == pytest.approx(time.process_time() - began_s, abs=0.1)
    assert after.waited_s >= before.waited_s


@pytest.mark.process
def test_a_short_run() -> None:
    found = run(20, warm_up_s=18.0, measured_s=6.0)
    assert found.lost == 0
    assert len(found.latency_ms) > 20 and found.latency_ms.min() > 0.0
    assert 0.0 < found.cpu < 2.0 and found.tracks >= 15
    assert "latency p50" in found.text()
