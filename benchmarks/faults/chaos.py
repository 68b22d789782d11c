"""A deployment under a fault every five seconds: something is killed by SIGKILL, or its link cut, at random.

python -m benchmarks.faults.chaos [--seconds 600] [--seed 1] [--out out/chaos]

Router, two radars, a fusion unit that keeps its state, a client. Of each fault it is told how soon after its healing
every target was tracked again, and under which number; at the end, where every batch of plots went. Results go to
``chaos.json`` and ``chaos.png``; exit code 1 if a bound was missed.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tests.hosts.proxy import Proxy

from benchmarks.faults.chaos_chart import draw
from benchmarks.faults.deployment import Deployment, Usage, free_port, trackmesh, wait_ready
from benchmarks.faults.judge import Fault, Judge, account, read_black_box, read_journal, tracked
from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.client import Client
from trackmesh.protocol.messages import ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.sim.scenario import load_scenario
from trackmesh.sim.truth import World

EVERY_S = 5.0
WARM_UP_S = 20.0
CALM_S = 20.0
RADARS = ("north", "east")
TARGETS = 20
BOUND_S, KEPT, GROWTH = 10.0, 0.9, 0.05
KINDS = (
    ("kill", "router"), ("kill", "north"), ("kill", "east"), ("kill", "fusion"),
    ("cut", "north"), ("cut", "fusion"), ("cut", "client"), ("silent cut", "north"), ("silent cut", "fusion"),
    ("silent cut", "client"),
)  # fmt: skip

SCENARIO = """
description = "Twenty aircraft that stay in the area, two radars that turn in a second"
duration_s = 3600.0
origin = {{ latitude_deg = 48.35, longitude_deg = 11.78 }}

