"""The whole way over the network: real processes, two simulated radars of 4 s, a fusion unit, a client that measures.

python -m benchmarks.live                                   50, 200 and 1000 targets: three to four minutes
python -m benchmarks.live --targets 200 --seconds 60        another case

Latency is from the publication of a plot to the first frame that contains it: from the moment at which its sector was
due, which a radar knows beforehand, to that at which the client has the frame. A frame contains a plot if some track
was updated at its time. So the radar's and the client's own waits for a core count, and both hops over the router;
without them it is the time between the arrivals of plot and frame at the client, told beside, which is too short where
the client was held up. Everything runs on this machine; what the unit's threads waited for a core is told as well.
"""

from __future__ import annotations

import argparse
import os
import random
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.bus import Sample, Subscription
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import PlotBatch, ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.children import Children
from trackmesh.sim.radar import sector_end_s
from trackmesh.sim.scenario import Scenario, load_scenario

T = TypeVar("T")
Stamped = tuple[int, T]
"""A time, UTC ns, and a message."""

TARGETS = (50, 200, 1000)
WARM_UP_S, MEASURED_S = 20.0, 32.0
READY_S = 240.0
RADARS = ("north", "east")
SAME_TIME_NS = 2_000
"""The engine counts seconds from its start in double precision: times come back with a small error."""

_SCENARIO = """
description = "A latency measurement"
duration_s = 600.0
origin = {{ latitude_deg = 48.35, longitude_deg = 11.78, height_m = 450.0 }}

[targets]
count = {targets}
quiet_count = {quiet}
area_enu_m = [-150e3, -150e3, 150e3, 150e3]
speed_mps = [80.0, 250.0]
"""

_RADAR = """
[[radars]]
id = "{name}"
site_enu_m = [{east_m}, 0.0, 0.0]
period_s = 4.0
offset_s = {offset_s}
sigma_range_m = 50.0
sigma_azimuth_deg = 0.08
p_detect = 0.9
clutter_per_scan = 20.0
max_range_m = 220e3
sectors = 32
"""


class Usage(NamedTuple):
    """What a process has used until now: processor time, and time in which it was ready but had no core, in s."""

    cpu_s: float
    waited_s: float


class Live(NamedTuple):
    """What one case gave.

    Attributes:
        latency_ms: (m,) of the plots that tracks took; ``between_ms`` (m,) likewise between the two arrivals.
        plots: how many were published meanwhile; ``frames`` likewise.
        lost: batches and frames missing in the sequence numbers, dropped before the unit took them, or refused.
        cpu: cores that the unit used on average; ``waited`` is the share of time it had no core.
        cores: of the machine; ``load`` is how many processes wanted one, on average, with ours.
    """

    targets: int
    latency_ms: FloatArray
    between_ms: FloatArray
    plots: int
    frames: int
    tracks: int
    lost: int
    cpu: float
    waited: float
    cores: int
    load: float

    def text(self) -> str:
        """A line for the terminal."""
        p50, p99 = np.percentile(self.latency_ms, [50, 99])
        short, long = np.percentile(self.between_ms, [50, 99])
        return (
            f"{self.targets} targets, {self.tracks} tracks: {len(self.latency_ms)} of {self.plots} plots in tracks, "
            f"latency p50 {p50:.1f} p99 {p99:.1f} max {self.latency_ms.max():.1f} ms (between arrivals p50 {short:.1f} "
            f"p99 {long:.1f}); {self.lost} lost of {self.frames} frames and their batches; "
            f"fusion {100 * self.cpu:.1f} % of a core ({100 * self.cpu / self.cores:.1f} % of {self.cores}), "
            f"waited for one {100 * self.waited:.1f} % of the time (load {self.load:.1f})"
        )


class Recorder:
    """Keeps every message of a subscription with the time at which it came, from a thread; decoded afterwards."""

    def __init__(self, subscription: Subscription) -> None:
        self.samples: list[tuple[int, Sample]] = []
        self._subscription = subscription
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def _run(self) -> None:
        for sample in self._subscription:
            self.samples.append((time.time_ns(), sample))

    def close(self) -> int:
        """Stop; how many messages were dropped for want of time."""
        self._subscription.close()
        self._thread.join()
        return self._subscription.dropped


