"""Induction scans drawn with what was found in them: the map of the field, the targets, a section through them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import EmiGeometry, EmiResult, EmiScanBatch, EmiTarget
from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER
from trackmesh.sim.studies.charts import dress, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ELLIPSE_CHI2 = 5.991
"""95 % of a normal distribution in the plane."""
MOST_PICTURES = 200
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
ELLIPSE_PART = 0.03
"""Of the picture's width: smaller ellipses are magnified, and the legend says by how much."""
DOTS = 3000
"""Samples are shown as dots up to so many."""
FLAT = 1e-6
FIELD_MAP = "cividis"
TARGETS = ("#d1495b", "#e08a1e", "#2a9d6f")


class MapOf(NamedTuple):
    """The size of the field over the places where it was measured: (n, 2) and (n,)."""

    place_m: FloatArray
    size: FloatArray


def draw_scans(batches: Sequence[EmiScanBatch], results: Sequence[EmiResult], folder: Path) -> list[Path]:
    """One picture a result, ``BATCH-INDEX.png`` in ``folder``.

    Raises:
        TrackmeshError: matplotlib is missing, a batch does not bring its geometry, there are too many, or a file cannot
            be written.
    """
    by_id = {batch.batch_id: batch for batch in batches}
    if len(results) > MOST_PICTURES:
        raise TrackmeshError(f"{len(results)} scans are too many to draw; at most {MOST_PICTURES}.")
    return [draw_scan(by_id[r.batch_id], r, folder / f"{r.batch_id}-{r.index}.png") for r in results]


def draw_scan(batch: EmiScanBatch, result: EmiResult, out: Path) -> Path:
    """The map of one scan with its targets and their 95 % ellipses, and a section; returns ``out``.

    Raises:
        TrackmeshError: matplotlib is missing, the batch does not bring its geometry, or the file cannot be written.
    """
    if batch.geometry is None:
        raise TrackmeshError(f"The batch {batch.batch_id} brings no geometry to draw it by.")
    figure = new_figure((11.0, 5.4))
    over, section = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
    seen = field_map(batch, result.index)
    draw_map(over, seen, f"|B|, {batch.field_unit}")
    magnified = magnification(result.targets, float(np.ptp(seen.place_m, axis=0).max()))
    for i, target in enumerate(result.targets):
        draw_target(over, target, TARGETS[i % len(TARGETS)], magnified)
    draw_section(section, batch.geometry, result.targets, magnified)
    if magnified > 1:
        section.annotate(
            f"ellipses (95 %) magnified {magnified} times", (1.0, 1.01), xycoords="axes fraction",
            ha="right", va="bottom", fontsize=8, color=MUTED,
        )  # fmt: skip
    figure.suptitle(
        f"{batch.batch_id}, scan {result.index}: {result.status.replace('_', ' ')}",
        x=0.01, ha="left", fontsize=14, fontweight="bold", color=INK,
    )  # fmt: skip
    figure.text(0.01, -0.02, told(result), fontsize=9, color=INK, va="top")
    return save(figure, out)


def field_map(batch: EmiScanBatch, index: int) -> MapOf:
    """|B| of a scan's strongest channel, its background (the median of each component) taken off."""
    geometry = batch.geometry
    assert geometry is not None
    field = batch.field[index]
    there = np.isfinite(field)
    level = np.median(np.where(there, field, 0.0), axis=1, keepdims=True)
    power = np.where(there, field - level, 0.0) ** 2
    channel = int(np.argmax(power.sum((1, 2))))
    sizes, places, first = [], [], 0
    for receiver in geometry.all_receivers:
        last = first + receiver.n_components
        sizes.append(np.sqrt(power[channel, :, first:last].sum(1)))
        places.append(geometry.positions_m[:, :2] + 0.5 * np.add(receiver.offset_m, geometry.transmitter.offset_m)[:2])
        first = last
    return MapOf(np.concatenate(places), np.concatenate(sizes))


def draw_map(axes: Axes, seen: MapOf, label: str) -> None:
    """The map as filled contours; of a single line as a profile."""
    place, size = seen
    spread = np.linalg.svd(place - place.mean(0), compute_uv=False)
    dress(axes)
    if len(place) < 4 or spread[-1] <= FLAT * max(spread[0], 1e-300):
        _draw_profile(axes, seen, label)
        return
    shown = axes.tricontourf(place[:, 0], place[:, 1], size, levels=24, cmap=FIELD_MAP)
    bar = axes.figure.colorbar(shown, ax=axes, pad=0.02, shrink=0.85, aspect=30)
    bar.ax.set_title(label, fontsize=9, color=MUTED, loc="left")
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, colors=MUTED)
    if len(place) <= DOTS:
        axes.plot(*place.T, ".", color=PAPER, ms=1.0, alpha=0.35)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m", color=MUTED)
    axes.set_ylabel("y, m", color=MUTED)