[targets]
count = {targets}
quiet_count = 0
area_enu_m = [-40e3, -40e3, 40e3, 40e3]
speed_mps = [80.0, 150.0]
turn_rate_deg_s = [1.0, 2.0]
turn_duration_s = [10.0, 25.0]
manoeuvre_share = 0.2
"""
RADAR = """
[[radars]]
id = "{name}"
site_enu_m = [{east_m}, 0.0, 0.0]
period_s = 1.0
offset_s = {offset_s}
sigma_range_m = 30.0
sigma_azimuth_deg = 0.06
p_detect = 0.9
clutter_per_scan = 2.0
max_range_m = 120e3
sectors = 8
"""


class Held(NamedTuple):
    """What a part held at a time of the run, and how long it had been running."""

    part: str
    at_s: float
    age_s: float
    usage: Usage


class Chaos:
    """One run. ``now_s`` counts from the first fault that may come."""

    def __init__(self, folder: Path, seconds: float, seed: int) -> None:
        self.folder, self.seconds, self.seed = folder, seconds, seed
        self.random = random.Random(seed)
        self.judge, self.held = Judge(), list[Held]()
        self.timeline: list[tuple[float, int]] = []
        self.gaps: dict[tuple[str, str], int] = {}
        self.late: dict[str, float] = {}
        self.refused: dict[str, Counter[str]] = defaultdict(Counter)
        self.ready_s: list[float] = []
        self.frames = self.frame_gaps = 0
        self._last_frame: dict[str, int] = {}
        self._due: list[tuple[float, Callable[[], None]]] = []
        self._started_s: dict[str, float] = {}
        self._last_part = ""
        self._usage_due_s = 0.0

    # --- the deployment

    def run(self) -> dict[str, object]:
        """The whole run; the result."""
        path = write_scenario(self.folder, TARGETS)
        self.scenario = load_scenario(str(path))
        self.world = World(self.scenario, self.seed)
        port = free_port()
        with (
            Deployment(self.folder) as self.parts, Proxy(("127.0.0.1", port)) as north,
            Proxy(("127.0.0.1", port)) as fusion, Proxy(("127.0.0.1", port)) as client,
        ):  # fmt: skip
            self.proxies = {"north": north, "fusion": fusion, "client": client}
            self._start_all(path, f"tcp/127.0.0.1:{port}")
            with ZenohBus.open([client.endpoint], timeout_s=60.0) as bus:
                self._follow(Client(bus))
            self.bad_ends = self.parts.stop()
            self.cut_off = {name: part.said("is lost") for name, part in self.parts.parts.items()}
        return self._result()

    def _start_all(self, path: Path, endpoint: str) -> None:
        parts = self.parts
        parts.add("router", lambda _: trackmesh("router", "--listen", endpoint))
        black_box = self.folder / "taken"
        state = {"TRACKMESH_STATE_EVERY_S": "1"}
        unit = ["--state-file", str(self.folder / "state"), "--connect", self.proxies["fusion"].endpoint]
        parts.add("fusion", lambda k: trackmesh("fusion", *unit, "--black-box", f"{black_box}-{k}.jsonl"), state)
        with ZenohBus.open([endpoint], timeout_s=60.0) as bus:
            self.ready_s.append(wait_ready(Client(bus)))
        self.start_ns = time.time_ns()
        for name in RADARS:
            via = self.proxies[name].endpoint if name in self.proxies else endpoint
            given = [str(path), name, str(self.seed), str(self.start_ns), via, str(self.folder / f"{name}.journal")]
            parts.add(name, lambda _, given=given: ["benchmarks.faults.journal_radar", *given])  # type: ignore[misc]
        watch = trackmesh("watch", "--json", "--connect", self.proxies["client"].endpoint)
        parts.add("watch", lambda _: watch)
        now_s = time.monotonic()
        self._started_s = dict.fromkeys(parts.parts, now_s)

    # --- the run

    def _follow(self, client: Client) -> None:
        self.begin_s = time.monotonic() + WARM_UP_S
        self._at(0.0, self._fault)
        end_s = self.seconds + CALM_S
        with client.watch_tracks(capacity=100_000) as frames, client.watch_statuses("fusion") as statuses:
            while self._now_s() < end_s:
                frame = frames.receive(0.02)
                if frame is not None:
                    self._take(frame)
                while (status := statuses.receive(0.0)) is not None:
                    self._take_status(status)
                self._do_due()

    def _now_s(self) -> float:
        return time.monotonic() - self.begin_s

    def _at(self, at_s: float, action: Callable[[], None]) -> None:
        self._due.append((at_s, action))

    def _do_due(self) -> None:
        now_s = self._now_s()
        for one in [one for one in self._due if one[0] <= now_s]:
            self._due.remove(one)
            one[1]()
        if now_s >= self._usage_due_s:
            self._usage_due_s = now_s + 1.0
            for name, part in self.parts.parts.items():
                if (held := part.usage()) is not None:
                    self.held.append(Held(name, now_s, time.monotonic() - self._started_s[name], held))

    def _fault(self) -> None:
        now_s = self._now_s()
        if now_s >= self.seconds:
            return
        self._at(now_s + EVERY_S, self._fault)
        kind, part = self.random.choice([one for one in KINDS if one[1] != self._last_part])
        self._last_part = part
        before = {target: track for target, (track, _) in self.judge.now.items()}
        began_ns = time.time_ns()

        def heal() -> None:
            if kind == "kill":
                self.parts.parts[part].start()
                self._started_s[part] = time.monotonic()
            else:
                self.proxies[part].heal()
            self.judge.healed(Fault(kind, part, began_ns, time.time_ns(), before))

        if kind == "kill":
            self.parts.parts[part].kill()
            lasts_s = 0.0 if part == "fusion" else self.random.uniform(0.0, 2.0)
        else:
            (self.proxies[part].sever if kind == "cut" else self.proxies[part].drop)()
            lasts_s = self.random.uniform(0.5, 4.0)
        self._at(now_s + lasts_s, heal)

    def _take(self, frame: TrackFrame) -> None:
        truth = self.world.truth((frame.t_ns - self.start_ns) / 1e9 + 1.0).state_at((frame.t_ns - self.start_ns) / 1e9)
        found = tracked(frame, truth.ids, truth.states[:, :2])
        self.judge.take(found, len(truth.ids), time.time_ns())
        self.timeline.append((self._now_s(), len(found)))
        last = self._last_frame.get(frame.boot_id)
        if last is not None:
            self.frame_gaps += frame.seq - last - 1
        self._last_frame[frame.boot_id] = frame.seq
        self.frames += 1

    def _take_status(self, status: ServiceStatus) -> None:
        for sensor in status.sensors:
            self.gaps[status.boot_id, sensor.sensor_id] = sensor.gaps
        self.refused[status.boot_id] = Counter(status.refused)
        self.late[status.boot_id] = status.figures.get("engine.too_late_plots", 0.0)

    # --- the result

    def _result(self) -> dict[str, object]:
        published = [batch for name in RADARS for batch in read_journal(self.folder / f"{name}.journal", name)]
        taken = [read_black_box(path) for path in sorted(self.folder.glob("taken-*.jsonl"))]
        counted = account(published, taken, sum(self.gaps.values()))
        judged = self.judge.judged
        recovered = np.array([s for one in judged for s in one.recovered_s.values()])
        undisturbed = np.array([s for one in judged for s in one.undisturbed_s.values()])
        worst = sorted(((max(one.recovered_s.values(), default=0.0), one) for one in judged), key=lambda w: -w[0])
        kept = [k for one in judged for k in one.kept.values()]
        never = [(f"{one.fault.kind} {one.fault.part}", len(one.missing)) for one in judged if one.missing]
        growth = {name: self._growth(name) for name in self.parts.parts}
        result: dict[str, object] = {
            "seconds": self.seconds,
            "seed": self.seed,
            "faults": len(judged),
            "faults_by_kind": dict(Counter(f"{one.fault.kind} {one.fault.part}" for one in judged)),
            "recovered_s": _spread(recovered),
            "recovered_of_last_healing_s": _spread(undisturbed),
            "worst": [
                {"fault": " ".join(one.fault[:2]), "at_s": round(self._at_s(one.fault), 1), "s": round(s, 2)}
                for s, one in worst[:8]
            ],
            "targets_judged": len(recovered),
            "recovered_late": int((undisturbed > BOUND_S).sum()),
            "never_recovered": never,
            "identities_kept": float(np.mean(kept)),
            "whole_picture": self.judge.whole_ns / max(1, self.judge.seen_ns),
            "batches": counted._asdict(),
            "too_late_plots": sum(self.late.values()),
            "refused": dict(sum(self.refused.values(), Counter())),
            "frames": self.frames,
            "frame_gaps": self.frame_gaps,
            "starts": {name: part.starts for name, part in self.parts.parts.items()},
            "links_lost": self.cut_off,
            "ended_badly": self.bad_ends,
            "memory_growth": growth,
        }  # fmt: skip
        missed = {
            "a target was tracked again too late": bool((undisturbed > BOUND_S).any() or never),
            "numbers were lost": float(np.mean(kept)) < KEPT,
            "a batch went missing unseen": counted.untold > 0 or counted.twice > 0,
            "a process hung": bool(self.bad_ends),
            "memory grew": any(g is not None and g > GROWTH for g in growth.values()),
        }
        result["missed"] = [what for what, is_so in missed.items() if is_so]
        draw(self, self.folder / "chaos.png")
        (self.folder / "chaos.json").write_text(json.dumps(result, indent=1) + "\n")
        return result

    def _at_s(self, fault: Fault) -> float:
        # Faults are noted in wall time, the run in a steady one.
        return (fault.began_ns - time.time_ns()) / 1e9 + self._now_s()

    def _growth(self, name: str) -> float | None:
        """Resident memory of the last third over that of the second sixth, of processes of like age."""
        like = [h for h in self.held if h.part == name and h.age_s > 10.0 and h.at_s > self.seconds / 6]
        early = [h.usage.rss_mib for h in like if h.at_s < self.seconds / 3]
        late = [h.usage.rss_mib for h in like if h.at_s > self.seconds * 2 / 3]
        return float(np.median(late) / np.median(early) - 1.0) if len(early) > 5 and len(late) > 5 else None


def _spread(values: FloatArray) -> dict[str, float]:
    return {f"p{p}": float(np.percentile(values, p)) for p in (50, 95, 99)} | {"max": float(values.max())}


def write_scenario(folder: Path, targets: int) -> Path:
    """The scenario as a file."""
    text = SCENARIO.format(targets=targets)
    for name, east_m, offset_s in zip(RADARS, (-15e3, 15e3), (0.0, 0.4), strict=True):
        text += RADAR.format(name=name, east_m=east_m, offset_s=offset_s)
    path = folder / "chaos.toml"
    path.write_text(text, encoding="utf-8")
    return path


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--seconds", type=float, default=600.0)
    ask.add_argument("--seed", type=int, default=1)
    ask.add_argument("--out", type=Path, default=Path("out/chaos"))
    given = ask.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for old in (
        *given.out.glob("*.journal"),
        *given.out.glob("taken-*"),
        *given.out.glob("*.log"),
        given.out / "state",
    ):
        old.unlink(missing_ok=True)
    result = Chaos(given.out.resolve(), given.seconds, given.seed).run()
    print(json.dumps(result, indent=1))
    raise SystemExit(bool(result["missed"]))


if __name__ == "__main__":
    main()
