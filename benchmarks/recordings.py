"""Real recordings, tracked and scored beside Stone Soup: boats in a harbour (Autoferry), a fast boat at sea (Joyride).

python -m benchmarks.recordings                            those that are beside the repository
python -m benchmarks.recordings --autoferry FOLDER         scenarios from elsewhere, as they are in the dataset
python -m benchmarks.recordings --set gate=12              one setting changed, for all of them

One set of constants for each kind of sensor: examples/harbour.toml for the ferry's radar and lidar, examples/sea.toml
for the ship's radar. Of the Autoferry scenarios, 2 and 6 are only to be scored: choose settings on the others.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.fusion import settings_of
from trackmesh.services.fusion.offline import OfflineRun
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.warm_up import warm_up
from trackmesh.sim.autoferry import Autoferry
from trackmesh.sim.joyride import Joyride
from trackmesh.sim.scoring.nearest import NearestSummary, score_nearest

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
SCENARIOS = (2, 6, 3, 13, 16, 17, 22)
PEER = "Stone Soup 1.9.1, constant velocity and GNN, recorded"
FIGURES = {"gospa_m": ("GOSPA", "m"), "rmse_m": ("RMSE", "m"), "coverage": ("coverage", "share")}


class Recording(NamedTuple):
    """A file, the settings it is tracked with, the cut-off of its score, and what the peer reached, where it ran."""

    name: str
    path: Path
    config: Path
    c_m: float
    peer: dict[str, float]

    def read(self) -> Autoferry | Joyride:
        """Its records and its truth."""
        return Joyride(self.path) if self.path.suffix == ".mat" else Autoferry(self.path)


class Scored(NamedTuple):
    """One recording tracked: its score, and plots a CPU second."""

    recording: Recording
    summary: NearestSummary
    plots_per_s: float


_PEER: dict[int, dict[str, float]] = {
    2: {"gospa_m": 30.3, "rmse_m": 5.5, "coverage": 0.967},
    6: {"gospa_m": 43.4, "rmse_m": 7.3, "coverage": 0.747},
    3: {"rmse_m": 7.7, "coverage": 0.898},
    13: {"rmse_m": 3.7, "coverage": 0.797},
    16: {"rmse_m": 5.2, "coverage": 0.914},
}
_PEER_JOYRIDE = {"gospa_m": 71.0, "rmse_m": 30.6, "coverage": 0.992}


def recordings(autoferry: Path = DATA / "autoferry") -> list[Recording]:
    """Those that there are; scenarios may lie in the folder or, as in the dataset, in one of their own each."""
    harbour, sea = ROOT / "examples" / "harbour.toml", ROOT / "examples" / "sea.toml"
    every = [
        Recording(f"Autoferry {n}", path, harbour, 30.0, _PEER.get(n, {}))
        for n in SCENARIOS
        for path in (autoferry / f"scenario{n}_detections.json", autoferry / f"scenario{n}/scenario{n}_detections.json")
    ]
    every.append(Recording("Joyride", DATA / "joyride" / "joyride.mat", sea, 150.0, _PEER_JOYRIDE))
    return [recording for recording in every if recording.path.exists()]


def track(recording: Recording, changes: dict[str, Any] | None = None) -> Scored:
    """Track and score one; what is compiled for it is not counted."""
    settings = EngineSettings(**tomllib.loads(recording.config.read_text())["engine"] | (changes or {}))
    warm_up(settings)
    source = recording.read()
    records, run = list(source.records()), OfflineRun(settings)
    started_s = time.process_time()
    frames = list(run.frames(records))
    spent_s = time.process_time() - started_s
    return Scored(recording, score_nearest(frames, source.truth(), recording.c_m), run.plots / spent_s)


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``."""
    for recording in recordings():
        found = track(recording)
        print(f"recordings {_line(found)}", flush=True)
        for figure, (title, unit) in FIGURES.items():
            value, peer = getattr(found.summary, figure), recording.peer.get(figure)
            yield {
                "bench": "recordings", "case": f"{recording.name}, {title}", "value": value, "unit": unit,
                "peer": PEER if peer else None, "peer_value": peer, "ratio": value / peer if peer else None,
            }  # fmt: skip


def _line(found: Scored) -> str:
    s, peer = found.summary, found.recording.peer
    beside = {name: f" ({peer[name]:g})" if name in peer else "" for name in FIGURES}
    return (
        f"{found.recording.name:12}: GOSPA {s.gospa_m:.1f} m{beside['gospa_m']}, "
        f"RMSE {s.rmse_m:.2f} m{beside['rmse_m']}, "
        f"coverage {s.coverage:.3f}{beside['coverage']}, {s.false:.2f} tracks without truth, {s.tracks} numbers, "
        f"{found.plots_per_s:.0f} plots/CPU s"
    )


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--autoferry", type=Path, default=DATA / "autoferry", metavar="FOLDER")
    ask.add_argument("--set", action="append", default=[], metavar="NAME=JSON", help="a setting of the engine")
    given = ask.parse_args()
    found = recordings(given.autoferry)
    print(f"in brackets: {PEER}")
    for recording in found:
        print(_line(track(recording, settings_of(given.set))), flush=True)
    there = {recording.name for recording in found}
    missing = [name for name in (*(f"Autoferry {n}" for n in SCENARIOS), "Joyride") if name not in there]
    if missing:
        print(f"not there: {', '.join(missing)}")


if __name__ == "__main__":
    main()
