"""The IMM bank: full cycles a second (mix, predict, update, model probabilities, moment-matched output) on one core.

python -m benchmarks.imm        beside FilterPy's IMMEstimator, one object a track, in the same run

Every track has an interval of its own, so that transition matrices, F and Q are made anew for each. Time is that of
the processor, so that whatever else runs on the machine counts little.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import filterpy
import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter

from trackmesh.services.estimation import batch
from trackmesh.services.estimation.bank import Branch, Models, make_models
from trackmesh.services.estimation.filters import generic_models, manoeuvre_models, velocity_models
from trackmesh.services.estimation.motion import CONSTANT_ACCELERATION, Model
from trackmesh.services.estimation.plots import Plots, make_plots

SIZES = (1, 100, 1_000, 10_000, 100_000)
REPEATS = 7
LEAST_S = 0.1
"""Each repeat lasts at least this long."""
MEMORY_TRACKS = 100_000

SIGMA_M = 30.0
WORDS = (10.0, 18.0, 45.0, 0.3)


class Bank(NamedTuple):
    """One bank: its name in the rows, its models, and the sizes of the peer's filter, if it has one."""

    name: str
    models: Models
    peer: tuple[int, int] | None


def banks() -> list[Bank]:
    """Those that are measured."""
    velocity = [velocity_models([1.0, 50.0, 500.0][:r], [50.0, 15.0, 15.0][:r]) for r in (2, 3)]
    acceleration = tuple(Model(f"ca-{q:g}", CONSTANT_ACCELERATION, q, 0.0, 5.0) for q in (0.1, 1.0, 10.0))
    manoeuvre, generic = manoeuvre_models(float(np.deg2rad(6.0)), *WORDS), generic_models(*WORDS)
    return [
        Bank("r=2 d=4", make_models((velocity[0],)), (2, 4)),
        Bank("r=3 d=4", make_models((velocity[1],)), (3, 4)),
        Bank("r=3 d=6", make_models((Branch(acceleration, (50.0, 15.0, 15.0)),)), (3, 6)),
        Bank("tvimm branch A", make_models((manoeuvre,)), None),
        Bank("tvimm", make_models((manoeuvre, generic)), None),
        Bank("tvimm lag=2", make_models((manoeuvre, generic), lags=2), None),
    ]


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: the median of some repeats."""
    for bank in banks():
        peer = _median(_peer(*bank.peer), 20) if bank.peer else None
        if peer:
            print(f"imm {bank.name}: FilterPy {filterpy.__version__} {peer:,.0f} updates/s")
        for n in SIZES:
            speeds = _speeds(_ours(bank.models, n), n)
            value = float(np.median(speeds))
            ratio = f", {value / peer:.0f} times FilterPy" if peer else ""
            print(f"imm {bank.name} N={n}: {value:,.0f} updates/s ({min(speeds):,.0f} to {max(speeds):,.0f}){ratio}")
            yield _row(f"{bank.name} N={n} numba", value, "updates/s", peer)
    yield from _memory_rows()


def _ours(models: Models, n: int) -> Callable[[], object]:
    """One cycle of n tracks that fly straight; the plots are made outside of it."""
    bank = batch.make_bank(models, n)
    mean, covariance = np.empty((n, 4)), np.empty((n, 4, 4))
    rng = np.random.default_rng(1)
    steps = _plots(rng, n)
    batch.begin(bank, next(steps), 200.0)
    ready = [next(steps) for _ in range(8)]
    k = 0

    def call() -> object:
        nonlocal k
        if k == len(ready):
            # From the first again: the tracks go round.
            k = 0
            bank.states["t_s"] = 0.0
        batch.step(bank, ready[k], mean, covariance)
        k += 1
        return mean

    return call


def _plots(rng: np.random.Generator, n: int) -> Iterator[Plots]:
    position, velocity = rng.uniform(-1e5, 1e5, (n, 2)), rng.normal(0.0, 150.0, (n, 2))
    R, t_s = np.tile([SIGMA_M**2, 0.0, SIGMA_M**2], (n, 1)), np.zeros(n)
    while True:
        yield make_plots(position + t_s[:, None] * velocity + rng.normal(0.0, SIGMA_M, (n, 2)), R, t_s)
        t_s = t_s + rng.uniform(1.0, 2.0, n)


def _peer(r: int, d: int) -> Callable[[], object]:
    """FilterPy's estimator, 20 tracks, all with one interval: its matrices are made once."""
    rng, dt = np.random.default_rng(1), 1.5
    F = np.eye(d)
    for k in range(d - 2):
        F[k, k + 2] = dt
    stay = np.full((r, r), 0.05 / (r - 1)) + (0.95 - 0.05 / (r - 1)) * np.eye(r)
    tracks = []
    for _ in range(20):
        filters = []
        for j in range(r):
            kf = KalmanFilter(d, 2)
            kf.F, kf.H, kf.R, kf.Q = F, np.eye(2, d), SIGMA_M**2 * np.eye(2), 10.0**j * np.eye(d)
            kf.P = 1e3 * np.eye(d)
            filters.append(kf)
        tracks.append(IMMEstimator(filters, np.full(r, 1.0 / r), stay))
    plots = rng.normal(0.0, SIGMA_M, (20, 2, 1))

    def call() -> None:
        for track, plot in zip(tracks, plots, strict=True):
            track.predict()
            track.update(plot)

    return call


