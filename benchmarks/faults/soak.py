"""A deployment that runs on and on: does anything grow?

python -m benchmarks.faults.soak [--minutes 20] [--seed 1] [--out out/soak]

Router, two radars, a fusion unit with state file, a watching client; and clients that join, ask and leave all the time.
Memory, file handles and threads of every process, and the time between the arrivals of plots and of the frames that
contain them, go to ``soak.json`` and ``soak.png``; exit code 1 if a bound was missed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.faults.chaos import RADARS, TARGETS, write_scenario
from benchmarks.faults.deployment import Deployment, Usage, free_port, trackmesh, wait_ready
from benchmarks.faults.soak_chart import draw
from benchmarks.live import Stamped, latencies_ms
from trackmesh.protocol.bus import Subscription
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import PlotBatch, ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus

SAMPLE_S = 2.0
WINDOW_S = 20.0
CHURN_S = 1.0
GROWTH, HANDLES = 0.05, 3


class Held(NamedTuple):
    """What a part held at a time of the run, s."""

    part: str
    at_s: float
    usage: Usage


class Window(NamedTuple):
    """Latency within a window of the run, ms, and how many plots tell it."""

    at_s: float
    p50_ms: float
    p99_ms: float
    plots: int


class Soak:
    """One run."""

    def __init__(self, folder: Path, minutes: float, seed: int) -> None:
        self.folder, self.seconds, self.seed = folder, minutes * 60.0, seed
        self.held, self.windows = list[Held](), list[Window]()
        self.status: ServiceStatus | None = None
        self.visits = self.failed_visits = self.frame_gaps = 0
        self._last_seq: int | None = None

    def run(self) -> dict[str, object]:
        """The whole run; the result."""
        path = write_scenario(self.folder, TARGETS)
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        with Deployment(self.folder) as self.parts:
            parts = self.parts
            parts.add("router", lambda _: trackmesh("router", "--listen", endpoint))
            unit = ["--state-file", str(self.folder / "state"), "--connect", endpoint]
            parts.add("fusion", lambda _: trackmesh("fusion", *unit))
            with ZenohBus.open([endpoint], timeout_s=60.0) as bus:
                wait_ready(Client(bus))
                world = ["--scenario", str(path), "--seed", str(self.seed), "--start-ns", str(time.time_ns())]
                for name in RADARS:
                    command = trackmesh("sim", "radar", "--radar", name, *world, "--connect", endpoint)
                    parts.add(name, lambda _, command=command: command)  # type: ignore[misc]
                parts.add("watch", lambda _: trackmesh("watch", "--json", "--connect", endpoint))
                self._follow(bus, endpoint)
            bad_ends = parts.stop()
        return self._result(bad_ends)

    def _follow(self, bus: ZenohBus, endpoint: str) -> None:
        keys, client = Keys(), Client(bus)
        # As clients do: what the network dropped is fetched.
        frames = bus.subscribe(keys.tracks("*"), history=True, capacity=10_000)
        plots = bus.subscribe(keys.plots("*"), capacity=10_000)
        statuses = client.watch_statuses("fusion")
        begin_s = time.monotonic()
        sample_s = churn_s = 0.0
        window_s, began_ns = WINDOW_S, time.time_ns()
        had: tuple[list[Stamped[PlotBatch]], list[Stamped[TrackFrame]]] = ([], [])
        while (now_s := time.monotonic() - begin_s) < self.seconds:
            time.sleep(0.002)
            self._collect(plots, frames, had)
            while (status := statuses.receive(0.0)) is not None:
                self.status = status
            if now_s >= sample_s:
                sample_s = now_s + SAMPLE_S
                self._sample(now_s)
            if now_s >= churn_s:
                churn_s = now_s + CHURN_S
                self._visit(endpoint)
            if now_s >= window_s:
                window_s = now_s + WINDOW_S
                self._window(now_s, began_ns, had)
                began_ns, had = time.time_ns(), ([], had[1][-50:])

    def _collect(
        self, plots: Subscription, frames: Subscription, had: tuple[list[Stamped[PlotBatch]], list[Stamped[TrackFrame]]]
    ) -> None:
        while (sample := plots.receive(0.0)) is not None:
            had[0].append((time.time_ns(), decode(sample.payload, PlotBatch, sample.encoding)))
        while (sample := frames.receive(0.0)) is not None:
            frame = decode(sample.payload, TrackFrame, sample.encoding)
            had[1].append((time.time_ns(), frame))
            if self._last_seq is not None:
                self.frame_gaps += frame.seq - self._last_seq - 1
            self._last_seq = frame.seq

    def _sample(self, now_s: float) -> None:
        for name, part in self.parts.parts.items():
            if (held := part.usage()) is not None:
                self.held.append(Held(name, now_s, held))

    def _visit(self, endpoint: str) -> None:
        """A client that joins, asks, and leaves."""
        self.visits += 1
        with ZenohBus.open([endpoint], timeout_s=5.0) as bus:
            if not Client(bus).query_tracks():
                self.failed_visits += 1

    def _window(
        self, now_s: float, began_ns: int, had: tuple[list[Stamped[PlotBatch]], list[Stamped[TrackFrame]]]
    ) -> None:
        # The last batches have no frame yet.
        found = latencies_ms(had[0], had[1], (began_ns, time.time_ns() - 1_000_000_000))
        if len(found):
            p50, p99 = np.percentile(found, [50, 99])
            self.windows.append(Window(now_s, float(p50), float(p99), len(found)))

    def _result(self, bad_ends: list[str]) -> dict[str, object]:
        names = list(self.parts.parts)
        growth = {name: self._change(name, lambda u: u.rss_mib, relative=True) for name in names}
        handles = {name: self._change(name, lambda u: float(u.handles)) for name in names}
        threads = {name: self._change(name, lambda u: float(u.threads)) for name in names}
        third = max(1, len(self.windows) // 3)
        assert self.status is not None
        gaps = sum(sensor.gaps for sensor in self.status.sensors)
        result: dict[str, object] = {
            "minutes": self.seconds / 60.0,
            "memory_growth": growth,
            "handles_more": handles,
            "threads_more": threads,
            "memory_mib": {name: self._last(name).rss_mib for name in names},
            "latency_ms_first_third": _middle(self.windows[:third]),
            "latency_ms_last_third": _middle(self.windows[-third:]),
            "batches": sum(sensor.batches for sensor in self.status.sensors),
            "batches_missing": gaps,
            "refused": self.status.refused,
            "frame_gaps": self.frame_gaps,
            "visits": self.visits,
            "failed_visits": self.failed_visits,
            "ended_badly": bad_ends,
        }
        missed = {
            "memory grew": any(value > GROWTH for value in growth.values()),
            "handles grew": any(value > HANDLES for value in (*handles.values(), *threads.values())),
            "a batch or a frame went missing": bool(gaps or self.frame_gaps),
            "a client had no answer": bool(self.failed_visits),
            "a process hung": bool(bad_ends),
        }
        result["missed"] = [what for what, is_so in missed.items() if is_so]
        draw(self.held, self.windows, names, self.folder / "soak.png")
        (self.folder / "soak.json").write_text(json.dumps(result, indent=1) + "\n")
        return result

    def _last(self, name: str) -> Usage:
        return [h.usage for h in self.held if h.part == name][-1]

    def _change(self, name: str, of: Callable[[Usage], float], *, relative: bool = False) -> float:
        """Median of the last quarter against that of the second eighth."""
        mine = [h for h in self.held if h.part == name]
        early = [of(h.usage) for h in mine if self.seconds / 8 < h.at_s < self.seconds / 4]
        late = [of(h.usage) for h in mine if h.at_s > self.seconds * 3 / 4]
        before, after = float(np.median(early)), float(np.median(late))
        return after / before - 1.0 if relative else after - before


def _middle(windows: list[Window]) -> dict[str, float]:
    return {
        "p50": float(np.median([w.p50_ms for w in windows])), "p99": float(np.median([w.p99_ms for w in windows])),
        "worst_p99": max(w.p99_ms for w in windows),
    }  # fmt: skip


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--minutes", type=float, default=20.0)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--out", type=Path, default=Path("out/soak"))
    given = ask.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for old in (*given.out.glob("*.log"), given.out / "state"):
        old.unlink(missing_ok=True)
    result = Soak(given.out.resolve(), given.minutes, given.seed).run()
    print(json.dumps(result, indent=1))
    raise SystemExit(bool(result["missed"]))


if __name__ == "__main__":
    main()
