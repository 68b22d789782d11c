"""What the demo knows and shows: a live table, and a report at the end."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import NamedTuple

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.bus import Bus
from trackmesh.protocol.client import Watch
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import COASTING, CONFIRMED, EmiResult, ServiceStatus, TrackFrame, TruthFrame
from trackmesh.services.cli.demo_tags import TagState
from trackmesh.sim.coverage import Coverage, PictureAtEnd, picture_at_end
from trackmesh.sim.metrics import gospa
from trackmesh.sim.radar import sensor_info
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.scoring import TruthTimeline
from trackmesh.sim.truth import World

_REFRESH_S = 0.5
_RATE_WINDOW_S = 5.0
_TRUTH_KEPT = 8


def watch_truth(bus: Bus, keys: Keys) -> Watch[TruthFrame]:
    """The truth as it is published."""
    return Watch(bus.subscribe(keys.truth("*"), capacity=4096), TruthFrame)


class DemoState:
    """What was heard so far."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.frames: list[TrackFrame] = []
        self.truth: list[TruthFrame] = []
        self.statuses: dict[tuple[str, str], ServiceStatus] = {}
        self.gospa_m = math.nan
        self.emi: list[EmiResult] = []
        self.emi_truth_m: FloatArray = np.empty((0, 3))
        self.emi_error = ""
        self.tags: TagState | None = None
        self._started_s = time.monotonic()
        self._shown_s = -math.inf
        self._plots: deque[tuple[float, int]] = deque()

    def begin(self) -> None:
        """The sensors start now."""
        self._started_s = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the sensors started."""
        return time.monotonic() - self._started_s

    def over(self) -> bool:
        """Whether the time is up."""
        return 0 < self.seconds <= self.elapsed_s

    def refresh_due(self) -> bool:
        """Whether to draw anew."""
        if time.monotonic() - self._shown_s < _REFRESH_S:
            return False
        self._shown_s = time.monotonic()
        return True

    def take_status(self, status: ServiceStatus) -> None:
        """Note how a service is."""
        self.statuses[status.kind, status.unit_id] = status
        if status.kind == "fusion":
            self._plots.append((time.monotonic(), status.counters.get("plots", 0)))
            while self._plots[0][0] < time.monotonic() - _RATE_WINDOW_S and len(self._plots) > 2:
                self._plots.popleft()

    def take_truth(self, truth: TruthFrame) -> None:
        """Note the truth."""
        self.truth.append(truth)

    def take_frame(self, frame: TrackFrame) -> None:
        """Note a picture, and score it."""
        self.frames.append(frame)
        if len(self.truth) < 2:
            return
        # Frames run ahead of the truth by a little: it is extended by its velocity.
        last = self.truth[-1]
        dt_s = (frame.t_ns - last.t_ns) / 1e9
        targets = last.state[:, :2] + dt_s * last.state[:, 2:4]
        self.gospa_m = gospa(targets, _shown(frame)).total_m

    def plots_per_s(self) -> float:
        """Plots that the fusion service took, a second, of late."""
        if len(self._plots) < 2:
            return math.nan
        (t0, n0), (t1, n1) = self._plots[0], self._plots[-1]
        return (n1 - n0) / (t1 - t0) if t1 > t0 else math.nan


class Report(NamedTuple):
    """The end of a demo: its table, the share of targets tracked once, and an error sentence or nothing."""

    table: RenderableType
    share: float
    error: str


def demo_panel(state: DemoState) -> RenderableType:
    """The live table."""
    table = Table(title="trackmesh demo", title_justify="left", show_header=False)
    last = state.frames[-1] if state.frames else None
    left = f" of {state.seconds:.0f}" if state.seconds else ", until Ctrl-C"
    table.add_row("seconds", f"{state.elapsed_s:.0f}{left}")
    table.add_row("targets", str(len(state.truth[-1].id)) if state.truth else "-")
    table.add_row("tracks", str(len(_shown(last))) if last else "-")
    table.add_row("GOSPA", _known(state.gospa_m, "m (c = 1000 m)"))
    table.add_row("plots", _known(state.plots_per_s(), "a second"))
    table.add_row("plot to picture", _latency(state))
    table.add_row("EMI", _emi_line(state))
    table.add_row("tags", state.tags.line() if state.tags else "-")
    return Group(table, _service_table(state))


def demo_report(state: DemoState, world: Scenario, seed: int) -> Report:
    """The table at the end."""
    table = Table(title="trackmesh demo: the end", title_justify="left", show_header=False)
    share, error = math.nan, ""
    try:
        end = _picture(state, world, seed)
        share = end.share
        table.add_row("targets in coverage", str(end.targets))
        table.add_row("with exactly one track", f"{end.tracked_once} ({end.share:.1%})")
        table.add_row("tracks of no target", str(end.stray_tracks))
        table.add_row("switches of quiet targets", f"{end.quiet_switches} on {end.quiet_targets} targets")
    except TrackmeshError as problem:
        error = str(problem)
    table.add_row("GOSPA of the last frame", _known(state.gospa_m, "m (c = 1000 m)"))
    table.add_row("plot to picture", _latency(state))
    table.add_row("frames", str(len(state.frames)))
    table.add_row("EMI", _emi_line(state))
    table.add_row("tags", state.tags.line() if state.tags else "-")
    return Report(table, share, error or state.emi_error)


def _picture(state: DemoState, world: Scenario, seed: int) -> PictureAtEnd:
    last_s = (state.truth[-1].t_ns - state.truth[0].t_ns) / 1e9 if state.truth else 0.0
    truth = World(world, seed).truth(last_s + 60.0)
    coverage = Coverage.of(sensor_info(world, radar) for radar in world.radars)
    return picture_at_end(state.frames, TruthTimeline(state.truth), coverage, truth.quiet_ids)


def _shown(frame: TrackFrame) -> FloatArray:
    shown = (frame.status == CONFIRMED) | (frame.status == COASTING)
    return np.asarray(frame.state[shown, :2])


def _known(value: float, unit: str) -> str:
    return f"{value:.0f} {unit}" if math.isfinite(value) else "-"


def _latency(state: DemoState) -> str:
    for (kind, _), status in state.statuses.items():
        if kind == "fusion" and status.latency_ms:
            return ", ".join(f"{name} {value:.0f} ms" for name, value in status.latency_ms.items())
    return "-"


def _emi_line(state: DemoState) -> str:
    if state.emi_error:
        return state.emi_error
    if not state.emi:
        return "-"
    found = [r for r in state.emi if r.targets]
    off = [
        math.dist(r.targets[0].position_m, state.emi_truth_m[r.index]) * 100
        for r in found
        if r.index < len(state.emi_truth_m)
    ]
    worst = f", at most {max(off):.1f} cm off" if off else ""
    return f"{len(state.emi)} scans inverted, {len(found)} targets{worst}"


def _service_table(state: DemoState) -> Table:
    table = Table("service", "unit", "state", "counted", "refused")
    for (kind, unit), s in sorted(state.statuses.items()):
        counted = ", ".join(f"{name} {n}" for name, n in sorted(s.counters.items()))
        refused = ", ".join(f"{name} {n}" for name, n in sorted(s.refused.items()))
        table.add_row(kind, unit, s.state, counted or "-", refused or "-")
    return table
