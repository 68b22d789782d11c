"""``trackmesh demo``: the whole system on one machine, every part a process of its own."""

from __future__ import annotations

import random
import socket
import threading
import time
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.live import Live

from trackmesh.protocol.client import Client, Watch
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter
from trackmesh.protocol.messages import ServiceStatus, TagFrame, TrackFrame, TruthFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.children import Children
from trackmesh.services.cli.demo_tags import TagState, reader_table
from trackmesh.services.cli.demo_view import DemoState, demo_panel, demo_report, watch_truth
from trackmesh.services.cli.files import records_of
from trackmesh.services.cli.options import Scenario as ScenarioOption
from trackmesh.services.cli.options import Seed, err, fail, out, say, told
from trackmesh.services.cli.toml_text import toml_text
from trackmesh.services.process import on_signal
from trackmesh.sim.drawing import draw_tracks
from trackmesh.sim.emi import scenario_scans
from trackmesh.sim.scenario import Scenario, load_scenario

TRACKS, TRUTH, READERS = "tracks.jsonl", "truth.jsonl", "readers.toml"

_ROUTER_S = 60.0
_READY_S = 240.0
_TELL_S = 5.0
_ENDED_WELL = 0.95
_LONG_ENOUGH_S = 45.0


@told
def demo(
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, metavar="S", help="How long; 0: until Ctrl-C.")] = 60,
    scenario: ScenarioOption = "two-radars",
    seed: Seed = 1,
    out_path: Annotated[
        Path, typer.Option("--out", metavar="FOLDER", help="For the picture, the recordings and the logs.")
    ] = Path("out/demo"),
    port: Annotated[
        int | None, typer.Option("--port", min=1, max=65535, metavar="N", help="Of the router; default: a free one.")
    ] = None,
) -> None:
    """Run the whole system on this machine, and watch it.

    A router, simulated radars and readers of tags, a fusion unit, a tag service and an EMI service run as processes of
    their own. At the end the picture is compared with the truth: the exit code is 1 if a process failed, or if, after
    45 s or more, fewer than 95 % of the targets in coverage have exactly one track.
    """
    world = load_scenario(scenario)
    folder = _folder(out_path)
    stop = threading.Event()
    with on_signal(lambda _: stop.set()), Children(folder) as children:
        state = _run(Setting(world, scenario, seed, folder, port or _free_port()), seconds, children, stop)
        bad = children.stop()
    if not state.frames and stop.is_set():
        say(f"stopped before the first picture; logs in {folder}")
        return
    report = demo_report(state, world, seed)
    out.print(report.table)
    _draw(folder, stop.is_set())
    if bad:
        fail(f"These processes did not end well: {', '.join(bad)}.")
    if stop.is_set():
        return
    if report.error:
        fail(report.error)
    if seconds >= _LONG_ENOUGH_S and not report.share >= _ENDED_WELL:
        fail(f"Only {report.share:.0%} of the targets in coverage have exactly one track.")


def _draw(folder: Path, interrupted: bool) -> None:
    frames, truth = records_of(folder / TRACKS, TrackFrame), records_of(folder / TRUTH, TruthFrame)
    try:
        draw_tracks(frames, truth, out=folder / "tracks.png")
    except TrackmeshError as error:
        # Who leaves before the first track has no picture, and needs none.
        if not interrupted:
            raise
        say(str(error))
    say(f"picture, recordings and logs in {folder}")


class Setting(NamedTuple):
    """What is shown, and where: the world, the scenario's name or file, its seed, the folder, the router's port."""

    world: Scenario
    scenario: str
    seed: int
    folder: Path
    port: int


