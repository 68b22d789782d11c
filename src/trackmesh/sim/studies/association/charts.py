"""The pictures of the study, from plain numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER, TRACKS
from trackmesh.sim.studies.charts import dress, figure_title, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OURS, PRINTED = (TRACKS[0], "#8fbbe0"), ("#5d6875", "#c3cad2")
"""Colours of the uncertain and of the Gaussian noise model."""


class Panel(NamedTuple):
    """One method: correct per cent as printed and ours, (2, n), Gaussian then uncertain.

    ``spread`` is the scatter of our runs.
    """

    method: str
    counts: tuple[int, ...]
    printed: FloatArray
    ours: FloatArray
    spread: FloatArray


class Grid(NamedTuple):
    """Per cent of all cases (rows) by all methods (columns): correct and wrong, (n, m)."""

    cases: list[str]
    methods: list[str]
    correct: FloatArray
    wrong: FloatArray


class Band(NamedTuple):
    """What a statistic does over time: low, middle and high values (3, n) in a group of pairs."""

    label: str
    color: str
    values: FloatArray
    filled: bool


class Line(NamedTuple):
    """A line over time, (n,)."""

    label: str
    color: str
    values: FloatArray
    dashed: bool = False


class Evidence(NamedTuple):
    """The three charts of the sum of eq. (28).

    Attributes:
        t_s: (n,). bands: lambda over its degrees of freedom. limits: chi-square over them.
        rejected: share of true pairs rejected, per cent. alpha: what it should be, per cent.
        lag_s, autocorrelation: (m,) of whitened differences. repeats: how much it widens the sum.
    """

    t_s: FloatArray
    bands: list[Band]
    limits: list[Line]
    rejected: list[Line]
    alpha: float
    lag_s: FloatArray
    autocorrelation: FloatArray
    repeats: float


def draw_tables(out: Path, panels: list[Panel], rms: float) -> Path:
    """Draw the 18 numbers, printed beside ours.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((12.5, 5.4))
    row = figure.subplots(1, len(panels), sharey=True)
    for axes, panel in zip(row, panels, strict=True):
        _draw_panel(axes, panel)
    row[0].set_ylabel("correct (%), from 60 on", color=INK)
    row[0].set_ylim(60.0, 100.0)
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, labelcolor=INK)
    figure_title(figure, f"Correct association as printed, and anew with {rms:.1f} points (rms) between")
    return save(figure, out)


def _draw_panel(axes: Axes, panel: Panel) -> None:
    at, width = np.arange(float(len(panel.counts))), 0.2
    for k, noise in enumerate(("gaussian", "uncertain")):
        place = at + (2 * k - 1.5) * width
        axes.bar(place, panel.printed[k], width, color=PRINTED[1 - k], label=f"paper, {noise}", zorder=3)
        axes.bar(
            place + width, panel.ours[k], width, color=OURS[1 - k], label=f"ours, {noise}", zorder=3,
            yerr=panel.spread[k], error_kw={"ecolor": INK, "elinewidth": 0.9, "capsize": 2.0},
        )  # fmt: skip
        for values, shift in ((panel.printed[k], 0.0), (panel.ours[k], width)):
            for x, value in zip(place + shift, values, strict=True):
                ink = PAPER if k else INK
                axes.text(x, 60.6, f"{value:.0f}", ha="center", va="bottom", fontsize=8, color=ink, zorder=5)
    dress(axes)
    axes.grid(visible=False, axis="x")
    axes.set_xticks(at, [f"{count} targets" for count in panel.counts], color=INK)
    axes.set_title(panel.method, loc="left", fontsize=12, color=INK)


