"""The pictures of the alpha-beta study: the best k_end over lambda, and errors over the plots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.sim.drawing import INK, PAPER, TRACKS, TRUTH
from trackmesh.sim.studies.charts import dress, figure_title, log_ticks, new_figure, save, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = npt.NDArray[np.float64]

_BEST, _PRINTED = TRACKS[0], TRACKS[1]
_K_END_TICKS = (2, 3, 4, 5, 7, 10, 15, 20, 30, 40, 60)
_PLOT_TICKS = (2, 5, 10, 20, 50, 100)
_ERROR_TICKS = (0.5, 1, 2, 3, 5, 7, 10, 15)


class Printed(NamedTuple):
    """A k_end that the paper prints, and its cell."""

    cell: str
    lambda_: float
    k_end: int


class Curves(NamedTuple):
    """Errors in one cell: its title, the name of each filter, standard deviations (filters, plots, 2)."""

    title: str
    names: list[str]
    sigma: FloatArray


def draw_k_end(folder: Path, index: FloatArray, best: FloatArray, rule: FloatArray, printed: list[Printed]) -> Path:
    """Draw over lambda (n,) the best k_end and the ends of its 5 % range (n, 3), the rule (n,), and the paper's values.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((11.0, 6.8))
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlim=(index[0], index[-1]), ylim=(1.8, 70.0))
    label = "at most 5 % more error"
    axes.fill_between(index, best[:, 1], best[:, 2], step="mid", color=_BEST, alpha=0.13, lw=0, label=label)
    axes.step(index, best[:, 0], where="mid", color=_BEST, lw=2.4, label="least RMS position error, computed")
    axes.step(
        index, rule, where="mid", color=INK, lw=1.1, ls=(0, (4, 2)), label="rule: decreasing gains meet the steady ones"
    )
    _draw_printed(axes, printed)
    log_ticks(axes.yaxis, _K_END_TICKS)
    log_ticks(axes.xaxis, (0.01, 0.1, 1, 10))
    dress(axes)
    axes.set_xlabel(r"manoeuvring index  $\lambda = T^2 \sigma_v / \sigma_w$", color=INK)
    axes.set_ylabel(r"$k_\mathrm{end}$", color=INK)
    axes.legend(frameon=False, fontsize=10, labelcolor=INK, loc="upper right")
    title(axes, "Where decreasing gains are best held depends on the manoeuvring index alone")
    return save(figure, folder / "alpha_beta_k_end.png")


def draw_errors(folder: Path, cells: list[Curves]) -> Path:
    """Draw position and velocity errors over the plots, a column a cell.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((3.7 * len(cells) + 0.4, 7.0))
    figure.set_layout_engine("constrained", w_pad=0.1)
    grid = figure.subplots(2, len(cells), sharex=True, sharey="row", squeeze=False)
    for curves, column in zip(cells, grid.T, strict=True):
        for a, axes in enumerate(column):
            _draw_curves(axes, curves, a)
        column[0].set_title(curves.title, loc="left", fontsize=10.5, color=INK)
        column[0].legend(frameon=False, fontsize=9, labelcolor=INK, loc="lower left")
        column[1].set_xlabel("plot", color=INK)
    grid[0, 0].set_ylim(bottom=0.0)
    grid[0, 0].set_ylabel("position (m)", color=INK)
    grid[1, 0].set(yscale="log")
    grid[1, 0].set_ylabel("velocity (m/s)", color=INK)
    log_ticks(grid[1, 0].yaxis, _ERROR_TICKS)
    figure_title(figure, "Standard deviation of the error after each plot")
    return save(figure, folder / "alpha_beta_errors.png")


def _draw_printed(axes: Axes, printed: list[Printed]) -> None:
    """The paper's values; where two have one lambda but different values, they are named."""
    style: dict[str, Any] = {
        "marker": "o",
        "ms": 8.0,
        "mfc": _PRINTED,
        "mec": PAPER,
        "mew": 1.3,
        "ls": "none",
        "zorder": 6,
    }
    axes.plot([p.lambda_ for p in printed], [p.k_end for p in printed], label="printed in the paper", **style)
    for point in printed:
        others = [p.k_end for p in printed if np.isclose(p.lambda_, point.lambda_) and p.k_end != point.k_end]
        if not others:
            continue
        up = point.k_end > others[0]
        axes.annotate(
            f"{point.k_end}\n{point.cell}",
            (point.lambda_, float(point.k_end)),
            xytext=(12.0, 8.0) if up else (-12.0, -8.0),
            textcoords="offset points",
            fontsize=9,
            color=_PRINTED,
            ha="left" if up else "right",
            va="bottom" if up else "top",
        )


def _draw_curves(axes: Axes, curves: Curves, coordinate: int) -> None:
    k = np.arange(2, curves.sigma.shape[1] + 1)
    last = len(curves.names) - 1
    for i, name in enumerate(curves.names):
        color, width = (TRUTH, 4.0) if i == last else (TRACKS[i], 1.6)
        axes.plot(k, curves.sigma[i, 1:, coordinate], label=name, color=color, lw=width, zorder=1 if i == last else 3)
    axes.set(xscale="log", xlim=(2.0, k[-1]))
    log_ticks(axes.xaxis, _PLOT_TICKS)
    dress(axes)
