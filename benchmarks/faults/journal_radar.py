"""A simulated radar that notes every batch in a file before it publishes it, so that none can get lost unseen.

python -m benchmarks.faults.journal_radar SCENARIO RADAR SEED START_NS ENDPOINTS JOURNAL [SPEED]

A line of the journal is ``boot_id seq plots newest_t_ns``.
"""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from trackmesh.protocol.bus import Publisher
from trackmesh.protocol.codec import decode
from trackmesh.protocol.keys import Keys
from trackmesh.protocol.messages import PlotBatch
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.process import on_signal
from trackmesh.sim.live import run_radar
from trackmesh.sim.scenario import load_scenario


class _Noting:
    """A publisher that writes before it puts."""

    def __init__(self, publisher: Publisher, journal: int) -> None:
        self._publisher = publisher
        self._journal = journal

    def put(self, payload: bytes, encoding: str) -> None:
        batch = decode(payload, PlotBatch, encoding)
        newest_ns = int(batch.t_ns.max()) if len(batch.t_ns) else 0
        os.write(self._journal, f"{batch.boot_id} {batch.seq} {len(batch.t_ns)} {newest_ns}\n".encode())
        self._publisher.put(payload, encoding)

    def close(self) -> None:
        self._publisher.close()


class _NotingBus(ZenohBus):
    journal = -1

    def publisher(self, key: str, *, history: int = 0) -> Publisher:  # type: ignore[override]
        publisher = super().publisher(key, history=history)
        return _Noting(publisher, self.journal) if "/plots/" in key else publisher


def main() -> None:
    scenario, radar, seed, start_ns, endpoints, journal = sys.argv[1:7]
    stop = threading.Event()
    with on_signal(lambda _name: stop.set()):
        bus = _NotingBus.open(endpoints.split(","), timeout_s=600.0, stop=stop)
        bus.journal = os.open(Path(journal), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        with bus:
            run_radar(bus, load_scenario(scenario), radar, int(seed), int(start_ns), stop, keys=Keys())


if __name__ == "__main__":
    main()
