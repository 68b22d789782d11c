"""Tracks kept over a restart: the engine that goes on gives the frames that it would have given without one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.network.processes import wait_until
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    drive,
    engine,
    in_time_order,
    live,
    ns,
    position_sensor,
    scans,
)
from tests.services.fusion.running import Running

from trackmesh.protocol.codec import encode
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import PlotBatch, TrackFrame
from trackmesh.services.fusion import snapshot
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.offline import OfflineRun
from trackmesh.services.fusion.settings import EngineSettings

AIS = position_sensor()


def batches(until_s: float = 80.0) -> list[PlotBatch]:
    return in_time_order(
        scans(NORTH, FAR_APART, until_s),
        scans(EAST, FAR_APART, until_s, offset_s=0.7, seed=2),
        scans(AIS, FAR_APART, until_s, offset_s=0.3, seed=3),
    )


def again(tracker: FusionEngine) -> FusionEngine:
    """The engine of a new process, which knows only the bytes of a file."""
    kept = tracker.snapshot()
    assert kept is not None
    out = FusionEngine(tracker.settings, Unit("main", 3, "next", 1))
    out.restore(snapshot.from_bytes(snapshot.to_bytes(kept)))
    return out


@pytest.mark.parametrize("at", [3, 25, 60])
@pytest.mark.parametrize("choice", [{}, {"filter": "tvimm-dirichlet", "lag": 2}, {"filter": "alpha-beta"}])
def test_frames_go_on_as_if_nothing_had_happened(at: int, choice: dict[str, Any]) -> None:
    tracker = engine(NORTH, EAST, AIS, registration=False, **choice)
    drive(tracker, batches()[:at])
    restored = again(tracker)
    for one, other in zip(drive(tracker, batches()[at:]), drive(restored, batches()[at:]), strict=True):
        for name in ("track_id", "state", "covariance", "status", "model_probability", "first_t_ns", "updated_t_ns"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_late_plots_are_replayed_over_a_restart() -> None:
    early, late, rest = batches()[:30], batches()[30:31], batches()[31:]
    tracker = engine(NORTH, EAST, AIS, registration=False)
    drive(tracker, early + rest[:6])
    restored = again(tracker)
    one, other = drive(tracker, late + rest[6:]), drive(restored, late + rest[6:])
    assert np.array_equal(one[-1].state, other[-1].state)


def test_biases_and_clutter_come_along() -> None:
    from tests.services.fusion.test_engine_registration import biased, both

    tracker = engine(NORTH, EAST)
    drive(tracker, both(60.0, biased))
    restored = again(tracker)
    assert restored.corrections.biases is not None
    assert [one.locked for one in restored.corrections.biases.messages()] == [True, True]
    for name, sensor in tracker.sensors.items():
        assert restored.sensors[name].system_clutter.whole() == sensor.system_clutter.whole()


def test_after_a_long_pause_tracks_are_lost_but_keep_their_numbers_if_they_are_found_again() -> None:
    tracker = engine(NORTH, EAST, AIS)
    before = live(drive(tracker, [b for b in batches(90.0) if b.t_ns[0] < ns(40.0)])[-1])
    restored = again(tracker)
    told = restored.tick(ns(58.0))
    assert told is not None
    assert not live(told), "too old for the picture"
    frames = drive(restored, [b for b in batches(90.0) if b.t_ns[0] >= ns(58.0)])
    assert live(frames[-1]) == before
    # What is lost is kept as well.
    twice = again(restored)
    assert twice.snapshot() is not None


def test_no_number_is_used_twice() -> None:
    tracker = engine(NORTH, EAST, AIS, stitch_s=0.0)
    before = live(drive(tracker, batches(40.0))[-1])
    restored = again(tracker)
    restored.tick(ns(500.0))
    later = [b.model_copy(update={"t_ns": b.t_ns + ns(500.0) - ns(0.0)}) for b in batches(40.0)]
    after = live(drive(restored, later)[-1])
    assert len(after) == 4
    assert not after & before


def test_nothing_is_known_before_any_data() -> None:
    assert engine(NORTH).snapshot() is None


def test_other_settings_are_refused() -> None:
    tracker = engine(NORTH, EAST, AIS)
    drive(tracker, batches(20.0))
    kept = tracker.snapshot()
    assert kept is not None
    with pytest.raises(TrackmeshError, match="other settings"):
        FusionEngine(EngineSettings(coast_s=16.0), Unit()).restore(kept)


def good() -> bytes:
    tracker = engine(NORTH, EAST, AIS)
    drive(tracker, batches(20.0))
    kept = tracker.snapshot()
    assert kept is not None
    return snapshot.to_bytes(kept)


def test_damaged_files_are_refused_in_one_sentence() -> None:
    data, rng = good(), np.random.default_rng(1)
    cases = [b"", b"PK", b"\x00" * 1000, data[: len(data) // 2], data[:-40]]
    for _ in range(60):
        hurt = bytearray(data)
        for place in rng.integers(0, len(data), 8).tolist():
            hurt[place] = int(rng.integers(256))
        cases.append(bytes(hurt))
    refused = 0
    for case in cases:
        try:
            FusionEngine(EngineSettings(), Unit()).restore(snapshot.from_bytes(case))
        except TrackmeshError:
            refused += 1
    assert refused >= 5


def test_arrays_of_another_shape_are_refused() -> None:
    kept = snapshot.from_bytes(good())
    for name in ("system/filters/head", "system/life/score", "local/1/filters/ring"):
        for value in (None, kept.arrays[name][:-1], kept.arrays[name].view(np.uint8)):
            arrays = {k: v for k, v in kept.arrays.items() if k != name}
            if value is not None:
                arrays[name] = value
            with pytest.raises(TrackmeshError, match="state"):
                FusionEngine(EngineSettings(), Unit()).restore(kept._replace(arrays=arrays))


# --- the service ---


def run(sent: list[PlotBatch], **settings: Any) -> tuple[list[TrackFrame], dict[str, int]]:
    with Running("data", **settings) as running:
        for info in (NORTH, EAST, AIS):
            running.sensor(info)
        for one in sent:
            running.plots(one.sensor_id, one)
        running.settle()
        wait_until(lambda: running.accepted == 0 or settings["state_file"].exists(), "the state is written")
        frames = list(iter(lambda: running.frames.receive(0.2), None))
        return frames, running.refused


def test_a_service_goes_on_with_its_tracks_and_takes_nothing_twice(tmp_path: Path) -> None:
    file, box = tmp_path / "state.npz", tmp_path / "box.jsonl"
    sent = batches()
    first, _ = run(sent[:40], state_file=file, state_every_s=0.01)
    assert len(live(first[-1])) == 4
    second, refused = run(sent[30:], state_file=file, black_box=box)
    assert sum(refused.values()) == 10, "batches that the first run took"
    assert live(second[-1]) == live(first[-1])
    assert all(live(frame) == live(first[-1]) for frame in second)
    offline = OfflineRun(EngineSettings())
    again = list(offline.frames(read_records(box)))
    assert [encode(frame) for frame in again] == [encode(frame) for frame in second]


def test_a_state_that_cannot_be_used_costs_the_tracks_and_no_more(tmp_path: Path) -> None:
    file = tmp_path / "state.npz"
    file.write_bytes(b"nothing of ours")
    frames, _ = run(batches(40.0), state_file=file)
    assert len(live(frames[-1])) == 4
