"""The pictures of the study, from plain numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER, TRACKS
from trackmesh.sim.studies.charts import dress, figure_title, new_figure, save, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OURS, PLAIN, ALONE = TRACKS[1], TRACKS[0], TRACKS[3]
_RATIOS = (0.5, 1.32)
"""What is drawn of the ratios; greater ones are told in words."""


class Dots(NamedTuple):
    """Of each cell the ratio of position and of velocity (n, 2), and twice its standard error."""

    label: str
    values: FloatArray
    spread: FloatArray


class Group(NamedTuple):
    """Cells that stand together."""

    title: str
    cells: list[str]
    dots: list[Dots]


class Profile(NamedTuple):
    """A filter's error (m) at times after the onset."""

    label: str
    t_s: FloatArray
    error_m: FloatArray


class FlightSeen(NamedTuple):
    """One flight.

    Attributes:
        t_s: (T,). way_km, seen_km: (T, 2) truth and estimate. busy: (T,) bool manoeuvring.
        error_m: of each filter, (T,). probability: (T, m) of the parts named by ``parts``.
    """

    t_s: FloatArray
    way_km: FloatArray
    seen_km: FloatArray
    busy: FloatArray
    error_m: dict[str, FloatArray]
    parts: list[str]
    probability: FloatArray


def draw_ratios(out: Path, groups: list[Group], reference: str) -> Path:
    """Draw position and velocity ratios of all cells, the groups one below the other.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    sizes = [len(group.cells) for group in groups]
    figure = new_figure((12.5, 0.235 * sum(sizes) + 2.2))
    grid = figure.subplots(len(groups), 2, sharex=True, sharey="row", squeeze=False, height_ratios=sizes)
    for row, group in zip(grid, groups, strict=True):
        for column, axes in enumerate(row):
            _draw_group(axes, group, column)
    for axes, what in zip(grid[-1], ("position", "velocity"), strict=True):
        axes.set_xlabel(f"RMS {what} error over that of the {reference} (bars: two standard errors)", color=INK)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, labelcolor=INK)
    figure_title(figure, "What the default filter gains over the plain IMM, and where it does not")
    return save(figure, out)


def _draw_group(axes: Axes, group: Group, column: int) -> None:
    at = np.arange(float(len(group.cells)))
    for j in range(0, len(at), 2):
        axes.axhspan(j - 0.5, j + 0.5, color=GRID, alpha=0.45, lw=0, zorder=0)
    axes.axvline(1.0, color=INK, lw=1.0, zorder=1)
    for dots in group.dots:
        _draw_dots(axes, dots, dots.values[:, column], dots.spread[:, column], at)
    dress(axes)
    axes.grid(visible=False, axis="y")
    axes.set(xlim=_RATIOS, ylim=(len(at) - 0.5, -0.5), yticks=at)
    axes.set_yticklabels(group.cells, color=INK, fontsize=9)
    axes.tick_params(axis="y", length=0.0)
    if column == 0:
        axes.set_title(group.title, loc="left", fontsize=11, color=INK)


def _draw_dots(axes: Axes, dots: Dots, values: FloatArray, spread: FloatArray, at: FloatArray) -> None:
    color, marker, filled, offset, width = {
        "all plots": (OURS, "o", True, -0.12, 1.8),
        "a fifth missing": (OURS, "o", False, 0.2, 0.9),
    }.get(dots.label, (ALONE, "|", True, -0.12, 0.0))
    axes.errorbar(
        values, at + offset, xerr=spread if width else None, ls="none", marker=marker, ms=6.0, color=color,
        mfc=color if filled else PAPER, mec=color, mew=1.4, elinewidth=width, label=dots.label,
        zorder=4 if filled else 3,
    )  # fmt: skip
    for value, y in zip(values, at + offset, strict=True):
        if value > _RATIOS[1]:
            axes.annotate(
                f"{value:.2f} →", (_RATIOS[1], y), xytext=(-4.0, 0.0), textcoords="offset points", ha="right",
                va="center", fontsize=8, color=color,
            )  # fmt: skip


def draw_onset(out: Path, profiles: list[Profile], cell: str) -> Path:
    """Draw the error after the begin of a manoeuvre; of each filter live, dashed where told later.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((10.0, 5.6))
    axes = figure.subplots()
    for profile in profiles:
        late = "lag" in profile.label
        color = OURS if profile.label.startswith("tvimm") else PLAIN
        axes.plot(
            profile.t_s, profile.error_m, label=profile.label, color=color, lw=1.5 if late else 2.4,
            ls=(0, (4, 2)) if late else "-", marker="o", ms=3.5 if late else 4.5,
        )  # fmt: skip
    dress(axes)
    axes.set(xlim=(0.0, profiles[0].t_s[-1]), ylim=(0.0, None))
    axes.set_xlabel("seconds since the begin of a manoeuvre", color=INK)
    axes.set_ylabel("RMS position error (m)", color=INK)
    axes.legend(frameon=False, labelcolor=INK, fontsize=10, loc="upper right")
    title(axes, f"Position error after the begin of a manoeuvre ({cell})")
    return save(figure, out)


