"""A scenario written to files: plots in order of arrival, and the truth.

The same scenario and seed give the same bytes.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from itertools import islice, takewhile
from pathlib import Path

from trackmesh.protocol.files import RecordWriter
from trackmesh.protocol.messages import PlotBatch, TruthFrame
from trackmesh.sim.radar import DueBatch, radar_batches, sensor_info
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.tags import TagWorld, reader_infos
from trackmesh.sim.truth import World, truth_frame

START_NS = 1_735_689_600_000_000_000
"""When recordings begin, if nothing else is said: 2025-01-01 00:00 UTC."""

TRUTH_PERIOD_S = 0.5


def recorded_batches(
    scenario: Scenario, seed: int, *, duration_s: float | None = None, start_ns: int = START_NS
) -> Iterator[PlotBatch]:
    """The batches of all radars as they arrive, each when its sector is done, within the scenario's duration."""
    world = World(scenario, seed)
    end_ns = start_ns + round(1e9 * (scenario.duration_s if duration_s is None else duration_s))

    def until_end(due: DueBatch) -> bool:
        return due.due_ns <= end_ns

    streams = [
        takewhile(until_end, radar_batches(world, radar, boot_id=f"sim-{seed}", start_ns=start_ns))
        for radar in scenario.radars
    ]
    for due in heapq.merge(*streams, key=lambda due: due.due_ns):
        yield due.batch


def recorded_truth(
    scenario: Scenario, seed: int, *, duration_s: float | None = None, start_ns: int = START_NS
) -> Iterator[TruthFrame]:
    """The truth every half second from the start, both ends included."""
    world = World(scenario, seed)
    steps = round((scenario.duration_s if duration_s is None else duration_s) / TRUTH_PERIOD_S)
    for k in range(steps + 1):
        yield truth_frame(world, k * TRUTH_PERIOD_S, start_ns)


def write_recording(
    scenario: Scenario,
    seed: int,
    path_plots: Path,
    path_truth: Path | None = None,
    *,
    duration_s: float | None = None,
    start_ns: int = START_NS,
    progress: Callable[[float], None] | None = None,
) -> int:
    """Write PLOTS.jsonl and, where wanted, TRUTH.jsonl; returns the number of plots.

    ``progress`` is called with the seconds of the scenario that are written.

    Raises:
        TrackmeshError: a file cannot be written.
    """
    n_plots = 0
    with RecordWriter(path_plots) as out:
        out.write(scenario.origin)
        for radar in scenario.radars:
            out.write(sensor_info(scenario, radar))
        for batch in recorded_batches(scenario, seed, duration_s=duration_s, start_ns=start_ns):
            out.write(batch)
            n_plots += len(batch.t_ns)
            if progress is not None and len(batch.t_ns):
                progress((int(batch.t_ns[-1]) - start_ns) * 1e-9)
    if path_truth is not None:
        with RecordWriter(path_truth) as out:
            for frame in recorded_truth(scenario, seed, duration_s=duration_s, start_ns=start_ns):
                out.write(frame)
    return n_plots


def write_ranges(
    scenario: Scenario,
    seed: int,
    path_ranges: Path,
    path_truth: Path | None = None,
    *,
    duration_s: float | None = None,
    start_ns: int = START_NS,
) -> int:
    """Write RANGES.jsonl and, where wanted, TRUTH.jsonl of the tags; returns the number of ranges.

    Raises:
        TrackmeshError: the scenario has no tags, or a file cannot be written.
    """
    world = TagWorld(scenario, seed)
    seconds = scenario.duration_s if duration_s is None else duration_s
    n_ranges, ticks = 0, round(seconds / world.tags.tick_s) + 1
    with RecordWriter(path_ranges) as out:
        out.write(scenario.origin)
        for info in reader_infos(scenario):
            out.write(info)
        for batch in islice(world.batches(boot_id=f"sim-{seed}", start_ns=start_ns), ticks):
            out.write(batch)
            n_ranges += len(batch.t_ns)
    if path_truth is not None:
        with RecordWriter(path_truth) as out:
            for k in range(round(seconds / TRUTH_PERIOD_S) + 1):
                out.write(world.truth_frame(k * TRUTH_PERIOD_S, start_ns))
    return n_ranges
