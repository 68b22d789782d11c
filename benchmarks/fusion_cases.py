"""The fusion engine in all the cases that it must stand, each against its bound.

python -m benchmarks.fusion_cases                                    every case, seeds 2 to 7: some minutes
python -m benchmarks.fusion_cases --cases nominal,late --seeds 2     some of them
python -m benchmarks.fusion_cases --set gate=20 --json out.json      another setting; every run as JSON
python -m benchmarks.fusion_cases --list                             what the cases are
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peer_scenario
from benchmarks.fusion import seeds_of, settings_of
from benchmarks.peer_cases import CASES, DURATION_S, Bound, Case
from benchmarks.trials import FloatArray
from benchmarks.verdicts import judge
from trackmesh.services.fusion.settings import EngineSettings

Figures = dict[str, float]
Runs = dict[int, Figures]
"""Figures by seed."""

COLUMNS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("GOSPA m", ("gospa_m",)),
    ("RMSE m", ("rmse_m",)),
    ("switches", ("switches",)),
    ("missed / false", ("missed", "false")),
    ("kept %", ("kept_pct",)),
    ("NEES", ("nees",)),
    ("15-40 s: GOSPA m / missed %", ("start_gospa_m", "start_missed_pct")),
    ("shown after s / gone after s", ("shown_after_s", "gone_after_s")),
    ("bias error after 120 s: m / deg", ("bias_120_m", "bias_120_deg")),
    ("at the end: m / deg", ("bias_m", "bias_deg")),
    ("pairs right % / paired %", ("pairs_right_pct", "paired_pct")),
)
"""Titles, and the figures that stand under them."""

DECIMALS = {
    "gospa_m": 0, "start_gospa_m": 0, "rmse_m": 1, "switches": 1, "kept_pct": 1, "bias_120_m": 1, "bias_m": 1,
    "shown_after_s": 1, "gone_after_s": 1,
    "bias_120_deg": 3, "bias_deg": 3,
}  # fmt: skip
"""Others have two."""


def run_case(case: Case, seeds: Iterable[int], changes: dict[str, Any], duration_s: float = DURATION_S) -> Runs:
    """One case for each seed; of settings, those that belong to the case come before ``changes``."""
    settings = EngineSettings(**changes | case.settings)
    return {seed: judge(case.make(seed, duration_s), settings) for seed in seeds}


def mean(runs: Runs) -> Figures:
    """The mean of each figure over the seeds that have it, NaN where none has."""
    return {name: float(np.mean(values)) if len(values) else np.nan for name, values in _columns(runs)}


def spread(runs: Runs) -> Figures:
    """The standard deviation of each figure over the seeds that have it, NaN for fewer than two."""
    return {name: float(np.std(values)) if len(values) > 1 else np.nan for name, values in _columns(runs)}


def judged(bound: Bound, case: str, means: dict[str, Figures]) -> bool:
    """Whether a case keeps a bound; the case that scales it must be there."""
    limit = bound.limit * (means[bound.of][bound.figure] if bound.of else 1.0)
    value = means[case][bound.figure]
    return value >= limit if bound.least else value <= limit


def table(every: dict[str, Runs]) -> str:
    """Markdown: the mean of every case, its spread over seeds in brackets, and whether the bounds are kept."""
    means = {name: mean(runs) for name, runs in every.items()}
    titles = ["case", *(title for title, _ in COLUMNS), "bound", ""]
    lines = [_row(titles), _row(["---"] * len(titles))]
    for name, runs in every.items():
        far = spread(runs)
        cells = [_cell(means[name], far, figures) for _, figures in COLUMNS]
        kept = [(bound.text(), judged(bound, name, means)) for bound in CASES[name].bounds if _there(bound, means)]
        texts, verdict = "<br>".join(text for text, _ in kept), "<br>".join("ok" if ok else "SHORT" for _, ok in kept)
        lines.append(_row([name, *cells, texts, verdict]))
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    given = _arguments().parse_args()
    if given.list:
        print("\n".join(f"{case.name:20} {case.about}" for case in CASES.values()))
        return
    if not peer_scenario.available():
        sys.exit("fusion_cases: the peers' scenario is not beside the repository.")
    names, seeds = _names(given.cases), seeds_of(given.seeds)
    changes = settings_of(given.set)
    every: dict[str, Runs] = {}
    for name in names:
        every[name] = run_case(CASES[name], seeds, changes, given.duration)
        _say(f"{name}: {_line(mean(every[name]))}")
    print(table(every))
    if given.json:
        rows = [{"case": n, "seed": seed, **_finite(f)} for n, runs in every.items() for seed, f in runs.items()]
        given.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _arguments() -> argparse.ArgumentParser:
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--cases", metavar="A,B", help="default: all; what they are compared with is run as well")
    ask.add_argument("--seeds", default="2-7")
    ask.add_argument("--duration", type=float, default=DURATION_S, help="seconds; events move in proportion")
    ask.add_argument("--set", action="append", default=[], metavar="NAME=JSON", help="a setting of the engine")
    ask.add_argument("--json", type=Path, metavar="FILE", help="write the figures of every run")
    ask.add_argument("--list", action="store_true", help="say what the cases are")
    return ask


def _names(text: str | None) -> list[str]:
    names = text.split(",") if text else list(CASES)
    unknown = [name for name in names if name not in CASES]
    if unknown:
        sys.exit(f"fusion_cases: there is no case {unknown[0]!r}; there are {', '.join(CASES)}.")
    needed = {bound.of for name in names for bound in CASES[name].bounds if bound.of}
    return [name for name in CASES if name in needed or name in names]


def _columns(runs: Runs) -> Iterator[tuple[str, FloatArray]]:
    for name in next(iter(runs.values())):
        values = np.array([figures[name] for figures in runs.values()])
        yield name, values[np.isfinite(values)]


def _there(bound: Bound, means: dict[str, Figures]) -> bool:
    return bound.of is None or bound.of in means


def _cell(means: Figures, far: Figures, names: tuple[str, ...]) -> str:
    return " / ".join(_number(means[name], far[name], DECIMALS.get(name, 2)) for name in names).strip(" /")


def _number(value: float, far: float, decimals: int) -> str:
    if np.isnan(value):
        return ""
    return f"{value:.{decimals}f}" + ("" if np.isnan(far) else f" ({far:.{decimals}f})")


def _line(means: Figures) -> str:
    return (
        f"GOSPA {means['gospa_m']:.0f} m, RMSE {means['rmse_m']:.1f} m, {means['switches']:.1f} switches, "
        f"missed {means['missed']:.2f}, false {means['false']:.2f}, kept {means['kept_pct']:.1f} %"
    )


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _finite(figures: Figures) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in figures.items()}


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
