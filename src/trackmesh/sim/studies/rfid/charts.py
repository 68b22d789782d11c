"""The pictures of the RFID study: paths in the hall, and errors over how often readers hear."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.sim.drawing import INK, MUTED, TRACKS, TRUTH
from trackmesh.sim.studies.charts import dress, figure_title, log_ticks, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FloatArray = npt.NDArray[np.float64]

_RATE_TICKS = (0.03, 0.05, 0.1, 0.2)
_RMS_TICKS = (2, 5, 10, 20, 50, 100, 200, 500, 1000)
_NEES_TICKS = (0.5, 1, 2, 5, 10)
UKF, EKF, UNSCENTED, SERVICE = "UKF, printed", "EKF", "2-D unscented", "what the service does"
BEGUN = "UKF, begun as in the slides"
_COLOR = dict(zip((UKF, EKF, SERVICE, UNSCENTED, BEGUN), TRACKS, strict=False))


class Paths(NamedTuple):
    """A title, the true path (k, 2), and estimates of it by name."""

    title: str
    truth: FloatArray
    lines: list[tuple[str, FloatArray]]


class Rates(NamedTuple):
    """Over the probability of detection (k,): names of filters, their RMS error and NEES / 2, both (f, k)."""

    p_detect: FloatArray
    names: list[str]
    rms_m: FloatArray
    nees: FloatArray


def draw_paths(folder: Path, readers: FloatArray, reach_m: float, paths: list[Paths]) -> Path:
    """Draw true and estimated paths among the readers (R, 2), a panel a world.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((6.6 * len(paths), 6.9))
    for one, axes in zip(paths, figure.subplots(1, len(paths), squeeze=False)[0], strict=True):
        _draw_readers(axes, readers, reach_m)
        axes.plot(*one.truth.T, color=TRUTH, lw=5.0, solid_capstyle="round", label="where the tag really was")
        for name, path in one.lines:
            axes.plot(*path.T, color=_COLOR[name], lw=1.2, label=name)
        axes.set(xlim=(-5.0, 107.0), ylim=(-5.0, 107.0), aspect="equal")
        axes.set_xlabel("east (m)", color=INK)
        axes.set_ylabel("north (m)", color=INK)
        axes.set_title(one.title, loc="left", fontsize=11, color=INK)
        dress(axes)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, labelcolor=INK)
    figure_title(figure, "A tag carried through the hall of table 8.1, located by three filters")
    return save(figure, folder / "rfid_paths.png")


def draw_rates(folder: Path, rates: Rates) -> Path:
    """Draw errors and consistency over how often readers hear.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((11.0, 5.2))
    left, right = figure.subplots(1, 2)
    for k, name in enumerate(rates.names):
        left.plot(rates.p_detect, rates.rms_m[k], "o-", color=_COLOR[name], ms=4.0, label=name)
        right.plot(rates.p_detect, rates.nees[k], "o-", color=_COLOR[name], ms=4.0)
    right.axhline(1.0, color=MUTED, lw=1.0, ls=(0, (4, 3)))
    for axes, label, ticks in ((left, "RMS error at all ticks (m)", _RMS_TICKS), (right, "NEES / 2", _NEES_TICKS)):
        axes.set(xscale="log", yscale="log")
        axes.set_xlabel("probability that a reader in reach hears, a tick", color=INK)
        axes.set_ylabel(label, color=INK)
        log_ticks(axes.xaxis, _RATE_TICKS)
        log_ticks(axes.yaxis, tuple(float(tick) for tick in ticks))
        dress(axes)
    left.legend(frameon=False, fontsize=10, labelcolor=INK)
    for height, text in ((0.34, "above 1: too sure of itself"), (0.06, "below 1: too cautious")):
        right.text(0.98, height, text, transform=right.transAxes, ha="right", fontsize=9, color=MUTED)
    figure_title(figure, "Where readers seldom hear, filters differ")
    return save(figure, folder / "rfid_detection.png")


def _draw_readers(axes: Axes, readers: FloatArray, reach_m: float) -> None:
    from matplotlib.patches import Circle

    for east, north in readers.tolist():
        axes.add_patch(Circle((east, north), reach_m, color=TRUTH, alpha=0.06, lw=0))
    axes.plot(*readers.T, ls="none", marker="^", ms=7.0, color=INK, label="readers")
