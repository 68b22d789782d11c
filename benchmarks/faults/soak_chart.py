"""The picture of a soak: memory, handles and threads of every process, and latency, over time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl

if TYPE_CHECKING:
    from benchmarks.faults.soak import Held, Window

mpl.use("Agg")
from matplotlib import pyplot as plt


def draw(held: list[Held], windows: list[Window], names: list[str], path: Path) -> None:
    """Write the picture of a run."""
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(10, 9), layout="constrained", sharex=True)
    for colour, name in zip(plt.colormaps["tab10"].colors, names, strict=False):  # type: ignore[attr-defined]
        mine = [h for h in held if h.part == name]
        minutes = [h.at_s / 60.0 for h in mine]
        top.plot(minutes, [h.usage.rss_mib for h in mine], color=colour, label=name)
        middle.plot(minutes, [h.usage.handles for h in mine], color=colour, label=f"{name}, handles")
        middle.plot(minutes, [h.usage.threads for h in mine], color=colour, ls=":")
    top.set_ylabel("resident memory, MiB")
    top.set_ylim(bottom=0)
    top.legend(ncols=len(names), fontsize=8)
    middle.set_ylabel("file handles (lines), threads (dots)")
    middle.set_ylim(bottom=0)
    minutes = [w.at_s / 60.0 for w in windows]
    bottom.plot(minutes, [w.p50_ms for w in windows], color="tab:green", label="p50")
    bottom.plot(minutes, [w.p99_ms for w in windows], color="tab:red", label="p99")
    bottom.set_ylabel("plot to frame, ms")
    bottom.set_yscale("log")
    bottom.set_xlabel("time, minutes")
    bottom.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
