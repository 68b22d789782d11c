"""Commands of tags: the service, simulated readers, a recording located without a network."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.table import Table

from trackmesh.protocol.files import RecordWriter, read_records
from trackmesh.protocol.messages import TagFrame, TruthFrame
from trackmesh.services.cli.files import convert, records_of
from trackmesh.services.cli.options import (
    AsJson,
    Config,
    Connect,
    LogFormat,
    LogLevel,
    Realm,
    Scenario,
    Seed,
    UnitId,
    out,
    say,
    told,
)
from trackmesh.services.cli.services import StartEvery, StartNs, given, run_simulator, sim, world_time_ns
from trackmesh.services.runtime import ServiceRuntime

if TYPE_CHECKING:
    from trackmesh.sim.tag_scores import TagScore

TruthFile = Annotated[Path | None, typer.Option("--truth", metavar="TRUTH.jsonl", help="File to write.")]


@told
def tags(
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    unit_id: UnitId = None,
    readers: Annotated[
        Path | None,
        typer.Option("--readers", metavar="FILE.toml", help="Where readers stand; others say so by themselves."),
    ] = None,
    clock: Annotated[
        Literal["wall", "data"] | None,
        typer.Option("--clock", help="wall: ranges are of now; data: they bring their own time (replays)."),
    ] = None,
    black_box: Annotated[
        Path | None,
        typer.Option("--black-box", metavar="FILE", help="Record the engine's inputs, for trackmesh locate."),
    ] = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Run a tag service: ranges in, places of tags out."""
    from trackmesh.services.tags.service import run
    from trackmesh.services.tags.settings import TagSettings

    flags = given(
        connect=connect, realm=realm, unit_id=unit_id, readers=readers, clock=clock, black_box=black_box,
        log_level=log_level, log_format=log_format,
    )  # fmt: skip
    raise typer.Exit(run(TagSettings.load(config, flags)))


@sim.command("tags")
@told
def sim_tags(
    scenario: Scenario = "rfid19",
    seed: Seed = 1,
    start_ns: StartNs = None,
    start_every: StartEvery = None,
    announce: Annotated[
        bool, typer.Option("--announce/--silent", help="Whether the readers say where they stand.")
    ] = True,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
    log_level: LogLevel = None,
    log_format: LogFormat = None,
) -> None:
    """Be the readers of tags that are carried about."""
    from trackmesh.sim.live import run_tags
    from trackmesh.sim.scenario import load_scenario

    world, (begin_ns, end_ns) = load_scenario(scenario), world_time_ns(start_ns, start_every)
    network_id = world.heard_tags().network_id

    def work(runtime: ServiceRuntime) -> None:
        run_tags(
            runtime.bus, world, seed, begin_ns, runtime.stopping, announce=announce, keys=runtime.keys,
            boot_id=runtime.boot_id,
        )  # fmt: skip

    flags = given(connect=connect, realm=realm, log_level=log_level, log_format=log_format)
    run_simulator("sim-tags", network_id, flags, config, work, end_ns)


@sim.command("ranges")
@told
def sim_ranges(
    ranges: Annotated[Path, typer.Argument(metavar="RANGES.jsonl", help="File to write.")],
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH.jsonl", help="File to write.")] = None,
    scenario: Scenario = "rfid19",
    seed: Seed = 1,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0.0, metavar="S", help="How much of the scenario; default: all of it."),
    ] = None,
) -> None:
    """Record what readers would hear of tags. The same seed gives the same bytes."""
    from trackmesh.sim.recording import write_ranges
    from trackmesh.sim.scenario import load_scenario

    world = load_scenario(scenario)
    count = write_ranges(world, seed, ranges, truth, duration_s=seconds)
    say(f"{count} ranges of {world.name}, seed {seed}, in {ranges}")


@convert.command("plaza")
@told
def convert_plaza(
    mat: Annotated[Path, typer.Argument(metavar="PLAZA.mat", help="Plaza1.mat or Plaza2.mat.")],
    out_path: Annotated[Path, typer.Option("--out", metavar="RANGES.jsonl", help="File to write.")],
    truth: TruthFile = None,
) -> None:
    """Plaza ranging radios. The four beacons become readers, the robot a tag."""
    from trackmesh.sim.plaza import convert_plaza as work

    say(f"{work(mat, out_path, truth)} ranges in {out_path}")


@told
def locate(
    ranges: Annotated[Path, typer.Argument(metavar="RANGES.jsonl", help="A recording, or a black box.")],
    truth: Annotated[
        Path | None, typer.Argument(metavar="TRUTH.jsonl", help="Where the tags really were: the errors are told.")
    ] = None,
    out_path: Annotated[Path | None, typer.Option("--out", metavar="TAGS.jsonl", help="Write the frames here.")] = None,
    as_json: AsJson = False,
    config: Config = None,
) -> None:
    """Locate the tags of a recording, without a network. The same engine as live, and the same frames."""
    from trackmesh.services.tags.offline import OfflineRun
    from trackmesh.services.tags.settings import TagSettings
    from trackmesh.sim.tag_scores import TagTruth, score_tags

    settings = TagSettings.load(config)
    run = OfflineRun(settings.engine, settings.unit_id, settings.origin)
    known = TagTruth(records_of(truth, TruthFrame)) if truth else None
    started_s = time.process_time()
    frames = list(_written(run.frames(read_records(ranges)), out_path))
    spent_s = time.process_time() - started_s
    counted = ", ".join(f"{name} {n}" for name, n in sorted((run.engine.counts() | run.refused).items()) if n)
    say(f"{len(frames)} frames{f' in {out_path}' if out_path else ''}, {spent_s:.1f} s of CPU; {counted}")
    if known is None:
        return
    scores = score_tags(frames, known)
    if as_json:
        print(json.dumps([_finite(asdict(score)) for score in scores]))
    else:
        out.print(_score_table(scores))


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN."""
    return {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in row.items()}


def _score_table(scores: list[TagScore]) -> Table:
    table = Table("tag", "frames", "located", "RMS m", "median m", "95 % m", "worst m", "NEES / 2")
    for s in scores:
        numbers = (s.rms_m, s.median_m, s.p95_m, s.worst_m, s.nees)
        table.add_row(s.tag, str(s.frames), f"{s.located:.1%}", *(_number(value) for value in numbers))
    return table


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def _written(frames: Iterator[TagFrame], path: Path | None) -> Iterator[TagFrame]:
    if path is None:
        yield from frames
        return
    with RecordWriter(path) as file:
        for frame in frames:
            file.write(frame)
            yield frame
