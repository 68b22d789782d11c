"""The picture of a chaos run: how many targets were tracked, how soon again after each fault, and what memory did."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

if TYPE_CHECKING:
    from benchmarks.faults.chaos import Chaos

mpl.use("Agg")
from matplotlib import pyplot as plt

_COLOURS = {"kill": "tab:red", "cut": "tab:blue", "silent cut": "tab:orange"}


def draw(run: Chaos, path: Path) -> None:
    """Write the picture of a run."""
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(11, 9), layout="constrained", sharex=True)
    shift_s = run._now_s() - time.time_ns() / 1e9
    at_s = np.array([t for t, _ in run.timeline])
    top.step(at_s, [n for _, n in run.timeline], where="post", color="black", lw=0.8)
    top.set_ylabel("targets tracked")
    top.set_title(f"{len(run.judge.judged)} faults in {run.seconds:g} s, seed {run.seed}", loc="left")
    for one in run.judge.judged:
        begin_s = one.fault.began_ns / 1e9 + shift_s
        end_s = one.fault.healed_ns / 1e9 + shift_s
        colour = _COLOURS[one.fault.kind]
        top.axvspan(begin_s, max(end_s, begin_s + 0.3), color=colour, alpha=0.25, lw=0)
        if one.recovered_s:
            values = list(one.recovered_s.values())
            middle.plot([begin_s] * 2, [min(values), max(values)], color=colour, lw=1)
            middle.plot(begin_s, max(values), ".", color=colour)
            middle.annotate(
                one.fault.part[0], (begin_s, max(values)), xytext=(2, 2), textcoords="offset points", size=7
            )
    for kind, colour in _COLOURS.items():
        middle.plot([], [], ".", color=colour, label=kind)
    middle.axhline(10.0, color="grey", ls=":", lw=1)
    middle.set_ylabel("tracked again after, s\n(first to last target)")
    middle.legend(loc="upper right", ncols=3, title="r router, n north, e east, f fusion, c client", fontsize=8)
    for name in run.parts.parts:
        held = [h for h in run.held if h.part == name]
        bottom.plot([h.at_s for h in held], [h.usage.rss_mib for h in held], ".", ms=2, label=name)
    bottom.set_ylabel("resident memory, MiB")
    bottom.set_xlabel("time, s")
    bottom.set_ylim(0, 1.25 * bottom.get_ylim()[1])
    bottom.legend(loc="upper right", ncols=5, markerscale=4, fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
