"""The fusion engine on the two-radar scenario of the peer study: accuracy, and plots a CPU second.

python -m benchmarks.fusion                                    the table of the README
python -m benchmarks.fusion --seeds 1,11-31 --set gate=25      one setting, mean over seeds (tuning)
python -m benchmarks.fusion --stonesoup                        Stone Soup beside it in the same run (minutes)
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from benchmarks import peer_scenario
from trackmesh.protocol.messages import TrackFrame
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

REPEATS = 5


class Run(NamedTuple):
    """One pass over a case: its score, plots a CPU second, and CPU milliseconds a batch."""

    score: dict[str, float]
    plots_per_s: float
    batch_ms: np.ndarray[Any, np.dtype[np.float64]]


def run(case: peer_scenario.Case, settings: EngineSettings) -> Run:
    """Track a case; the time of making frames counts, that of scoring does not."""
    engine = FusionEngine(settings, Unit())
    for sensor in case.sensors:
        engine.sensor(sensor)
    frames: list[TrackFrame] = []
    spent = np.zeros(len(case.batches))
    clock_s = _cost_of_the_clock()
    for k, batch in enumerate(case.batches):
        started = time.process_time()
        frame = engine.plots(batch)
        spent[k] = max(time.process_time() - started - clock_s, 0.0)
        if frame is not None and len(batch.t_ns):
            frames.append(frame)
    return Run(peer_scenario.score(case, frames), case.plots / spent.sum(), spent * 1e3)


def _cost_of_the_clock() -> float:
    """Seconds between two looks at the processor clock, a system call that can cost a tenth of a small batch."""
    looks = np.array([time.process_time() for _ in range(1001)])
    return float(np.median(np.diff(looks)))


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``: plots a CPU second, and GOSPA beside Stone Soup's recorded one."""
    if not peer_scenario.available():
        print("fusion: the peer study is not beside the repository, left out")
        return
    settings = EngineSettings()
    run(peer_scenario.make(1), settings)
    recorded = {2: 610.083, 3: 539.352}
    for seed, peer in recorded.items():
        found = run(peer_scenario.make(seed), settings)
        gospa = found.score["gospa_m"]
        print(f"fusion seed {seed}: {_line(found)}")
        yield _row(f"GOSPA two radars 50 targets seed {seed}", gospa, "m", "Stone Soup 1.9.1 GNN q=50, recorded", peer)
    for name, case in _speed_cases():
        runs = [run(case, settings) for _ in range(REPEATS if case.plots < 20_000 else 2)]
        speed = np.array([r.plots_per_s for r in runs])
        print(f"fusion {name}: {np.median(speed):.0f} plots/CPU s (min {speed.min():.0f}, max {speed.max():.0f})")
        yield _row(name, float(np.median(speed)), "plots/CPU s", None, None)


def _speed_cases() -> Iterator[tuple[str, peer_scenario.Case]]:
    yield "50 targets, scans", peer_scenario.make(2)
    yield "50 targets, 32 sectors", peer_scenario.make(2, sectors=32)
    yield "1000 targets, scans", peer_scenario.make(2, n_targets=1000, duration_s=60.0)
    yield "1000 targets, 32 sectors", peer_scenario.make(2, n_targets=1000, sectors=32, duration_s=30.0)


def _row(case: str, value: float, unit: str, peer: str | None, peer_value: float | None) -> dict[str, object]:
    ratio = None if peer_value is None else value / peer_value
    return {
        "bench": "fusion", "case": case, "value": value, "unit": unit,
        "peer": peer, "peer_value": peer_value, "ratio": ratio,
    }  # fmt: skip


def _line(found: Run) -> str:
    s = found.score
    return (
        f"GOSPA {s['gospa_m']:.1f} m, RMSE {s['rmse_m']:.1f} m, missed {s['missed']:.2f}, false {s['false']:.2f}, "
        f"{s['id_switches']:.0f} switches, {found.plots_per_s:.0f} plots/CPU s, "
        f"batch p50 {np.percentile(found.batch_ms, 50):.2f} ms p99 {np.percentile(found.batch_ms, 99):.2f} ms"
    )


def _stonesoup(seed: int) -> None:
    script = peer_scenario.PEERS / "run_stonesoup.py"
    command = [sys.executable, str(script), "gnn", "--seed", str(seed), "--q", "50"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=peer_scenario.PEERS)
    print(f"stonesoup seed {seed}: {(done.stdout or done.stderr).strip().splitlines()[-1]}")


def seeds_of(text: str) -> list[int]:
    """Seeds as in ``1,11-31``."""
    parts = (part.partition("-") for part in text.split(","))
    return [seed for low, _, high in parts for seed in range(int(low), int(high or low) + 1)]


def settings_of(texts: list[str]) -> dict[str, Any]:
    """Settings as in ``gate=25``, the values JSON."""
    return {name: json.loads(value) for name, _, value in (text.partition("=") for text in texts)}


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--seeds", default="2-7")
    ask.add_argument("--targets", type=int, default=50)
    ask.add_argument("--sectors", type=int, default=1)
    ask.add_argument("--duration", type=float, default=300.0)
    ask.add_argument("--set", action="append", default=[], metavar="NAME=JSON")
    ask.add_argument("--stonesoup", action="store_true")
    given = ask.parse_args()
    settings = EngineSettings(**settings_of(given.set))
    run(peer_scenario.make(1, 5, given.sectors, 60.0), settings)
    scores = []
    for seed in seeds_of(given.seeds):
        found = run(peer_scenario.make(seed, given.targets, given.sectors, given.duration), settings)
        scores.append([found.score[n] for n in ("gospa_m", "rmse_m", "id_switches", "missed", "false")])
        print(f"seed {seed}: {_line(found)}", flush=True)
        if given.stonesoup:
            _stonesoup(seed)
    mean, spread = np.mean(scores, axis=0), np.std(scores, axis=0)
    print(
        f"mean of {len(scores)}: GOSPA {mean[0]:.1f} m (sd {spread[0]:.1f}), "
        f"RMSE {mean[1]:.2f} m (sd {spread[1]:.2f}), switches {mean[2]:.2f}, missed {mean[3]:.3f}, false {mean[4]:.3f}"
    )


if __name__ == "__main__":
    main()
