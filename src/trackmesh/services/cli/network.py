"""Commands that ask or watch a running deployment: watch, tracks, sensors, status, play."""

from __future__ import annotations

import json
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError
from rich.console import Group
from rich.live import Live
from rich.text import Text

from trackmesh.protocol.client import LatestFrames, Watch
from trackmesh.protocol.codec import refusal
from trackmesh.protocol.files import RecordWriter, read_records, to_line
from trackmesh.protocol.keys import last_chunk
from trackmesh.protocol.merging import without_doubles
from trackmesh.protocol.messages import TagFrame, TrackFrame, TrackQuery
from trackmesh.services.cli.attention import Attention, routers_down
from trackmesh.services.cli.options import (
    AsJson,
    Config,
    Connect,
    Realm,
    Unit,
    client,
    corners,
    endpoints,
    instant_ns,
    out,
    reach,
    say,
    told,
)
from trackmesh.services.cli.playback import play_records
from trackmesh.services.cli.tables import degraded_lines, sensor_table, status_table, tag_table, track_table
from trackmesh.services.process import on_signal


@told
def watch(
    unit: Unit = "*",
    only_tags: Annotated[bool, typer.Option("--tags", help="Follow the tags instead of the tracks.")] = False,
    as_json: AsJson = False,
    out_path: Annotated[
        Path | None, typer.Option("--out", metavar="TRACKS.jsonl", help="Write the frames to a file.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option("--seconds", min=0.0, metavar="S", help="Stop after this time.")
    ] = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Follow the tracks as they are published.

    On a terminal as one table of the tracks of all units, tags below; into a pipe, unless there is --out, as JSON lines
    of tracks, or with --tags of tags.
    """
    as_json = as_json or not (out.is_terminal or out_path)
    stop = threading.Event()
    deadline_s = float("inf") if seconds is None else time.monotonic() + seconds
    with ExitStack() as opened:
        ask = opened.enter_context(client(connect, realm, config))
        opened.enter_context(on_signal(lambda _: stop.set()))
        writer = opened.enter_context(RecordWriter(out_path)) if out_path else None
        watched: list[Watch[TrackFrame] | Watch[TagFrame]] = []
        if not only_tags:
            watched.append(opened.enter_context(ask.watch_tracks(unit)))
        if only_tags or not (as_json or out_path):
            watched.append(opened.enter_context(ask.watch_tags(unit)))
        live = opened.enter_context(Live(console=out, auto_refresh=False, transient=True))
        statuses = opened.enter_context(ask.watch_statuses())
        seen, alive = Seen(Attention(ask.bus.links)), ask.watch_units()
        opened.callback(alive.close)
        while not stop.is_set() and time.monotonic() < deadline_s:
            while (status := statuses.receive(timeout_s=0)) is not None:
                seen.attention.take(status)
            while (event := alive.receive(timeout_s=0)) is not None:
                seen.units.note_alive(last_chunk(event.key), event.alive)
            if out.is_terminal and not as_json:
                live.update(seen.tables(max(5, out.height - 6)), refresh=True)
            for frames in watched:
                frame = frames.receive(timeout_s=0.2 / len(watched))
                if frame is None:
                    continue
                if writer:
                    writer.write(frame)
                if as_json:
                    print(to_line(frame), flush=True)
                else:
                    seen.take(frame)


class Seen:
    """The last frames heard, for the eye: one picture of the tracks of all units; below, what is missing or wrong."""

    def __init__(self, attention: Attention) -> None:
        self.attention = attention
        self.units = LatestFrames()
        self._tags: TagFrame | None = None

    def take(self, frame: TrackFrame | TagFrame) -> None:
        """Note a frame."""
        if isinstance(frame, TagFrame):
            self._tags = frame
        else:
            self.units.update(frame)

    def tables(self, most: int) -> Group:
        """Tracks and tags, as many rows as there is room for."""
        wrong = [Text(line, style="yellow") for line in self.attention.lines()]
        most, frames = max(3, most - len(wrong)), self.units.frames()
        share = most if not frames or self._tags is None else most // 2 - 2
        tables = [track_table(frames, most=share)] if frames else []
        return Group(*tables, *([] if self._tags is None else [tag_table([self._tags], most=share)]), *wrong)


@told
def tracks(
    unit: Unit = "*",
    as_json: AsJson = False,
    bbox: Annotated[
        str | None, typer.Option("--bbox", metavar="E,N,E,N", help="Two corners, metres east and north.")
    ] = None,
    bbox_deg: Annotated[
        str | None, typer.Option("--bbox-deg", metavar="LAT,LON,LAT,LON", help="Two corners, degrees.")
    ] = None,
    at: Annotated[
        str | None, typer.Option("--at", metavar="S", help="Predict to this Unix time in seconds; +5: 5 s from now.")
    ] = None,
    track_id: Annotated[list[int] | None, typer.Option("--id", metavar="ID", help="This track; repeatable.")] = None,
    max_age_s: Annotated[
        float | None, typer.Option("--max-age", min=0.0, metavar="S", help="Seconds since the last plot, at most.")
    ] = None,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Ask for the picture, as it is or as it will be."""
    try:
        query = TrackQuery(
            track_ids=track_id or None,
            bbox_enu_m=corners(bbox, "--bbox"),
            bbox_deg=corners(bbox_deg, "--bbox-deg"),
            max_age_s=max_age_s,
            at_t_ns=instant_ns(at, "--at"),
        )
    except ValidationError as error:
        raise refusal("TrackQuery", error) from None
    with client(connect, realm, config) as ask:
        frames = without_doubles(ask.query_tracks(query, unit))
    if as_json:
        for frame in frames:
            print(to_line(frame))
    else:
        out.print(track_table(frames, most=10**9))


@told
def sensors(as_json: AsJson = False, config: Config = None, connect: Connect = None, realm: Realm = None) -> None:
    """List the sensors that are there, and their biases."""
    with client(connect, realm, config) as ask:
        found, alive = ask.sensors(), {ident for _, ident in ask.alive("sensor")}
        biases = {bias.sensor_id: bias for one in ask.registrations() for bias in one.sensors}
    if as_json:
        rows = []
        for s in found:
            bias = biases[s.sensor_id].model_dump(mode="json") if s.sensor_id in biases else None
            rows.append(s.model_dump(mode="json") | {"alive": s.sensor_id in alive, "registration": bias})
        print(json.dumps(rows))
    else:
        out.print(sensor_table(found, alive, biases))


@told
def status(as_json: AsJson = False, config: Config = None, connect: Connect = None, realm: Realm = None) -> None:
    """Show how every service is.

    What it counted, what it refused and why, its latency, the sensors it hears, and what is missing or wrong.
    """
    with client(connect, realm, config) as ask:
        found = ask.statuses()
    if as_json:
        print(json.dumps([s.model_dump(mode="json") for s in found]))
        return
    out.print(status_table(found))
    for line in routers_down(endpoints(connect, config), lambda one: reach(one, config)) + degraded_lines(found):
        out.print(line, style="yellow", highlight=False, markup=False)


@told
def play(
    plots: Annotated[Path, typer.Argument(metavar="PLOTS.jsonl", help="A recording, of plots or of ranges.")],
    speed: Annotated[
        float,
        typer.Option("--speed", min=0.0, metavar="X", help="1: as fast as it happened; 0: as fast as possible."),
    ] = 1.0,
    keep_time: Annotated[
        bool, typer.Option("--keep-time", help="Keep the recorded times; fusion then needs --clock data.")
    ] = False,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Publish a recording as its sensors did.

    At another speed than 1 the recorded times are kept, and the services need --clock data.
    """
    # All of it first: what is wrong with the file is told before anything is published.
    records, stop = list(read_records(plots)), threading.Event()
    with client(connect, realm, config) as ask, on_signal(lambda _: stop.set()):
        sent = play_records(ask.bus, ask.keys, records, speed, keep_time or speed != 1.0, stop)
    say(f"{sent} batches published")