def draw_stress(out: Path, without: Grid, registered: Grid) -> Path:
    """Draw what is missed and wrong of every method in every case, without and with registration.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((15.0, 0.5 * len(without.cases) + 2.2))
    row = figure.subplots(1, 2, sharey=True)
    for axes, grid, text in zip(row, (without, registered), ("without registration", "with registration"), strict=True):
        _draw_grid(axes, grid)
        axes.set_title(text, loc="left", fontsize=12, color=INK)
    row[0].set_yticks(range(len(without.cases)), without.cases, color=INK, fontsize=10)
    figure_title(figure, "Correct per cent of possible pairs, and in small print wrong per cent of declared ones")
    return save(figure, out)


def _draw_grid(axes: Axes, grid: Grid) -> None:
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    shades = LinearSegmentedColormap.from_list("errors", ["#f2f6fa", "#ffe3b8", "#e8853d", "#a3202c"])
    errors = np.clip(100.0 - grid.correct + grid.wrong, 0.02, 100.0)
    axes.imshow(errors, cmap=shades, norm=LogNorm(0.05, 60.0), aspect="auto")
    for (i, j), error in np.ndenumerate(errors):
        color = PAPER if error > 12.0 else INK
        correct, wrong = float(grid.correct[i, j]), float(grid.wrong[i, j])
        axes.text(j, i - 0.06, _per_cent(correct), ha="center", va="center", fontsize=9.5, color=color)
        if wrong >= 0.005:
            axes.text(j, i + 0.3, f"{wrong:.2f}", ha="center", va="center", fontsize=7, color=color)
    axes.set_xticks(range(len(grid.methods)), grid.methods, color=INK, fontsize=9.5, rotation=20, ha="right")
    axes.set_xticks(np.arange(len(grid.methods)) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(grid.cases)) - 0.5, minor=True)
    axes.grid(which="minor", color=PAPER, lw=2.0)
    axes.tick_params(which="both", length=0.0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _per_cent(value: float) -> str:
    """With as many digits as tell it from 100."""
    return "100" if value >= 99.995 else f"{value:.2f}" if value >= 99.0 else f"{value:.1f}"


def draw_evidence(out: Path, evidence: Evidence) -> Path:
    """Draw the statistic over time, how many true pairs it rejects, and why.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((15.5, 5.6))
    statistic, rejected, correlated = figure.subplots(1, 3, width_ratios=(1.35, 1.1, 0.9))
    _draw_statistic(statistic, evidence)
    _draw_rejected(rejected, evidence)
    _draw_autocorrelation(correlated, evidence)
    figure_title(
        figure, "The sum of eq. (28) tells true pairs from wrong ones in time, but chi-square is not its limit"
    )
    return save(figure, out)


def _draw_statistic(axes: Axes, evidence: Evidence) -> None:
    for band in evidence.bands:
        low, middle, high = band.values
        if band.filled:
            axes.fill_between(evidence.t_s, low, high, color=band.color, alpha=0.2, lw=0)
        else:
            axes.plot(evidence.t_s, np.array([low, high]).T, color=band.color, lw=0.9, ls=(0, (1, 1.5)))
        axes.plot(evidence.t_s, middle, color=band.color, lw=2.2, label=band.label)
    for line in evidence.limits:
        axes.plot(evidence.t_s, line.values, color=line.color, lw=1.2, ls=(0, (4, 2)), label=line.label)
    axes.set(yscale="log", ylim=(0.15, 40.0), xlim=(evidence.t_s[0], evidence.t_s[-1]))
    axes.set_yticks((0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0), ("0.2", "0.5", "1", "2", "5", "10", "20"))
    axes.minorticks_off()
    _label(axes, "lambda / degrees of freedom", "Middle and 5 to 95 % of pairs")
    axes.legend(frameon=False, fontsize=8.5, labelcolor=INK, loc="upper right")


def _draw_rejected(axes: Axes, evidence: Evidence) -> None:
    for line in evidence.rejected:
        style = (0, (4, 2)) if line.dashed else "-"
        axes.plot(evidence.t_s, line.values, color=line.color, lw=2.0, ls=style, label=line.label)
    label = f"alpha = {evidence.alpha:g} %, as it should be"
    axes.axhline(evidence.alpha, color=INK, lw=1.0, ls=(0, (1, 2)), label=label)
    axes.set(xlim=(evidence.t_s[0], evidence.t_s[-1]), ylim=(-2.0, 102.0))
    _label(axes, "rejected (%)", "True pairs that chi-square rejects")
    axes.legend(frameon=False, fontsize=8.5, labelcolor=INK, loc="center right")


def _draw_autocorrelation(axes: Axes, evidence: Evidence) -> None:
    width = 0.6 * float(evidence.lag_s[1] - evidence.lag_s[0])
    axes.bar(evidence.lag_s, evidence.autocorrelation, width=width, color=TRACKS[0], zorder=3)
    axes.axhline(0.0, color=MUTED, lw=0.8)
    text = f"a sum of squares scatters\nas if each were there\n{evidence.repeats:.1f} times over"
    axes.text(0.96, 0.94, text, transform=axes.transAxes, ha="right", va="top", fontsize=10, color=INK)
    _label(axes, "correlation", "Differences of a pair, some time apart")
    axes.set_xlabel("lag (s)", color=INK)
    axes.set_ylim(-0.05, 1.05)


def _label(axes: Axes, y: str, text: str) -> None:
    dress(axes)
    axes.set_xlabel("time (s)", color=INK)
    axes.set_ylabel(y, color=INK)
    axes.set_title(text, loc="left", fontsize=11, color=INK)
    axes.grid(color=GRID, lw=0.8)
