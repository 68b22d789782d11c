"""``trackmesh demo``: the whole system on one machine, every part a process of its own."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.live import Live

from trackmesh.protocol.client import Client, Watch
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter
from trackmesh.protocol.messages import ServiceStatus, TrackFrame, TruthFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.children import Children
from trackmesh.services.cli.demo_view import DemoState, demo_panel, demo_report, watch_truth
from trackmesh.services.cli.files import records_of
from trackmesh.services.cli.options import err, fail, out, told
from trackmesh.services.process import on_signal
from trackmesh.sim.drawing import draw_tracks
from trackmesh.sim.emi import scenario_scans
from trackmesh.sim.scenario import Scenario, load_scenario

TRACKS, TRUTH = "tracks.jsonl", "truth.jsonl"

_READY_S = 240.0
_ENDED_WELL = 0.95


@told
def demo(
    seconds: Annotated[float, typer.Option("--seconds", help="How long; 0: until Ctrl-C.")] = 60.0,
    scenario: Annotated[str, typer.Option("--scenario", help="A scenario's name, or a TOML file.")] = "two-radars",
    seed: Annotated[int, typer.Option("--seed", help="Everything random follows from it.")] = 1,
    out_path: Annotated[
        Path, typer.Option("--out", help="Folder for the picture, the recordings and the logs.")
    ] = Path("out/demo"),
    port: Annotated[int | None, typer.Option("--port", help="Port of the router; default: a free one.")] = None,
) -> None:
    """Run router, two radars, fusion and EMI as processes on this machine, and watch them."""
    world = load_scenario(scenario)
    folder = _folder(out_path)
    stop = threading.Event()
    with on_signal(lambda _: stop.set()), Children(folder) as children:
        endpoint = f"tcp/127.0.0.1:{port or _free_port()}"
        state = _run(scenario, seed, seconds, endpoint, folder, children, stop)
        bad = children.stop()
    report = demo_report(state, world, seed)
    out.print(report.table)
    draw_tracks(
        records_of(folder / TRACKS, TrackFrame), records_of(folder / TRUTH, TruthFrame), out=folder / "tracks.png"
    )
    err.print(f"picture, recordings and logs in {folder}", highlight=False)
    if report.error:
        fail(report.error)
    if bad:
        fail(f"These processes did not end well: {', '.join(bad)}.")
    if seconds >= 45 and not stop.is_set() and not report.share >= _ENDED_WELL:
        fail(f"Only {report.share:.0%} of the targets in coverage have exactly one track.")


def _run(
    scenario: str,
    seed: int,
    seconds: float,
    endpoint: str,
    folder: Path,
    children: Children,
    stop: threading.Event,
) -> DemoState:
    world, state = load_scenario(scenario), DemoState(seconds)
    to = ["--connect", endpoint]
    children.start("router", ["router", "--listen", endpoint])
    children.start("fusion", ["fusion", *to, "--black-box", str(folder / "black-box.jsonl")])
    children.start("emi", ["emi", *to])
    with ZenohBus.open([endpoint], timeout_s=30.0, stop=stop) as bus, ExitStack() as stack:
        ask = Client(bus)
        watched = Watched(
            frames=stack.enter_context(ask.watch_tracks(history=False)),
            statuses=stack.enter_context(ask.watch_statuses()),
            truth=stack.enter_context(watch_truth(bus, ask.keys)),
            track_file=stack.enter_context(RecordWriter(folder / TRACKS)),
            truth_file=stack.enter_context(RecordWriter(folder / TRUTH)),
        )
        _wait_ready(children, watched, stop)
        common = ["--scenario", scenario, "--seed", str(seed), "--start-ns", str(time.time_ns()), *to]
        for radar in world.radars:
            children.start(f"radar-{radar.id}", ["sim", "radar", "--radar", radar.id, *common])
        children.start("truth", ["sim", "truth", *common])
        asking = threading.Thread(target=_ask_emi, args=(ask, world, seed, state), daemon=True)
        asking.start()
        state.begin()
        _watch(children, watched, state, stop)
        asking.join(10.0)
    return state


class Watched(NamedTuple):
    """What the demo hears, and where it writes it."""

    frames: Watch[TrackFrame]
    statuses: Watch[ServiceStatus]
    truth: Watch[TruthFrame]
    track_file: RecordWriter
    truth_file: RecordWriter


def _watch(children: Children, watched: Watched, state: DemoState, stop: threading.Event) -> None:
    with Live(console=out, auto_refresh=False) as live:
        while not stop.is_set() and not state.over():
            children.check()
            while (status := watched.statuses.receive(0)) is not None:
                state.take_status(status)
            while (truth := watched.truth.receive(0)) is not None:
                state.take_truth(truth)
                watched.truth_file.write(truth)
            frame = watched.frames.receive(0.1)
            if frame is not None:
                state.take_frame(frame)
                watched.track_file.write(frame)
            if state.refresh_due() and out.is_terminal:
                live.update(demo_panel(state), refresh=True)


def _wait_ready(children: Children, watched: Watched, stop: threading.Event) -> None:
    """Wait until fusion and EMI are ready; the first start on a machine compiles for up to a minute."""
    missing, deadline = {"fusion", "emi"}, time.monotonic() + _READY_S
    text = "starting; the first start on a machine compiles the numerics, which takes about a minute"
    with err.status(text) if err.is_terminal else nullcontext():
        if not err.is_terminal:
            err.print(text, highlight=False)
        while missing and not stop.is_set():
            children.check()
            status = watched.statuses.receive(0.2)
            if status is not None and status.state == "ready":
                missing.discard(status.kind)
            if time.monotonic() > deadline:
                raise TrackmeshError(f"These services were not ready in time: {', '.join(sorted(missing))}.")


def _ask_emi(ask: Client, world: Scenario, seed: int, state: DemoState) -> None:
    if world.emi is None:
        return
    try:
        simulated = scenario_scans(world.emi, seed)
        state.emi = list(ask.invert(simulated.batch))
        state.emi_truth_m = simulated.truth.position_m
    except TrackmeshError as error:
        state.emi_error = str(error)


def _folder(path: Path) -> Path:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrackmeshError(f"Cannot make the folder {path}: {error.strerror}.") from None
    return path


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
