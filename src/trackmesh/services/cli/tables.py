"""Tables for people: tracks, sensors, services, results of inversions."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from rich.table import Table

from trackmesh.protocol.messages import (
    EmiResult,
    EmiTarget,
    SensorBias,
    SensorHealth,
    SensorInfo,
    ServiceStatus,
    TagFrame,
    TrackFrame,
)

STATUS_NAMES = ("tentative", "confirmed", "coasting", "ended")
TAG_STATUS_NAMES = ("unsure", "located", "lost", "gone")


def track_table(frames: Sequence[TrackFrame], most: int = 40) -> Table:
    """One row a track: where it is, how it moves, how well that is known; heights where there are any."""
    high = any(f.height_m is not None for f in frames)
    total = sum(len(f.track_id) for f in frames)
    shown = f", the first {most}" if total > most else ""
    table = Table(title=f"{total} tracks{shown}", title_justify="left")
    for name in (
        "unit",
        "track",
        "status",
        "east km",
        "north km",
        *(["height m"] if high else []),
        "speed m/s",
        "course",
        "1 sigma m",
        "age s",
        "sensors",
    ):
        table.add_column(name, justify="left" if name in ("unit", "status", "sensors") else "right")
    rows = ((frame, row) for frame in frames for row in range(len(frame.track_id)))
    for _, (frame, row) in zip(range(most), rows, strict=False):
        table.add_row(*_track_row(frame, row, high))
    return table


def _track_row(frame: TrackFrame, row: int, high: bool) -> list[str]:
    east, north, veast, vnorth = frame.state[row, :4].tolist()
    sigma = math.sqrt(max(float(frame.covariance[row, 0] + frame.covariance[row, 6]), 0.0))
    members = [s for s, m in zip(frame.sensors, frame.members[row].tolist(), strict=True) if m >= 0]
    return [
        frame.unit_id,
        str(int(frame.track_id[row])),
        STATUS_NAMES[int(frame.status[row])],
        f"{east / 1e3:.2f}",
        f"{north / 1e3:.2f}",
        *([_height(frame, row)] if high else []),
        f"{math.hypot(veast, vnorth):.0f}",
        f"{math.degrees(math.atan2(veast, vnorth)) % 360:03.0f}",
        f"{sigma:.0f}",
        f"{(frame.t_ns - int(frame.updated_t_ns[row])) / 1e9:.1f}",
        ", ".join(members),
    ]


def _height(frame: TrackFrame, row: int) -> str:
    if frame.height_m is None or frame.height_variance_m2 is None or not frame.height_known()[row]:
        return "-"
    return f"{frame.height_m[row]:.0f} ± {math.sqrt(frame.height_variance_m2[row]):.0f}"


def tag_table(frames: Sequence[TagFrame], most: int = 40) -> Table:
    """One row a tag: where it is, how it moves, how well that is known, and who heard it."""
    total = sum(len(f.tag_id) for f in frames)
    shown = f", the first {most}" if total > most else ""
    table = Table(title=f"{total} tags{shown}", title_justify="left")
    for name in ("unit", "tag", "status", "east m", "north m", "or at m", "speed m/s", "1 sigma m", "fit", "age s"):
        table.add_column(name, justify="left" if name in ("unit", "tag", "status") else "right")
    table.add_column("readers")
    rows = ((frame, row) for frame in frames for row in np.argsort(frame.tag_id).tolist())
    for _, (frame, row) in zip(range(most), rows, strict=False):
        table.add_row(*_tag_row(frame, row))
    return table


def _tag_row(frame: TagFrame, row: int) -> list[str]:
    east, north, veast, vnorth = frame.state[row, :4].tolist()
    sigma = math.sqrt(max(float(frame.covariance[row, 0] + frame.covariance[row, 6]), 0.0))
    elsewhere = frame.other[row].tolist()
    return [
        frame.unit_id,
        frame.tag_id[row],
        TAG_STATUS_NAMES[int(frame.status[row])],
        f"{east:.1f}",
        f"{north:.1f}",
        "-" if elsewhere == [east, north] else f"{elsewhere[0]:.1f}, {elsewhere[1]:.1f}",
        f"{math.hypot(veast, vnorth):.1f}",
        f"{sigma:.1f}",
        f"{frame.quality[row]:.0%}",
        f"{(frame.t_ns - int(frame.updated_t_ns[row])) / 1e9:.1f}",
        ", ".join(frame.readers_of(row)),
    ]


def sensor_table(sensors: Iterable[SensorInfo], alive: set[str], biases: Mapping[str, SensorBias]) -> Table:
    """One row a sensor."""
    table = Table(title="Sensors", title_justify="left")
    for name in ("sensor", "alive", "kind", "site", "period s", "range km", "P detect", "sigma", "bias"):
        table.add_column(name)
    for s in sensors:
        site = "-"
        if s.site is not None:
            site = f"{s.site.latitude_deg:.4f}, {s.site.longitude_deg:.4f}"
        elif s.site_enu_m is not None:
            east, north = s.site_enu_m[:2]
            near = s.kind == "ranging"
            site = f"{east:.1f} m E, {north:.1f} m N" if near else f"{east / 1e3:.1f} km E, {north / 1e3:.1f} km N"
        sigma = ", ".join(f"{name} {value:g}" for name, value in s.sigma.items())
        alive_word = "yes" if s.sensor_id in alive else "no"
        table.add_row(
            s.sensor_id,
            alive_word,
            s.kind,
            site,
            f"{s.period_s:g}",
            f"{s.max_range_m / 1e3:g}",
            f"{s.p_detect:g}",
            sigma,
            bias_text(biases[s.sensor_id]) if s.sensor_id in biases else "-",
        )
    return table


def bias_text(bias: SensorBias) -> str:
    """``range 148 ± 9 m, azimuth 0.39 ± 0.01 deg``; in brackets where plots are not corrected by it."""
    sigma = np.sqrt(np.diag(bias.covariance))
    parts = []
    for name, value, error in zip(bias.columns, bias.bias.tolist(), sigma.tolist(), strict=True):
        what, _, unit = name.rpartition("_")
        if unit == "rad":
            parts.append(f"{what} {np.rad2deg(value):.2f} ± {np.rad2deg(error):.2f} deg")
        else:
            parts.append(f"{what} {value:.0f} ± {error:.0f} {unit}")
    if bias.time_offset_sigma_s:
        parts.append(f"clock {bias.time_offset_s:+.2f} ± {bias.time_offset_sigma_s:.2f} s")
    text = ", ".join(parts)
    return text if bias.locked else f"({text})"


def status_table(statuses: Iterable[ServiceStatus]) -> Table:
    """One row a service, and below it one a sensor it hears."""
    table = Table(title="Services", title_justify="left")
    for name in (
        "service",
        "unit",
        "state",
        "up s",
        "tracks",
        "counted",
        "refused",
        "latency ms p50 / p99",
        "told s ago",
    ):
        table.add_column(name)
    now_ns = time.time_ns()
    for s in statuses:
        latency = f"{s.latency_ms['p50']:.1f} / {s.latency_ms['p99']:.1f}" if s.latency_ms else "-"
        table.add_row(
            s.kind,
            s.unit_id,
            s.state,
            f"{s.uptime_s:.0f}",
            next((f"{s.figures[name]:.0f}" for name in ("tracks", "tags") if name in s.figures), "-"),
            _pairs(s.counters),
            _pairs(s.refused),
            latency,
            f"{(now_ns - s.t_ns) / 1e9:.1f}",
        )
        for sensor in s.sensors:
            is_unit = f"input_tracks.{sensor.sensor_id}" in s.figures
            plots, batches = ("tracks", "frames") if is_unit else ("plots", "batches")
            counted = (
                f"{sensor.plots} {plots}, {sensor.batches} {batches}, {sensor.gaps} missing, {sensor.refused} refused"
            )
            late = (
                ""
                if sensor.last_t_ns is None or s.t_ns < sensor.last_t_ns
                else f"{(s.t_ns - sensor.last_t_ns) / 1e9:.1f}"
            )
            table.add_row(f"  {sensor.sensor_id}", "", _life(sensor), "", "", counted, "", _clock(sensor), late)
    return table


def _life(sensor: SensorHealth) -> str:
    life = "alive" if sensor.alive else "gone"
    return life if sensor.silent_since_ns is None else f"{life}, silent"


def _clock(sensor: SensorHealth) -> str:
    if sensor.clock_offset_s is None:
        return ""
    drift = "" if sensor.clock_drift_ppm is None else f", {sensor.clock_drift_ppm:+.0f} ppm"
    return f"clock {sensor.clock_offset_s:+.2f} s{drift}"


def degraded_lines(statuses: Iterable[ServiceStatus]) -> list[str]:
    """What the services say is missing or wrong, a line each."""
    return [f"{s.kind} {s.unit_id}: {sentence}" for s in statuses for sentence in s.degraded]


def result_table(results: list[EmiResult]) -> Table:
    """One row a scan, and one for each target after its first."""
    table = Table(title=f"{len(results)} scans", title_justify="left")
    for name in (
        "scan",
        "status",
        "east m",
        "north m",
        "depth m",
        "1 sigma cm",
        "principal m^3",
        "shape",
        "chi2/dof",
        "reasons",
    ):
        table.add_column(name)
    for r in results:
        fit = f"{r.chi2 / r.dof:.3f}" if r.chi2 is not None and r.dof else "-"
        first = [_target_cells(target) for target in r.targets[:1]] or [["-"] * 6]
        table.add_row(f"{r.batch_id}/{r.index}", r.status, *first[0], fit, ", ".join(r.reasons) or "-")
        for target in r.targets[1:]:
            table.add_row("", "", *_target_cells(target))
    return table


def _target_cells(target: EmiTarget) -> list[str]:
    sigma = float(target.covariance[[0, 1, 2], [0, 1, 2]].sum()) ** 0.5
    east, north, _ = target.position_m
    principal = ", ".join(f"{p:.4g}" for p in target.principal_m3)
    shape = target.shape or "-"
    return [f"{east:.3f}", f"{north:.3f}", f"{target.depth_m:.3f}", f"{sigma * 100:.2f}", principal, shape]


def _pairs(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in sorted(counts.items())) or "-"
