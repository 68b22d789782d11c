"""What one sensor that floods, or sends garbage, costs the tracks of another.

python -m benchmarks.faults.flood [--messages 1000000] [--seconds 60] [--out out/flood]

First malformed messages in this process, against the decoder and the intake: each is taken or refused, nothing else.
Then a deployment: a radar whose plots are timed to the frame that contains them, alone; beside a sensor at its own
rate; beside one that sends a hundred times as much; and beside one that sends garbage as fast. Results go to
``flood.json``; exit code 1 if a bound was missed.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.faults.chaos import TARGETS, write_scenario
from benchmarks.faults.deployment import Deployment, free_port, trackmesh, wait_ready
from benchmarks.faults.flooder import SECTORS, batch, broken
from benchmarks.live import Recorder, latencies_ms
from trackmesh.protocol.bus import Sample
from trackmesh.protocol.client import Client
from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import PlotBatch, ServiceStatus, TrackFrame
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.fusion.intake import Intake

RADAR, LOUD = "north", "loud"
TIMES = 100
SETTLE_S = 5.0
FACTOR = 2.0


def malformed(messages: int, seed: int = 1) -> dict[str, object]:
    """Messages that were broken, given to the decoder and the intake.

    Raises:
        Exception: whatever is not a refusal; there must be none.
    """
    odd, rng = random.Random(seed), np.random.default_rng(seed)
    good = [encode(batch(LOUD, seq, rng)) for seq in range(200)]
    intake = Intake(60_000_000_000, 2_000_000_000)
    reasons: Counter[str] = Counter()
    began_s, slowest_s = time.perf_counter(), 0.0
    for k in range(messages):
        # Every tenth is bytes of no shape at all.
        data = odd.randbytes(odd.randint(0, 300)) if k % 10 == 9 else broken(odd.choice(good), odd)
        at_s = time.perf_counter()
        try:
            intake.check(decode(data, PlotBatch, encoding(PlotBatch)), time.time_ns())
            reasons["taken: still a good message"] += 1
        except RefusedMessage as error:
            reasons[error.reason] += 1
        slowest_s = max(slowest_s, time.perf_counter() - at_s)
    took_s = time.perf_counter() - began_s
    return {
        "messages": messages, "us_each": took_s / messages * 1e6, "slowest_ms": slowest_s * 1e3,
        "reasons": dict(reasons.most_common()),
    }  # fmt: skip


class Flood:
    """The deployment, and its phases."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.folder, self.seconds = folder, seconds

    def run(self) -> dict[str, dict[str, object]]:
        """All phases by name."""
        path = write_scenario(self.folder, TARGETS)
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        with Deployment(self.folder) as self.parts:
            self.parts.add("router", lambda _: trackmesh("router", "--listen", self.endpoint))
            self.parts.add("fusion", lambda _: trackmesh("fusion", "--connect", self.endpoint))
            with ZenohBus.open([self.endpoint], timeout_s=60.0) as bus:
                wait_ready(Client(bus))
                given = ["--scenario", str(path), "--radar", RADAR, "--connect", self.endpoint]
                self.parts.add(RADAR, lambda _: trackmesh("sim", "radar", *given))
                time.sleep(2 * SETTLE_S)
                phases = {
                    "alone": self._phase(bus, 0.0, "plots"),
                    "beside a sensor at its rate": self._phase(bus, SECTORS, "plots"),
                    f"beside one at {TIMES} x its rate": self._phase(bus, SECTORS * TIMES, "plots"),
                    "beside garbage as fast": self._phase(bus, SECTORS * TIMES, "garbage"),
                }
            self.parts.stop()
        return phases

    def _phase(self, bus: ZenohBus, rate_hz: float, what: str) -> dict[str, object]:
        before = _status(bus)
        if rate_hz:
            given = [self.endpoint, LOUD, str(rate_hz), str(self.seconds + 2 * SETTLE_S), what]
            self.parts.add(f"loud-{rate_hz:g}-{what}", lambda _: ["benchmarks.faults.flooder", *given])
            time.sleep(SETTLE_S)
        keys = Keys()
        plots = Recorder(bus.subscribe(keys.plots(RADAR), capacity=100_000))
        frames = Recorder(bus.subscribe(keys.tracks("*"), capacity=100_000))
        began_ns = time.time_ns()
        time.sleep(self.seconds)
        ended_ns = time.time_ns() - 1_000_000_000
        plots.close()
        frames.close()
        time.sleep(2 * SETTLE_S if rate_hz else 1.0)
        after = _status(bus)
        found = latencies_ms(
            [(came_ns, decode(s.payload, PlotBatch, s.encoding)) for came_ns, s in plots.samples],
            [(came_ns, decode(s.payload, TrackFrame, s.encoding)) for came_ns, s in frames.samples],
            (began_ns, ended_ns),
        )
        p50, p99 = np.percentile(found, [50, 99])
        (quiet,) = [sensor for sensor in after.sensors if sensor.sensor_id == RADAR]
        refused = Counter(after.refused) - Counter(before.refused)
        return {
            "p50_ms": float(p50), "p99_ms": float(p99), "max_ms": float(found.max()), "plots": len(found),
            "frames_missed": _missed([s for _, s in frames.samples]), "refused": dict(refused),
            "quiet_missing": quiet.gaps, "quiet_refused": quiet.refused,
            "tracks": after.figures.get("tracks", 0.0), "frames_a_second": len(frames.samples) / self.seconds,
        }  # fmt: skip


def _missed(samples: list[Sample]) -> int:
    """Frames that a subscription without history did not get."""
    numbers = [decode(s.payload, TrackFrame, s.encoding).seq for s in samples]
    return numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0


def _status(bus: ZenohBus) -> ServiceStatus:
    (status,) = [one for one in Client(bus).statuses() if one.kind == "fusion"]
    return status


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--messages", type=int, default=1_000_000)
    ask.add_argument("--seconds", type=float, default=60.0, help="of each phase of the deployment")
    ask.add_argument("--out", type=Path, default=Path("out/flood"))
    given = ask.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    result: dict[str, object] = {"malformed": malformed(given.messages)}
    print(json.dumps(result["malformed"], indent=1), flush=True)
    phases = Flood(given.out.resolve(), given.seconds).run()
    result["phases"] = phases
    _, beside, flooded, garbage = phases.values()
    base_ms = float(str(beside["p99_ms"]))
    missed = [
        f"the tracks of the other sensor came {float(str(one['p99_ms'])) / base_ms:.1f} times as late {name}"
        for name, one in ((list(phases)[2], flooded), (list(phases)[3], garbage))
        if float(str(one["p99_ms"])) > FACTOR * base_ms
    ]
    if garbage["quiet_missing"] or garbage["quiet_refused"]:
        missed.append("plots of the other sensor were lost")
    result["missed"] = missed
    (given.out / "flood.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))
    raise SystemExit(bool(missed))


if __name__ == "__main__":
    main()