def draw_weights(out: Path, weights: dict[str, FloatArray]) -> Path:
    """Draw the weight of the manoeuvre branch of each flight, a strip for each family of targets.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((10.5, 0.55 * len(weights) + 1.6))
    axes = figure.subplots()
    rng = np.random.default_rng(1)
    for i, values in enumerate(weights.values()):
        y = i + rng.uniform(-0.27, 0.27, len(values))
        axes.plot(values, y, ls="none", marker="o", ms=2.6, color=PLAIN, alpha=0.28, mew=0.0)
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
        axes.plot([low, high], [i, i], color=INK, lw=5.0, solid_capstyle="butt", alpha=0.8, zorder=5)
        axes.plot([middle], [i], marker="o", ms=9.0, mfc=PAPER, mec=INK, mew=1.8, zorder=6)
    dress(axes)
    axes.grid(visible=False, axis="y")
    axes.set(xlim=(0.0, 1.0), ylim=(len(weights) - 0.5, -0.5), yticks=range(len(weights)))
    axes.set_yticklabels(list(weights), color=INK, fontsize=10.5)
    axes.set_xlabel("mean weight of the manoeuvre branch over a flight (circle: median, bar: middle half)", color=INK)
    title(axes, "Which of its two branches the filter trusts, by what the target does")
    return save(figure, out)


def draw_flight(out: Path, flight: FlightSeen) -> Path:
    """Draw a flight with its estimate, the errors, and the probabilities of the models over time.

    Raises:
        TrackmeshError: matplotlib is missing, or the picture cannot be written.
    """
    figure = new_figure((13.0, 6.6))
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 2.2))
    way, error, model = (figure.add_subplot(part) for part in (grid[:, 0], grid[0, 1], grid[1, 1]))
    _draw_way(way, flight)
    for name, values in flight.error_m.items():
        color, width = (OURS, 1.3) if name == "tvimm" else (PLAIN, 1.6)
        error.plot(flight.t_s, values, label=name, color=color, lw=width)
    error.set_ylim(bottom=0.0)
    error.set_ylabel("position error (m)", color=INK)
    error.legend(frameon=False, labelcolor=INK, fontsize=9.5, loc="upper left", ncols=2)
    _draw_probabilities(model, flight)
    for axes in (error, model):
        axes.set_xlim(0.0, flight.t_s[-1])
        dress(axes)
    for begin, end in spans(flight.t_s, flight.busy):
        error.axvspan(begin, end, color=MUTED, alpha=0.16, lw=0, zorder=0)
    figure_title(figure, "One flight: manoeuvres (grey), errors, and how well turns and speed changes fit")
    return save(figure, out)


def _draw_way(axes: Axes, flight: FlightSeen) -> None:
    axes.plot(*flight.way_km.T, color=MUTED, lw=1.2, label="straight")
    turning = np.where(flight.busy[:, None] > 0.5, flight.way_km, np.nan)
    axes.plot(*turning.T, color=INK, lw=3.4, solid_capstyle="round", label="manoeuvre")
    axes.plot(*flight.seen_km.T, color=OURS, lw=1.0, label="tvimm")
    axes.plot(*flight.way_km[0], marker="o", ms=7.0, mfc=PAPER, mec=INK, mew=1.5, ls="none", label="begin")
    dress(axes)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east (km)", color=INK)
    axes.set_ylabel("north (km)", color=INK)
    axes.legend(frameon=False, labelcolor=INK, fontsize=9.5, loc="upper right")


def _draw_probabilities(axes: Axes, flight: FlightSeen) -> None:
    colors = ("#dbe7f3", TRACKS[0], TRACKS[5], TRACKS[3], TRACKS[4], "#cfd5db")
    axes.stackplot(flight.t_s, flight.probability.T, labels=flight.parts, colors=colors, lw=0)
    branch = flight.probability[:, :-1].sum(axis=1)
    axes.plot(flight.t_s, branch, color=INK, lw=1.6, label="weight of the manoeuvre branch")
    for begin, end in spans(flight.t_s, flight.busy):
        axes.plot([begin, end], [1.03, 1.03], color=MUTED, lw=4.0, solid_capstyle="butt", clip_on=False)
    axes.set_ylim(0.0, 1.0)
    axes.set_ylabel("probability", color=INK)
    axes.set_xlabel("time (s)", color=INK)
    axes.legend(
        frameon=False, labelcolor=INK, fontsize=9, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=4,
    )  # fmt: skip


def spans(t_s: FloatArray, busy: FloatArray) -> list[tuple[float, float]]:
    """Times from which on and until which ``busy`` is over a half."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], busy > 0.5, [0]])))
    return [(float(t_s[max(a - 1, 0)]), float(t_s[b - 1])) for a, b in edges.reshape(-1, 2)]