def _run(setting: Setting, seconds: float, children: Children, stop: threading.Event) -> DemoState:
    state = DemoState(seconds)
    endpoint = f"tcp/127.0.0.1:{setting.port}"
    if _listens(setting.port):
        raise TrackmeshError(f"The router cannot listen at {endpoint}; is another one running there?")
    children.start("router", ["router", "--listen", endpoint])
    children.start("fusion", ["fusion", "--connect", endpoint, "--black-box", str(setting.folder / "black-box.jsonl")])
    children.start("emi", ["emi", "--connect", endpoint])
    if setting.world.tags is not None:
        readers = setting.folder / READERS
        readers.write_text(toml_text(reader_table(setting.world)), encoding="utf-8")
        children.start("tags", ["tags", "--connect", endpoint, "--readers", str(readers)])
    _wait_router(children, setting.port, stop)
    if stop.is_set():
        return state
    with ZenohBus.open([endpoint], timeout_s=30.0, stop=stop) as bus, ExitStack() as stack:
        ask = Client(bus)
        watched = Watched(
            frames=stack.enter_context(ask.watch_tracks(history=False)),
            statuses=stack.enter_context(ask.watch_statuses()),
            truth=stack.enter_context(watch_truth(bus, ask.keys)),
            tags=stack.enter_context(ask.watch_tags(history=False)),
            track_file=stack.enter_context(RecordWriter(setting.folder / TRACKS)),
            truth_file=stack.enter_context(RecordWriter(setting.folder / TRUTH)),
        )
        _wait_ready(children, watched, {"fusion", "emi"} | ({"tags"} if setting.world.tags else set()), stop)
        if stop.is_set():
            return state
        if setting.world.tags is not None:
            state.tags = TagState(setting.world)
        _start_sensors(children, setting, endpoint, state)
        asking = threading.Thread(target=_ask_emi, args=(ask, setting, state), daemon=True)
        asking.start()
        state.begin()
        _watch(children, watched, state, stop)
        asking.join(10.0)
    return state


def _start_sensors(children: Children, setting: Setting, endpoint: str, state: DemoState) -> None:
    start_ns = time.time_ns()
    begin = ["--start-ns", str(start_ns), "--connect", endpoint]
    common = ["--scenario", setting.scenario, "--seed", str(setting.seed), *begin]
    for radar in setting.world.radars:
        children.start(f"radar-{radar.id}", ["sim", "radar", "--radar", radar.id, *common])
    children.start("truth", ["sim", "truth", *common])
    if state.tags is not None:
        state.tags.start_ns = start_ns
        # The tag service has its readers from the file.
        children.start("readers", ["sim", "tags", "--silent", *common])


class Watched(NamedTuple):
    """What the demo hears, and where it writes it."""

    frames: Watch[TrackFrame]
    statuses: Watch[ServiceStatus]
    truth: Watch[TruthFrame]
    tags: Watch[TagFrame]
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
            while (tags := watched.tags.receive(0)) is not None and state.tags is not None:
                state.tags.take(tags)
            frame = watched.frames.receive(0.1)
            if frame is not None:
                state.take_frame(frame)
                watched.track_file.write(frame)
            if state.refresh_due() and out.is_terminal:
                live.update(demo_panel(state), refresh=True)


def _wait_router(children: Children, port: int, stop: threading.Event) -> None:
    """Wait until the router listens, so that nobody has to complain that it does not yet."""
    deadline = time.monotonic() + _ROUTER_S
    while not stop.wait(0.05):
        children.check()
        if _listens(port):
            return
        if time.monotonic() > deadline:
            raise TrackmeshError(f"The router did not listen within {_ROUTER_S:g} s.")


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def _wait_ready(children: Children, watched: Watched, missing: set[str], stop: threading.Event) -> None:
    """Wait until these services are ready; the first start on a machine compiles for a minute or two."""
    began_s = time.monotonic()
    text = "the first start on a machine compiles the numerics, which takes a minute or two"
    tell = not err.is_terminal
    with err.status(f"starting; {text}") if err.is_terminal else nullcontext():
        while missing and not stop.is_set():
            children.check()
            status = watched.statuses.receive(0.2)
            if status is not None and status.state == "ready":
                missing.discard(status.kind)
            waited_s = time.monotonic() - began_s
            if waited_s > _READY_S:
                raise TrackmeshError(f"These services were not ready in time: {', '.join(sorted(missing))}.")
            if tell and waited_s > _TELL_S:
                say(text)
                tell = False


def _ask_emi(ask: Client, setting: Setting, state: DemoState) -> None:
    if setting.world.emi is None:
        return
    try:
        simulated = scenario_scans(setting.world.emi, setting.seed)
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
    """A port nobody listens at, below those that the kernel gives to outgoing connections.

    Who tries to connect to one of those before the router listens may be given that very port, and then occupies it.
    """
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