def _draw_profile(axes: Axes, seen: MapOf, label: str) -> None:
    along = seen.place_m - seen.place_m[0]
    axes.plot(np.hypot(*along.T), seen.size, ".-", color=INK, lw=1.0, ms=3.0)
    axes.set_xlabel("along the line, m", color=MUTED)
    axes.set_ylabel(label, color=MUTED)


def draw_target(axes: Axes, target: EmiTarget, color: str, magnified: int) -> None:
    """A target from above: place, ellipse, and where its axis points."""
    x, y, _ = target.position_m
    axes.plot(x, y, "+", color=color, ms=10, mew=2.0, zorder=5)
    axes.plot(*ellipse(target.position_m[:2], target.covariance[:2, :2], magnified), color=color, lw=1.6, zorder=5)
    _draw_axis(axes, target, (x, y), 0, 1, color)
    axes.annotate(
        f"{target.depth_m:.2f} m", (x, y), xytext=(10, 8), textcoords="offset points", fontsize=9, color=INK, zorder=6,
        bbox={"boxstyle": "round,pad=0.2", "fc": PAPER, "ec": "none", "alpha": 0.8},
    )  # fmt: skip


def draw_section(axes: Axes, geometry: EmiGeometry, targets: Sequence[EmiTarget], magnified: int) -> None:
    """Targets from the side, x against z, below the sensor."""
    dress(axes)
    axes.plot(geometry.positions_m[:, 0], geometry.positions_m[:, 2], ".", color=MUTED, ms=1.5)
    axes.annotate("sensor", (float(geometry.positions_m[:, 0].min()), float(geometry.positions_m[:, 2].max())),
                  xytext=(0, 5), textcoords="offset points", fontsize=9, color=MUTED)  # fmt: skip
    for i, target in enumerate(targets):
        color, (x, _, z) = TARGETS[i % len(TARGETS)], target.position_m
        axes.plot(x, z, "+", color=color, ms=10, mew=2.0, zorder=5)
        block = target.covariance[np.ix_((0, 2), (0, 2))]
        axes.plot(*ellipse([x, z], block, magnified), color=color, lw=1.6, zorder=5)
        _draw_axis(axes, target, (x, z), 0, 2, color)
    if not targets:
        axes.text(0.5, 0.5, "no target told", transform=axes.transAxes, ha="center", color=MUTED)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m", color=MUTED)
    axes.set_ylabel("z, m", color=MUTED)
    axes.spines["top"].set_color(GRID)


def _draw_axis(axes: Axes, target: EmiTarget, at: tuple[float, float], i: int, j: int, color: str) -> None:
    if target.axis is None:
        return
    length = 0.3 * max(abs(target.depth_m), 0.1)
    step = np.array([target.axis[i], target.axis[j]]) * length
    axes.plot(*np.stack([at - step, at + step], 1), color=color, lw=2.5, alpha=0.7, solid_capstyle="round", zorder=4)


def ellipse(middle: Sequence[float], covariance: FloatArray, magnified: int) -> FloatArray:
    """The 95 % ellipse of a place in the plane, magnified: (2, n)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radii = magnified * np.sqrt(ELLIPSE_CHI2 * np.maximum(values, 0.0))
    return np.asarray(np.array(middle)[:, None] + vectors @ (radii[:, None] * circle))


def magnification(targets: Sequence[EmiTarget], width_m: float) -> int:
    """How much ellipses have to be magnified to be seen."""
    largest = max((math.sqrt(float(np.diagonal(t.covariance)[:3].max())) for t in targets), default=math.inf)
    wanted = ELLIPSE_PART * width_m
    return next((m for m in MAGNIFICATIONS if m * math.sqrt(ELLIPSE_CHI2) * largest >= wanted), MAGNIFICATIONS[-1])


def told(result: EmiResult) -> str:
    """The numbers of a result, for people: a line a target, then why."""
    lines = []
    for target in result.targets:
        sd = np.sqrt(np.diagonal(target.covariance)[:3])
        place = ", ".join(f"{v:.3f} ± {s:.3f}" for v, s in zip(target.position_m, sd.tolist(), strict=True))
        principal = ", ".join(f"{v:.3g}" for v in target.principal_m3)
        lines.append(f"x, y, z: {place} m   principal: {principal} m³ ({target.shape})")
    fit = f"chi2/dof {result.chi2 / result.dof:.3f}" if result.chi2 is not None and result.dof else "no fit"
    return "\n".join([*lines, f"{fit}   {', '.join(result.reasons)}"])
