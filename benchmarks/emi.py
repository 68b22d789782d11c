"""The EMI inversion: scans a second on one core, on all of them, over the network; beside the thesis's filter.

python -m benchmarks.emi
"""

from __future__ import annotations

import os
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.peer_kf_ekf import separate_kf_ekf
from trackmesh.protocol.client import Client
from trackmesh.protocol.messages import EmiOptions, EmiResult, EmiScanBatch, EmiTransmitter
from trackmesh.protocol.zenoh_bus import ZenohBus
from trackmesh.services.cli.children import Children
from trackmesh.services.emi.design import SCALE
from trackmesh.services.emi.diagnosis.detection import LR_THRESHOLD
from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.service.convert import to_request
from trackmesh.services.emi.service.local import invert_locally
from trackmesh.services.emi.service.main import cores
from trackmesh.services.emi.service.pool import WorkerPool
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

REPEATS = 5
CASES = (
    ("41x41 dipole B=16", 0.1, "dipole", 16),
    ("41x41 loop B=16", 0.1, "loop", 16),
    ("11x11 dipole B=64", 0.4, "dipole", 64),
    ("11x11 loop B=64", 0.4, "loop", 64),
)
LARGE = 256
PEER = "KF-EKF of the thesis in numpy, one scan at a time"
READY_S = 240.0

Seconds = np.ndarray[tuple[int], np.dtype[np.float64]]


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``."""
    peer = numpy_filter_speed()
    print(f"emi {PEER}: {peer:.2f} scans/s")
    for name, spacing_m, model, count in CASES:
        speed = one_core(scans(spacing_m, model, count))
        print(f"emi {name}: {_line(speed)}")
        compared = spacing_m == 0.1 and model == "dipole"
        yield _row(name, float(np.median(speed)), "scans/s", PEER if compared else None, peer if compared else None)
    thesis = one_core(scans(0.1, "dipole", 16, "kf-ekf-thesis"))
    print(f"emi 41x41 dipole KF-EKF compiled: {_line(thesis)}")
    yield _row("41x41 dipole KF-EKF compiled", float(np.median(thesis)), "scans/s")
    yield from _many(scans(0.1, "loop", LARGE))


def _many(batch: EmiScanBatch) -> Iterator[dict[str, object]]:
    """One core, all cores, each over the network too, memory: wall-clock times of one large batch.

    With as many workers as cores the client and the router take their share from the workers.
    """
    name, n_cores = f"41x41 loop B={LARGE}", cores()
    one, one_there, _ = _here_and_there(batch, 1)
    here, there, memory = _here_and_there(batch, n_cores)
    for case, speed, peer, value in (
        (f"{name} one process", LARGE / one, None, None),
        (f"{name} one process, network", LARGE / one_there, "one process", LARGE / float(np.median(one))),
        (f"{name} {n_cores} processes", LARGE / here, "one process", LARGE / float(np.median(one))),
        (f"{name} network", LARGE / there, f"{n_cores} processes, no network", LARGE / float(np.median(here))),
    ):
        print(f"emi {case}: {_line(speed)}")
        yield _row(case, float(np.median(speed)), "scans/s", peer, value)
    print(f"emi {name} network: service and workers hold {memory:.0f} MiB")
    yield _row(f"{name} memory of service and workers", memory, "MiB")


def _here_and_there(batch: EmiScanBatch, processes: int) -> tuple[Seconds, Seconds, float]:
    """Seconds of repeated runs without and with a network, and the memory of the service, in MiB."""
    with _pool(processes) as local, _service(processes) as client:
        # In turn, so that whatever else the machine does meets both.
        both = [(wall(lambda: local(batch), 1), wall(lambda: client.invert(batch), 1)) for _ in range(REPEATS)]
        here, there = (np.concatenate(times) for times in zip(*both, strict=True))
        return here, there, _memory_mib(os.getpid())


def scans(spacing_m: float, model: str, count: int, estimator: str = "varpro") -> EmiScanBatch:
    """A batch of spheres and rods at 20 dB."""
    transmitter = EmiTransmitter.model_validate({"model": model, "radius_m": 0.5, "turns": 1.0, "current_a": 20.0})
    geometry = survey_geometry((4.0, 4.0), spacing_m, transmitter=transmitter)
    options = EmiOptions.model_validate({"estimator": estimator})
    return simulate(geometry, random_targets(count, seed=1), 20.0, seed=1, options=options).batch


def one_core(batch: EmiScanBatch) -> Seconds:
    """Scans a CPU second of repeated runs of the engine."""
    assert batch.geometry is not None
    request = to_request(batch, batch.geometry, LR_THRESHOLD)
    list(invert(*request))
    speed = np.empty(REPEATS)
    for k in range(REPEATS):
        started = time.process_time()
        list(invert(*request))
        speed[k] = len(batch.field) / (time.process_time() - started)
    return speed


def numpy_filter_speed() -> float:
    """Scans a CPU second of the thesis's filter, from the right place."""
    batch = scans(0.1, "dipole", 1)
    assert batch.geometry is not None
    truth, transmitter = random_targets(1, seed=1), batch.geometry.transmitter
    unit = SCALE * transmitter.current_a * np.pi * transmitter.radius_m**2 / (4.0 * np.pi)
    h = batch.field[0, 0] * 1e-9 / unit
    started = time.process_time()
    separate_kf_ekf(batch.geometry.positions_m, h, truth.position_m[0], truth.elements_m3[0], 10.0, 1e-8)
    return 1.0 / (time.process_time() - started)