def _median(call: Callable[[], object], n: int) -> float:
    return float(np.median(_speeds(call, n)))


def _speeds(call: Callable[[], object], n: int) -> list[float]:
    """Updates a second of each repeat."""
    for _ in range(3):
        call()
    started = time.process_time()
    call()
    times = max(1, int(LEAST_S / max(time.process_time() - started, 1e-7)))
    speeds = []
    for _ in range(REPEATS):
        started = time.process_time()
        for _ in range(times):
            call()
        speeds.append(times * n / (time.process_time() - started))
    return speeds


def _memory_rows() -> Iterator[dict[str, object]]:
    """Peak memory of a process with 100 000 system tracks (head, base, a ring of 24 plots) over one without."""
    for name in ("imm", "tvimm", "alpha-beta"):
        empty, full = (_peak_mib(name, n) for n in (64, MEMORY_TRACKS))
        print(f"imm memory {name}: {full - empty:.0f} MiB for {MEMORY_TRACKS} tracks, ring of 24 plots")
        yield _row(f"{name} N={MEMORY_TRACKS} peak memory", full - empty, "MiB", None)


def _peak_mib(name: str, n: int) -> float:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.imm", "memory", name, str(n)], capture_output=True, text=True, check=True
    )
    return float(json.loads(done.stdout))


def _fill(name: str, n: int) -> None:
    """Begin n system tracks, feed each a plot and predict them, and print the peak memory in MiB."""
    from trackmesh.services.fusion.settings import EngineSettings

    tracks = EngineSettings.model_validate({"filter": name}).system_tracks(n)
    steps = _plots(np.random.default_rng(1), n)
    every = np.arange(n)
    tracks.begin(every, next(steps))
    tracks.feed(every, next(steps))
    tracks.estimate(every, np.full(n, 4.0))
    # Not getrusage: there a new process begins with the peak of the one that started it.
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    print(int(status.partition("VmHWM:")[2].split()[0]) / 1024)


def _row(case: str, value: float, unit: str, peer: float | None) -> dict[str, object]:
    return {
        "bench": "imm", "case": case, "value": value, "unit": unit,
        "peer": f"FilterPy {filterpy.__version__} IMMEstimator" if peer else None,
        "peer_value": peer, "ratio": value / peer if peer else None,
    }  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1:2] == ["memory"]:
        _fill(sys.argv[2], int(sys.argv[3]))
    else:
        for _ in rows():
            pass
