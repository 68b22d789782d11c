"""Commands that ask or watch a running deployment: watch, tracks, sensors, status, play, invert."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.live import Live
from rich.table import Table

from trackmesh.protocol.client import Client
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter, read_records, to_line
from trackmesh.protocol.messages import EmiResult, EmiScanBatch, TrackFrame, TrackQuery
from trackmesh.services.cli.options import AsJson, Config, Connect, Realm, client, err, out, told
from trackmesh.services.cli.playback import play_records
from trackmesh.services.cli.progress import progress_bar
from trackmesh.services.cli.tables import sensor_table, status_table, track_table
from trackmesh.services.process import on_signal

Unit = Annotated[str, typer.Option("--unit", help="One unit only.")]


@told
def watch(
    unit: Unit = "*",
    as_json: AsJson = False,
    out_path: Annotated[Path | None, typer.Option("--out", help="Write the frames to TRACKS.jsonl.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", help="Stop after this time.")] = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Follow the tracks as they are published."""
    stop = threading.Event()
    deadline_s = time.monotonic() + seconds if seconds else float("inf")
    with client(connect, realm, config) as ask, on_signal(lambda _: stop.set()):
        writer = RecordWriter(out_path) if out_path else None
        try:
            with ask.watch_tracks(unit) as frames, Live(console=out, auto_refresh=False, transient=True) as live:
                while not stop.is_set() and time.monotonic() < deadline_s:
                    frame = frames.receive(timeout_s=0.2)
                    if frame is None:
                        continue
                    if writer:
                        writer.write(frame)
                    _show(frame, as_json, live)
        finally:
            if writer:
                writer.close()


def _show(frame: TrackFrame, as_json: bool, live: Live) -> None:
    if as_json:
        print(to_line(frame), flush=True)
    elif out.is_terminal:
        live.update(track_table([frame], most=max(5, out.height - 6)), refresh=True)