def wall(work: Callable[[], Iterable[EmiResult]], repeats: int = 3) -> Seconds:
    """Seconds of repeated runs, after one that is not counted."""
    assert len(list(work())) == LARGE
    seconds = np.empty(repeats)
    for k in range(repeats):
        started = time.perf_counter()
        list(work())
        seconds[k] = time.perf_counter() - started
    return seconds


class _pool:  # noqa: N801 - used as a function
    """A local solver of so many processes, for the time of a block."""

    def __init__(self, processes: int) -> None:
        self._pool = WorkerPool(processes)

    def __enter__(self) -> Callable[[EmiScanBatch], Iterable[EmiResult]]:
        assert self._pool.wait_ready(threading.Event())
        return lambda batch: invert_locally(self._pool, batch)

    def __exit__(self, *exc: object) -> None:
        self._pool.close()


class _service:  # noqa: N801 - used as a function
    """A router, an EMI service of so many processes, and a client of it, for the time of a block."""

    def __init__(self, processes: int) -> None:
        self._processes = processes

    def __enter__(self) -> Client:
        endpoint = f"tcp/127.0.0.1:{random.randrange(20_000, 32_000)}"
        self._folder = tempfile.TemporaryDirectory()
        self._children = Children(Path(self._folder.name))
        self._children.start("router", ["router", "--listen", endpoint])
        self._children.start("emi", ["emi", "--connect", endpoint, "--processes", str(self._processes)])
        self._bus = ZenohBus.open([endpoint], timeout_s=READY_S)
        client = Client(self._bus)
        with client.watch_statuses("emi") as statuses:
            while (status := statuses.receive(READY_S)) is None or status.state != "ready":
                assert status is not None, "the service is not ready in time"
        return client

    def __exit__(self, *exc: object) -> None:
        self._bus.close()
        self._children.stop()
        self._folder.cleanup()


def _memory_mib(parent: int) -> float:
    """Peak resident memory of the EMI service and of its workers."""
    total = 0.0
    for path in Path("/proc").glob("[0-9]*/status"):
        try:
            command = (path.parent / "cmdline").read_bytes().split(b"\0")
            fields = dict(line.split(":\t", 1) for line in path.read_text().splitlines() if ":\t" in line)
        except OSError:
            continue
        own = int(fields["PPid"]) == parent and b"emi" in command
        if own or _is_worker_of_service(command, int(fields["PPid"]), parent):
            total += float(fields["VmHWM"].split()[0]) / 1024.0
    return total


def _is_worker_of_service(command: list[bytes], parent: int, grandparent: int) -> bool:
    if b"trackmesh.services.emi.service.worker" not in command or parent == grandparent:
        return False
    try:
        status = Path(f"/proc/{parent}/status").read_text()
    except OSError:
        return False
    return f"PPid:\t{grandparent}\n" in status


def _row(
    case: str, value: float, unit: str, peer: str | None = None, peer_value: float | None = None
) -> dict[str, object]:
    ratio = value / peer_value if peer_value else None
    return {
        "bench": "emi", "case": case, "value": value, "unit": unit,
        "peer": peer, "peer_value": peer_value, "ratio": ratio,
    }  # fmt: skip


def _line(speed: Seconds) -> str:
    return f"{np.median(speed):.0f} scans/s (min {speed.min():.0f}, max {speed.max():.0f})"


if __name__ == "__main__":
    for _ in rows():
        pass
