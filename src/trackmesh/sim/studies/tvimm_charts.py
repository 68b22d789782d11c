"""The pictures of the TV-IMM study: errors over time, and the printed means beside ours."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER, TRACKS
from trackmesh.sim.studies.charts import dress, figure_title, new_figure, save
from trackmesh.sim.studies.tvimm_filters import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOR = {"model 1": "#a9cbe6", "model 2": TRACKS[3], "tvimm": TRACKS[1], "imm": TRACKS[4]}
_WIDTH = {"model 1": 4.0, "model 2": 1.3, "tvimm": 2.0, "imm": 1.3}
"""Model 1 is the widest: the conventional IMM lies upon it."""

_STYLE: tuple[dict[str, Any], ...] = (
    {"marker": "D", "mfc": INK, "mec": INK, "ecolor": INK},
    {"marker": "o", "mfc": TRACKS[1], "mec": TRACKS[1], "ecolor": TRACKS[1]},
    {"marker": "o", "mfc": PAPER, "mec": MUTED, "ecolor": MUTED},
)


class Panel(NamedTuple):
    """One scenario: its title, times (t,), and the error (t,) of each filter."""

    title: str
    t_s: FloatArray
    error_m: dict[str, FloatArray]


class Cells(NamedTuple):
    """One table: its title, and from each source mean and standard deviation of each filter."""

    title: str
    values: dict[str, list[tuple[float, float]]]


def draw_errors(out: Path, title: str, panels: list[Panel], names: dict[str, str], *, from_zero: bool = False) -> Path:
    """Draw the error of every filter over time, a panel a scenario.

    With ``from_zero`` each panel has an axis of its own that starts at zero; else both share one about the errors.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((11.5, 4.0 * len(panels) + 1.0))
    column = figure.subplots(len(panels), 1, sharex=True, sharey=not from_zero, squeeze=False)[:, 0]
    for axes, panel in zip(column, panels, strict=True):
        _draw_panel(axes, panel, names)
        if from_zero:
            axes.set_ylim(bottom=0.0)
    column[-1].set_xlabel("time (s)", color=INK)
    handles, labels = column[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, labelcolor=INK)
    figure_title(figure, title)
    return save(figure, out)


def draw_tables(out: Path, tables: list[Cells], names: dict[str, str]) -> Path:
    """Draw mean and standard deviation of each filter from each source, a panel a table.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((11.5, 5.2))
    row = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
    for axes, cells in zip(row, tables, strict=True):
        _draw_cells(axes, cells)
    row[0].set_yticks(np.arange(len(names)), list(names.values()))
    row[0].tick_params(axis="y", labelsize=11, labelcolor=INK)
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, labelcolor=INK)
    figure_title(figure, "Mean position error, with the standard deviation over the runs")
    return save(figure, out)


def _draw_panel(axes: Axes, panel: Panel, names: dict[str, str]) -> None:
    for name, error_m in panel.error_m.items():
        axes.plot(panel.t_s, error_m, label=names[name], color=_COLOR[name], lw=_WIDTH[name])
    axes.set_xlim(0.0, panel.t_s[-1])
    axes.set_ylabel("position error (m)", color=INK)
    axes.set_title(panel.title, loc="left", fontsize=11, color=INK)
    dress(axes)


def _draw_cells(axes: Axes, cells: Cells) -> None:
    for i, (label, values) in enumerate(cells.values.items()):
        mean, std = np.array(values).T
        y = np.arange(len(mean)) + 0.25 * (i - 1)
        axes.errorbar(mean, y, xerr=std, label=label, ls="none", ms=7.0, elinewidth=1.6, **_STYLE[i])
        for m, s, at in zip(mean, std, y, strict=True):
            axes.annotate(
                f"{m:.3f}", (m + s, at), xytext=(6.0, 0.0), textcoords="offset points", va="center", fontsize=9,
                color=_STYLE[i]["ecolor"],
            )  # fmt: skip
    axes.set_xlim(0.0, 1.12 * axes.get_xlim()[1])
    axes.set_xlabel("position error (m)", color=INK)
    axes.set_title(cells.title, loc="left", fontsize=11, color=INK)
    dress(axes)
    axes.grid(visible=False, axis="y")
    for j in range(0, len(mean), 2):
        axes.axhspan(j - 0.5, j + 0.5, color=GRID, alpha=0.5, lw=0, zorder=0)
    axes.set_ylim(len(mean) - 0.5, -0.5)
