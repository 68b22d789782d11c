"""Two units, a radar each, on the two-radar scenario: what the tracks of the one are worth to the other.

python -m benchmarks.composition                                 seeds 2 to 7
python -m benchmarks.composition --seeds 2 --case bias --set input_q_m2ps3=30

Scored are the pictures after each look of the second radar: of a unit that has this radar alone, of one that takes the
first unit's tracks as well, of one of two that take each other's, and of one that has both radars.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks import peer_cases
from benchmarks.fusion import seeds_of, settings_of
from benchmarks.trials import EAST, NORTH, Trial
from benchmarks.verdicts import Shown, kept_pct, picture_figures
from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.services.fusion.warm_up import warm_up

Figures = dict[str, float]

CASES = ("nominal", "formation", "crossing", "pd-70", "pd-70-clutter-200", "bias-150", "sectors-32")
ARRANGEMENTS = ("alone", "with the first's tracks", "both with each other's", "both radars")


def unit(
    name: str, number: int, trial: Trial, sensors: Sequence[str], settings: EngineSettings, *inputs: str
) -> FusionEngine:
    engine = FusionEngine(settings, Unit(name, number), inputs=inputs)
    for info in trial.sensors:
        if info.sensor_id in sensors:
            engine.sensor(info)
    return engine


class Pair:
    """The first unit has the north radar, the second the east one; frames pass at once.

    Attributes:
        shown: the second's pictures after each look of its radar. spent_s: CPU time of the second.
    """

    def __init__(self, trial: Trial, settings: EngineSettings, first_hears: bool, second_hears: bool) -> None:
        self.first = unit("first", 1, trial, [NORTH], settings, *(["second"] if first_hears else []))
        self.second = unit("second", 2, trial, [EAST], settings, *(["first"] if second_hears else []))
        self.shown: Shown = []
        self.spent_s = 0.0

    def run(self, trial: Trial) -> None:
        for feed in trial.feeds:
            of_first = feed.batch.sensor_id == NORTH
            engine, other = (self.first, self.second) if of_first else (self.second, self.first)
            started = time.process_time()
            frame = engine.plots(feed.batch)
            self.spent_s += 0.0 if of_first else time.process_time() - started
            if frame is None:
                continue
            if not of_first and len(feed.target):
                self.shown.append((feed.arrival_s, frame))
            while frame is not None and other.inputs.banks:
                started = time.process_time()
                frame = other.tracks(frame)
                self.spent_s += time.process_time() - started if other is self.second else 0.0
                engine, other = other, engine


def central(trial: Trial, settings: EngineSettings) -> Shown:
    """Pictures of a unit with both radars, after each look of the east one."""
    engine = unit("both", 3, trial, [NORTH, EAST], settings)
    shown: Shown = []
    for feed in trial.feeds:
        frame = engine.plots(feed.batch)
        if frame is not None and feed.batch.sensor_id == EAST and len(feed.target):
            shown.append((feed.arrival_s, frame))
    return shown


def figures(trial: Trial, settings: EngineSettings) -> Iterator[tuple[str, Figures]]:
    """One arrangement after the other."""
    for name, first_hears, second_hears in zip(ARRANGEMENTS, (False, False, True), (False, True, True), strict=False):
        pair = Pair(trial, settings, first_hears, second_hears)
        pair.run(trial)
        yield name, _figures(trial, pair.shown) | {"cpu_s": pair.spent_s}
    yield ARRANGEMENTS[-1], _figures(trial, central(trial, settings)) | {"cpu_s": np.nan}


def _figures(trial: Trial, shown: Shown) -> Figures:
    return picture_figures(trial, shown) | {"kept_pct": kept_pct(trial, shown)}


def main() -> None:
    """Command line."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--seeds", default="2-7")
    ask.add_argument("--cases", default="nominal", help=", ".join(CASES))
    ask.add_argument("--duration", type=float, default=300.0)
    ask.add_argument("--set", action="append", default=[], metavar="NAME=JSON", help="a setting of the engine")
    given = ask.parse_args()
    settings = EngineSettings(**settings_of(given.set))
    warm_up(settings, inputs=True)
    for case in given.cases.split(","):
        rows: dict[str, list[Figures]] = {}
        for seed in seeds_of(given.seeds):
            for name, found in figures(peer_cases.CASES[case].make(seed, given.duration), settings):
                rows.setdefault(name, []).append(found)
        print(f"{case}, mean of {len(rows[ARRANGEMENTS[0]])}")
        for name, runs in rows.items():
            means = {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}
            print(f"  {name:24} {_line(means)}", flush=True)


def _line(found: dict[str, Any]) -> str:
    return (
        f"GOSPA {found['gospa_m']:6.1f} m, RMSE {found['rmse_m']:6.1f} m, NEES {found['nees']:.2f}, "
        f"missed {found['missed']:.2f}, false {found['false']:.2f}, {found['switches']:.1f} switches, "
        f"kept {found['kept_pct']:.1f} %, {found['cpu_s']:.2f} s of CPU"
    )


if __name__ == "__main__":
    main()