def run(targets: int, warm_up_s: float = WARM_UP_S, measured_s: float = MEASURED_S) -> Live:
    """Start everything, measure, and end everything.

    Raises:
        TrackmeshError: a process ended, or the unit was not ready in time.
    """
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    with tempfile.TemporaryDirectory() as name, Children(Path(name)) as children:
        path = _write_scenario(Path(name), targets)
        children.start("router", ["router", "--listen", endpoint])
        children.start("fusion", ["fusion", "--connect", endpoint])
        with ZenohBus.open([endpoint], timeout_s=60.0) as bus:
            _wait_ready(children, Client(bus))
            keys = Keys()
            frames = Recorder(bus.subscribe(keys.tracks("*"), capacity=100_000))
            plots = Recorder(bus.subscribe(keys.plots("*"), capacity=100_000))
            try:
                start_ns = time.time_ns()
                begin = ["--scenario", str(path), "--start-ns", str(start_ns), "--connect", endpoint]
                for radar in RADARS:
                    children.start(radar, ["sim", "radar", "--radar", radar, *begin])
                _watch_over(children, warm_up_s)
                began_ns, before = time.time_ns(), usage(children.pid("fusion"))
                _watch_over(children, measured_s)
                ended_ns, after = time.time_ns(), usage(children.pid("fusion"))
                refused = _refused(Client(bus))
            finally:
                dropped = frames.close() + plots.close()
        span_s = (ended_ns - began_ns) / 1e9
        due = _due_ns(load_scenario(str(path)), start_ns)
        return _judge(
            targets, _batches(plots), due, _frames(frames), (began_ns, ended_ns), refused + dropped,
            ((after.cpu_s - before.cpu_s) / span_s, (after.waited_s - before.waited_s) / span_s),
        )  # fmt: skip


def usage(pid: int) -> Usage:
    """Of all threads of a process, as Linux tells.

    Raises:
        TrackmeshError: it does not.
    """
    folder = Path("/proc") / str(pid)
    try:
        # After the name, which may hold anything, user and system time are the 12th and 13th field.
        fields = (folder / "stat").read_text().rpartition(")")[2].split()
        waits = [(task / "schedstat").read_text().split()[1] for task in (folder / "task").iterdir()]
    except OSError as error:
        raise TrackmeshError(f"Cannot read what process {pid} uses: {error.strerror}.") from None
    ticks = os.sysconf("SC_CLK_TCK")
    return Usage((int(fields[11]) + int(fields[12])) / ticks, sum(map(int, waits)) / 1e9)


def latencies_ms(
    plots: Iterable[Stamped[PlotBatch]], frames: Iterable[Stamped[TrackFrame]], span_ns: tuple[int, int]
) -> FloatArray:
    """Latency (m,) of the plots that tracks took, of the batches within a span of time.

    Args:
        plots, frames: with the times, UTC ns, from which and to which to count.
    """
    shown_ns, taken_ns = _first_shown(frames)
    out = []
    for came_ns, batch in plots:
        if not span_ns[0] <= came_ns < span_ns[1] or not len(taken_ns):
            continue
        near = np.clip(np.searchsorted(taken_ns, batch.t_ns - SAME_TIME_NS), 0, len(taken_ns) - 1)
        found = np.abs(taken_ns[near] - batch.t_ns) <= SAME_TIME_NS
        out.append((shown_ns[near[found]] - came_ns) / 1e6)
    return np.concatenate([np.zeros(0), *out])


def _first_shown(frames: Iterable[Stamped[TrackFrame]]) -> tuple[IntArray, IntArray]:
    """The time of the first frame with each time of a last plot, and that time (k,), sorted by the latter."""
    first: dict[int, int] = {}
    for came_ns, frame in frames:
        for t_ns in frame.updated_t_ns.tolist():
            first.setdefault(t_ns, came_ns)
    taken = np.array(sorted(first), np.int64)
    return np.array([first[t_ns] for t_ns in taken.tolist()], np.int64), taken


def _judge(
    targets: int,
    plots: list[Stamped[PlotBatch]],
    due_ns: Callable[[PlotBatch], int],
    frames: list[Stamped[TrackFrame]],
    span_ns: tuple[int, int],
    lost: int,
    used: tuple[float, float],
) -> Live:
    latency_ms = latencies_ms([(due_ns(batch), batch) for _, batch in plots], frames, span_ns)
    if not len(latency_ms):
        raise TrackmeshError("No track took a plot while it was measured.")
    during = [frame for came_ns, frame in frames if span_ns[0] <= came_ns < span_ns[1]]
    gaps = _gaps([frame.seq for _, frame in frames])
    for radar in RADARS:
        gaps += _gaps([batch.seq for _, batch in plots if batch.sensor_id == radar])
    published = sum(len(batch.t_ns) for came_ns, batch in plots if span_ns[0] <= came_ns < span_ns[1])
    return Live(
        targets, latency_ms, latencies_ms(plots, frames, span_ns), published,
        len(during), len(during[-1].track_id), lost + gaps, *used,
        cores=os.cpu_count() or 1, load=os.getloadavg()[0],
    )  # fmt: skip