@told
def tracks(
    unit: Unit = "*",
    as_json: AsJson = False,
    bbox: Annotated[str | None, typer.Option("--bbox", help="East, north, east, north in metres: two corners.")] = None,
    bbox_deg: Annotated[str | None, typer.Option("--bbox-deg", help="Latitude, longitude of two corners.")] = None,
    at: Annotated[
        float | None, typer.Option("--at", help="Predict to this Unix time in seconds; +5: from now.")
    ] = None,
    track_id: Annotated[list[int] | None, typer.Option("--id", help="These tracks only.")] = None,
    max_age_s: Annotated[float | None, typer.Option("--max-age", help="Seconds since the last plot.")] = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Ask for the present picture, or for what it will be."""
    query = TrackQuery(
        track_ids=track_id or None,
        bbox_enu_m=_numbers(bbox, 4),
        bbox_deg=_numbers(bbox_deg, 4),
        max_age_s=max_age_s,
        at_t_ns=None if at is None else round(at * 1e9),
    )
    with client(connect, realm, config) as ask:
        frames = ask.query_tracks(query, unit)
    if as_json:
        for frame in frames:
            print(to_line(frame))
    else:
        out.print(track_table(frames, most=10**9))


@told
def sensors(as_json: AsJson = False, config: Config = None, connect: Connect = None, realm: Realm = None) -> None:
    """List the sensors that are there."""
    with client(connect, realm, config) as ask:
        found, alive = ask.sensors(), {ident for _, ident in ask.alive("sensor")}
    if as_json:
        print(json.dumps([s.model_dump(mode="json") | {"alive": s.sensor_id in alive} for s in found]))
    else:
        out.print(sensor_table(found, alive))


@told
def status(as_json: AsJson = False, config: Config = None, connect: Connect = None, realm: Realm = None) -> None:
    """Show how every service is: rates, refusals by reason, latency, the sensors it hears."""
    with client(connect, realm, config) as ask:
        found = ask.statuses()
    if as_json:
        print(json.dumps([s.model_dump(mode="json") for s in found]))
    else:
        out.print(status_table(found))


@told
def play(
    plots: Annotated[Path, typer.Argument(help="PLOTS.jsonl")],
    speed: Annotated[float, typer.Option("--speed", help="1: as fast as it happened; 0: as fast as possible.")] = 1.0,
    keep_time: Annotated[
        bool, typer.Option("--keep-time", help="Keep the recorded times; fusion then needs --clock data.")
    ] = False,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Publish a recording as its sensors did; at another speed than 1 fusion needs --clock data."""
    stop = threading.Event()
    with client(connect, realm, config) as ask, on_signal(lambda _: stop.set()):
        sent = play_records(ask.bus, ask.keys, list(read_records(plots)), speed, keep_time or speed != 1.0, stop)
    err.print(f"{sent} batches published", highlight=False)


@told
def invert(
    scans: Annotated[Path, typer.Argument(help="SCANS.jsonl")],
    as_json: AsJson = False,
    local: Annotated[bool, typer.Option("--local", help="Compute here, ask no service.")] = False,
    out_path: Annotated[Path | None, typer.Option("--out", help="Write the results as JSON lines.")] = None,
    unit: Unit = "*",
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Ask the EMI service where the targets of a batch of scans are."""
    batches = [record for record in read_records(scans, EmiScanBatch) if isinstance(record, EmiScanBatch)]
    if local:
        results = [result for batch in batches for result in _invert_here(batch)]
    else:
        with client(connect, realm, config) as ask:
            results = [result for batch in batches for result in _invert_there(ask, batch, unit)]
    if out_path:
        with RecordWriter(out_path) as file:
            for result in results:
                file.write(result)
    if as_json:
        for result in results:
            print(to_line(result))
    else:
        out.print(result_table(results))


def _invert_there(ask: Client, batch: EmiScanBatch, unit: str) -> list[EmiResult]:
    results = []
    with progress_bar(batch.batch_id, len(batch.field)) as advance:
        for result in ask.invert(batch, unit):
            results.append(result)
            advance(len(results))
    return results


def _invert_here(batch: EmiScanBatch) -> list[EmiResult]:
    from trackmesh.services.emi.convert import to_message, to_request
    from trackmesh.services.emi.engine import invert as work
    from trackmesh.services.emi.settings import EmiSettings

    results = []
    with progress_bar(batch.batch_id, len(batch.field)) as advance:
        for result in work(*to_request(batch, EmiSettings().lr_threshold)):
            results.append(to_message(batch, result))
            advance(len(results))
    return results


def result_table(results: list[EmiResult]) -> Table:
    """One row a scan."""
    table = Table(title=f"{len(results)} scans", title_justify="left")
    for name in (
        "scan",
        "status",
        "east m",
        "north m",
        "depth m",
        "1 sigma cm",
        "principal m^3",
        "chi2/dof",
        "reasons",
    ):
        table.add_column(name)
    for r in results:
        place = ["-", "-", "-", "-", "-"]
        if r.targets:
            t = r.targets[0]
            sigma = float(t.covariance[[0, 1, 2], [0, 1, 2]].sum()) ** 0.5
            principal = ", ".join(f"{p:.4g}" for p in t.principal_m3)
            place = [
                f"{t.position_m[0]:.3f}",
                f"{t.position_m[1]:.3f}",
                f"{t.depth_m:.3f}",
                f"{sigma * 100:.2f}",
                principal,
            ]
        fit = f"{r.chi2 / r.dof:.3f}" if r.chi2 is not None and r.dof else "-"
        table.add_row(f"{r.batch_id}/{r.index}", r.status, *place, fit, ", ".join(r.reasons) or "-")
    return table


def _numbers(text: str | None, count: int) -> list[float] | None:
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise TrackmeshError(f"{text!r} must be {count} numbers separated by commas.")
    return numbers
