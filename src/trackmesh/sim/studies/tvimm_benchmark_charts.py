"""The picture of the benchmark with one position for all models."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.drawing import INK, MUTED, TRACKS
from trackmesh.sim.studies.charts import dress, log_ticks, new_figure, save, title
from trackmesh.sim.studies.manoeuvre.charts import spans

_STYLE: dict[str, dict[str, Any]] = {
    "imm": {"color": "#a9cbe6", "lw": 5.0, "label": "conventional IMM"},
    "tvimm-dirichlet": {"color": TRACKS[0], "lw": 1.3, "label": "transitions learned"},
    "tvimm-paper": {"color": TRACKS[4], "lw": 1.8, "label": "TV-IMM as published"},
    "tvimm": {"color": TRACKS[1], "lw": 2.2, "label": "the service's default"},
}
_TICKS = (5, 10, 20, 50, 100, 200, 500, 1000)


class Curves(NamedTuple):
    """Times (T,), whether the target manoeuvres (T,), and the RMS error (T,) of each filter."""

    t_s: FloatArray
    busy: FloatArray
    error_m: dict[str, FloatArray]


def draw_error(out: Path, curves: Curves) -> Path:
    """Draw the RMS position error of the filters over time.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((11.0, 5.6))
    axes = figure.subplots()
    for name, error_m in curves.error_m.items():
        axes.plot(curves.t_s, error_m, **_STYLE[name])
    for begin, end in spans(curves.t_s, curves.busy):
        axes.axvspan(begin, end, color=MUTED, alpha=0.16, lw=0, zorder=0)
    axes.set(yscale="log", xlim=(0.0, curves.t_s[-1]))
    log_ticks(axes.yaxis, _TICKS)
    dress(axes)
    axes.set_xlabel("time (s); manoeuvres grey", color=INK)
    axes.set_ylabel("RMS position error (m)", color=INK)
    axes.legend(frameon=False, labelcolor=INK, fontsize=10, loc="upper left", ncols=2)
    title(axes, "One position for all models (set A), measured with 20 m")
    return save(figure, out)