def _gaps(numbers: list[int]) -> int:
    return sum(later - earlier - 1 for earlier, later in pairwise(numbers))


def _due_ns(scenario: Scenario, start_ns: int) -> Callable[[PlotBatch], int]:
    """When a radar publishes a batch, if nothing holds it up."""

    def due_ns(batch: PlotBatch) -> int:
        assert batch.scan is not None
        radar = scenario.radar(batch.sensor_id)
        return start_ns + round(sector_end_s(radar, batch.scan.index, batch.scan.sector) * 1e9)

    return due_ns


def _batches(recorder: Recorder) -> list[Stamped[PlotBatch]]:
    return [(came_ns, decode(s.payload, PlotBatch, s.encoding)) for came_ns, s in recorder.samples]


def _frames(recorder: Recorder) -> list[Stamped[TrackFrame]]:
    return [(came_ns, decode(s.payload, TrackFrame, s.encoding)) for came_ns, s in recorder.samples]


def _refused(client: Client) -> int:
    """Batches that the unit refused, missed, or dropped before it could take them."""
    statuses = [status for status in client.statuses() if status.kind == "fusion"]
    if not statuses:
        raise TrackmeshError("The unit did not say what it refused.")
    return sum(_not_taken(status) for status in statuses)


def _not_taken(status: ServiceStatus) -> int:
    missed = sum(sensor.gaps for sensor in status.sensors) + sum(status.refused.values())
    return missed + int(status.figures["batches_dropped_here"])


def _wait_ready(children: Children, client: Client) -> None:
    deadline_s = time.monotonic() + READY_S
    with client.watch_statuses("fusion") as watch:
        while time.monotonic() < deadline_s:
            children.check()
            status = watch.receive(0.5)
            if status is not None and status.state == "ready":
                return
    raise TrackmeshError(f"The unit was not ready within {READY_S:g} s.")


def _watch_over(children: Children, seconds: float) -> None:
    deadline_s = time.monotonic() + seconds
    while (left_s := deadline_s - time.monotonic()) > 0:
        children.check()
        time.sleep(min(1.0, left_s))


def _write_scenario(folder: Path, targets: int) -> Path:
    text = _SCENARIO.format(targets=targets, quiet=targets // 4)
    for name, east_m, offset_s in zip(RADARS, (-40e3, 40e3), (0.0, 1.3), strict=True):
        text += _RADAR.format(name=name, east_m=east_m, offset_s=offset_s)
    path = folder / "live.toml"
    path.write_text(text, encoding="utf-8")
    return path


def _free_port() -> int:
    # Below the ports that the kernel gives to outgoing connections: see the demo.
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``."""
    for targets in TARGETS:
        found = run(targets)
        print(f"live: {found.text()}", flush=True)
        for percent in (50, 99):
            yield _row(f"{targets} targets, latency p{percent}", float(np.percentile(found.latency_ms, percent)), "ms")
        yield _row(f"{targets} targets, p99 between arrivals", float(np.percentile(found.between_ms, 99)), "ms")
        yield _row(f"{targets} targets, lost", float(found.lost), "messages")
        yield _row(f"{targets} targets, fusion unit", 100.0 * found.cpu, "% of one core")
        yield _row(f"{targets} targets, fusion unit, of all cores", 100.0 * found.cpu / found.cores, "% of the machine")
        yield _row(f"{targets} targets, fusion unit waits for a core", 100.0 * found.waited, "% of the time")


def _row(case: str, value: float, unit: str) -> dict[str, object]:
    none = dict.fromkeys(("peer", "peer_value", "ratio"))
    return {"bench": "live", "case": case, "value": value, "unit": unit, **none}


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--targets", default=",".join(map(str, TARGETS)), metavar="N,N")
    ask.add_argument("--seconds", type=float, default=MEASURED_S, help="measured, after the warm-up")
    ask.add_argument("--warm-up", type=float, default=WARM_UP_S, metavar="SECONDS")
    given = ask.parse_args()
    for targets in map(int, given.targets.split(",")):
        print(run(targets, given.warm_up, given.seconds).text(), flush=True)


if __name__ == "__main__":
    main()
