"""Tracks drawn over the truth and the plots, as one picture in a file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import (
    Geodetic,
    Message,
    PlotBatch,
    SensorInfo,
    TrackFrame,
    TruthFrame,
)
from trackmesh.sim.plane import plot_positions, site_enu_m
from trackmesh.sim.scoring import Picture, picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_FRAMES = 800
"""Frames are thinned to about this many: the eye sees no more."""

MAX_LABELS = 80
"""Beyond this many tracks their numbers would hide the picture."""

ELLIPSE_SIGMA = 2.0
ELLIPSE_FILL = 0.22
ELLIPSE_PART = 0.014
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)
"""Ellipses too small to be seen are magnified, and the legend says by how much."""

COUNTER = 2**41 - 1
"""The part of a track's id that its unit counts."""

NEAR_KM = 5.0
"""A smaller picture has its axes in metres."""

GAP_S = 20.0
"""A track that was not shown for longer is drawn with a gap."""

PAPER, INK, MUTED = "#ffffff", "#1f2733", "#7b8794"
TRUTH, PLOT, GRID = "#b4bcc6", "#8fa3b8", "#e9edf1"
TRACKS = ("#1769aa", "#d1495b", "#2a9d6f", "#e08a1e", "#7353ba", "#0f8b8d", "#b5467f", "#6b8e23", "#3d5a80", "#a0522d")


class Path2D(NamedTuple):
    """One track or target: times (k,), positions in km (k, 2), and whether it coasts at each (k,)."""

    t_s: FloatArray
    km: FloatArray
    coasting: npt.NDArray[np.bool_]


@dataclass
class PlotScene:
    """What PLOTS.jsonl says: where the plots and the sensors are, in km."""

    plots_km: list[FloatArray] = field(default_factory=list)
    sensors: dict[str, SensorInfo] = field(default_factory=dict)
    sites_km: dict[str, FloatArray] = field(default_factory=dict)
    origin: Geodetic | None = None

    @classmethod
    def read(cls, records: Iterable[Message]) -> PlotScene:
        """Gather the records of a recording of plots.

        Raises:
            TrackmeshError: a batch comes before its sensor, or has no place in the plane.
        """
        scene = cls()
        for record in records:
            if isinstance(record, Geodetic):
                scene.origin = record
            elif isinstance(record, SensorInfo):
                scene._add_sensor(record)
            elif isinstance(record, PlotBatch):
                scene._add_batch(record)
        return scene

    def _add_sensor(self, info: SensorInfo) -> None:
        self.sensors[info.sensor_id] = info
        if (site := site_enu_m(info, self.origin)) is not None:
            self.sites_km[info.sensor_id] = np.array(site) / 1e3

    def _add_batch(self, batch: PlotBatch) -> None:
        if not len(batch.t_ns):
            return
        info = self.sensors.get(batch.sensor_id)
        if info is None:
            raise TrackmeshError(f"Plots of {batch.sensor_id!r} come before it has said who it is.")
        self.plots_km.append(plot_positions(batch, info, self.origin) / 1e3)


def draw_tracks(
    frames: Iterable[TrackFrame],
    truth: Iterable[TruthFrame] | None = None,
    plots: Iterable[Message] | None = None,
    *,
    out: Path,
    title: str | None = None,
) -> None:
    """Draw the tracks of ``frames``, over truth and plots where given, into the file ``out`` (.png, .svg or .pdf).

    Confirmed stretches are solid lines, coasting ones dotted; a dot marks the last position, hollow where the track
    coasts, within its 2-sigma ellipse. ``plots`` are the records of a PLOTS.jsonl.

    Raises:
        TrackmeshError: matplotlib is not installed, nothing is there to draw, or the file cannot be written.
    """
    figure = _figure()
    history = list(frames)
    tracks, targets = track_paths(history), truth_paths(truth or ())
    scene = PlotScene.read(plots or ())
    if not tracks and not targets and not scene.plots_km:
        raise TrackmeshError("There is nothing to draw: no confirmed track, no truth and no plot.")
    axes, few = figure.subplots(), len(tracks) <= MAX_LABELS
    span_km = _frame(axes, [*tracks.values(), *targets.values()], scene)
    _draw_scene(axes, scene)
    _draw_truth(axes, targets, 3.2 if few else 1.8)
    _draw_lines(axes, tracks, 1.5 if few else 0.8)
    last, magnified = picture(history[-1]) if history else None, 0
    if last:
        magnified = magnification(last, span_km) if few else 0
        _draw_last(axes, last, magnified, short_names(tracks) if few else {})
    n_tracks, n_targets = len(tracks) if history else None, len(targets) if truth is not None else None
    _title(axes, title or _counts(n_tracks, n_targets, scene), _span(history))
    _legend(figure, tracks, targets, scene, magnified)
    _save(figure, out)


def track_paths(frames: list[TrackFrame]) -> dict[int, Path2D]:
    """The path of each track that was ever confirmed, by its id; the frames are thinned, the last one is kept."""
    stride = -(-len(frames) // MAX_FRAMES) if frames else 1
    kept = frames[::-1][::stride][::-1]
    pictures = [picture(frame) for frame in kept]
    return _by_id(
        [shown.track_id for shown in pictures],
        [np.full(len(p.track_id), (f.t_ns - frames[0].t_ns) * 1e-9) for f, p in zip(kept, pictures, strict=True)],
        [shown.position_m / 1e3 for shown in pictures],
        [shown.coasting for shown in pictures],
    )


def truth_paths(frames: Iterable[TruthFrame]) -> dict[int, Path2D]:
    """The path of each target, by its id."""
    kept = list(frames)
    return _by_id(
        [frame.id for frame in kept],
        [np.full(len(frame.id), (frame.t_ns - kept[0].t_ns) * 1e-9) for frame in kept],
        [frame.state[:, :2] / 1e3 for frame in kept],
        [np.zeros(len(frame.id), np.bool_) for frame in kept],
    )


def ellipse(covariance: FloatArray, sigma: float = ELLIPSE_SIGMA) -> tuple[float, float, float]:
    """Full width and height, and angle in degrees anticlockwise from east, of the ellipse of a (2, 2) matrix."""
    values, vectors = np.linalg.eigh(covariance)
    minor, major = 2.0 * sigma * np.sqrt(np.maximum(values, 0.0))
    return float(major), float(minor), float(np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])))


def magnification(shown: Picture, span_km: float) -> int:
    """How much larger the ellipses of a picture are drawn, so that the middle one is seen in ``span_km``."""
    if not len(shown.track_id):
        return 1
    largest = np.linalg.eigvalsh(shown.covariance_m2)[:, 1]
    typical_km = float(np.median(2.0 * ELLIPSE_SIGMA * np.sqrt(np.maximum(largest, 0.0)))) / 1e3
    return next((m for m in MAGNIFICATIONS if typical_km * m >= ELLIPSE_PART * span_km), MAGNIFICATIONS[-1])


def short_names(track_ids: Iterable[int]) -> dict[int, str]:
    """The end of each track's number: the digits in which the tracks of a picture differ, two at least."""
    numbers = {track_id: track_id & COUNTER for track_id in track_ids}
    low, high = min(numbers.values(), default=0), max(numbers.values(), default=0)
    differ = next(k for k in range(2, 20) if low // 10**k == high // 10**k)
    digits = min(differ, len(str(high)))
    return {track_id: f"{number % 10**digits:0{digits}}" for track_id, number in numbers.items()}


def _by_id(
    ids: list[IntArray], t_s: list[FloatArray], km: list[FloatArray], coasting: list[npt.NDArray[np.bool_]]
) -> dict[int, Path2D]:
    if not any(map(len, ids)):
        return {}
    every, time, place, coasts = np.concatenate(ids), np.concatenate(t_s), np.concatenate(km), np.concatenate(coasting)
    order = np.argsort(every, kind="stable")
    names, first = np.unique(every[order], return_index=True)
    parts = np.split(order, first[1:])
    return {int(n): Path2D(time[p], place[p], coasts[p]) for n, p in zip(names, parts, strict=True)}


def _draw_scene(axes: Axes, scene: PlotScene) -> None:
    if scene.plots_km:
        dots = np.concatenate(scene.plots_km)
        alpha = float(np.clip(4000.0 / len(dots), 0.12, 0.6))
        axes.scatter(dots[:, 0], dots[:, 1], s=3.0, c=PLOT, alpha=alpha, linewidths=0, zorder=1, rasterized=True)
    for name, site in scene.sites_km.items():
        axes.plot(*site, marker="^", ms=11, mfc=INK, mec=PAPER, mew=1.2, ls="none", zorder=8)
        axes.annotate(
            name,
            (float(site[0]), float(site[1])),
            xytext=(0, -17),
            textcoords="offset points",
            ha="center",
            fontsize=9,
            fontweight="bold",
            color=INK,
            zorder=8,
            path_effects=_halo(),
        )


def _draw_truth(axes: Axes, targets: dict[int, Path2D], width: float) -> None:
    from matplotlib.collections import LineCollection

    lines = [path.km for path in targets.values() if len(path.km) > 1]
    axes.add_collection(LineCollection(lines, colors=TRUTH, linewidths=width, capstyle="round", zorder=2))


def _draw_lines(axes: Axes, tracks: dict[int, Path2D], width: float) -> None:
    from matplotlib.collections import LineCollection

    for coasting, style in ((False, "solid"), (True, (0.0, (1.0, 1.6)))):
        found = [(line, _color(n)) for n, path in tracks.items() for line in _stretches(path, coasting)]
        lines, colors = [line for line, _ in found], [color for _, color in found]
        axes.add_collection(LineCollection(lines, colors=colors, linewidths=width, linestyles=[style], zorder=4))


def _stretches(path: Path2D, coasting: bool) -> Iterator[FloatArray]:
    """The unbroken lines on which a track is coasting, or is not; a line ends with the step that changes it."""
    if len(path.km) < 2:
        return
    whole = np.diff(path.t_s) <= GAP_S
    wanted = (path.coasting[1:] == coasting) & whole
    edges = np.flatnonzero(np.diff(wanted.astype(np.int8), prepend=0, append=0))
    for begin, end in edges.reshape(-1, 2):
        yield path.km[begin : end + 1]


def _draw_last(axes: Axes, shown: Picture, magnified: int, names: dict[int, str]) -> None:
    from matplotlib.patches import Ellipse

    size = 5.0 if names else 2.2
    for row, track_id in enumerate(shown.track_id.tolist()):
        color, (east, north) = _color(track_id), (shown.position_m[row] / 1e3).tolist()
        fill = PAPER if shown.coasting[row] else color
        axes.plot(east, north, "o", ms=size, mfc=fill, mec=color, mew=1.2, zorder=6)
        if magnified:
            width, height, angle = ellipse(shown.covariance_m2[row] / 1e6, magnified * ELLIPSE_SIGMA)
            shape = Ellipse((east, north), width, height, angle=angle, fc=(color, ELLIPSE_FILL), ec=color, lw=0.9)
            shape.set_zorder(5)
            axes.add_patch(shape)
        if track_id in names:
            _label(axes, names[track_id], east, north, color)


def _label(axes: Axes, text: str, east: float, north: float, color: str) -> None:
    axes.annotate(
        text,
        (east, north),
        xytext=(5, 4),
        textcoords="offset points",
        fontsize=7.5,
        color=color,
        zorder=7,
        path_effects=_halo(),
    )


def _frame(axes: Axes, paths: list[Path2D], scene: PlotScene) -> float:
    """Equal axes in km about the paths, clutter far from them left out; returns their longer side."""
    places = [path.km for path in paths] or scene.plots_km
    everything = np.concatenate([*places, *(site[None] for site in scene.sites_km.values())])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = 0.04 * max(float((high - low).max()), 0.1)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    _name_axes(axes, in_metres=float((high - low).max()) < NEAR_KM)
    axes.grid(color=GRID, lw=0.8, zorder=0)
    axes.set_axisbelow(True)
    axes.tick_params(colors=MUTED, labelsize=9)
    for spine in axes.spines.values():
        spine.set_color(GRID)
    return float((high - low).max()) + 2.0 * margin


def _name_axes(axes: Axes, *, in_metres: bool) -> None:
    unit = "m" if in_metres else "km"
    for axis, name in ((axes.xaxis, "east"), (axes.yaxis, "north")):
        axis.set_label_text(f"{name} ({unit})", color=INK)
        if in_metres:
            axis.set_major_formatter(lambda km, _: f"{km * 1e3:g}".replace("-", "\u2212"))


def _title(axes: Axes, title: str, subtitle: str) -> None:
    axes.set_title(title, loc="left", fontsize=14, fontweight="bold", color=INK, pad=24 if subtitle else 8)
    if subtitle:
        axes.text(0.0, 1.012, subtitle, transform=axes.transAxes, fontsize=9.5, color=MUTED)


def _counts(n_tracks: int | None, n_targets: int | None, scene: PlotScene) -> str:
    n_plots = sum(map(len, scene.plots_km)) or None
    counted = ((n_tracks, "track"), (n_targets, "target"), (n_plots, "plot"))
    return ", ".join(_count(n, noun) for n, noun in counted if n is not None)


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'' if n == 1 else 's'}".replace(",", "\u2009")


def _span(frames: list[TrackFrame]) -> str:
    if not frames:
        return ""
    begin, end = (datetime.fromtimestamp(f.t_ns // 10**9, UTC) for f in (frames[0], frames[-1]))
    shown = len(picture(frames[-1]).track_id)
    return f"{begin:%Y-%m-%d %H:%M:%S} to {end:%H:%M:%S} UTC, unit {frames[-1].unit_id}, {shown} shown at the end"


def _legend(
    figure: Figure, tracks: dict[int, Path2D], targets: dict[int, Path2D], scene: PlotScene, magnified: int
) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    color, entries = TRACKS[0], list[Line2D | Patch]()
    if tracks:
        entries += [
            Line2D([], [], color=color, lw=1.6, marker="o", ms=5, label="confirmed track"),
            Line2D([], [], color=color, lw=1.6, ls=":", marker="o", ms=5, mfc=PAPER, label="coasting"),
        ]
    if magnified:
        times = f" (magnified {magnified}x)" if magnified > 1 else ""
        entries.append(Patch(fc=(color, ELLIPSE_FILL), ec=color, label="2-sigma ellipse" + times))
    if targets:
        entries.append(Line2D([], [], color=TRUTH, lw=3.2, label="truth"))
    if scene.plots_km:
        entries.append(Line2D([], [], color=PLOT, marker="o", ms=3, ls="none", label="plot"))
    if scene.sites_km:
        entries.append(Line2D([], [], color=INK, marker="^", ms=9, ls="none", label="sensor"))
    figure.legend(
        handles=entries, loc="outside lower center", ncols=len(entries), frameon=False, fontsize=9.5, labelcolor=INK
    )


def _color(track_id: int) -> str:
    return TRACKS[(track_id & COUNTER) % len(TRACKS)]


def _halo() -> list[Any]:
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=2.2, foreground=PAPER)]


def _figure() -> Figure:
    # A Figure without pyplot draws with Agg, needs no display and keeps no global state.
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise TrackmeshError("Drawing needs matplotlib; install it with: pip install 'trackmesh[studies]'.") from None
    return Figure(figsize=(11.0, 10.0), layout="constrained", facecolor=PAPER)


def _save(figure: Figure, out: Path) -> None:
    try:
        figure.savefig(out, dpi=160, bbox_inches="tight", pad_inches=0.25)
    except OSError as error:
        raise TrackmeshError(f"Cannot write {out}: {error.strerror or error}.") from None
    except ValueError as error:
        raise TrackmeshError(f"Cannot draw into {out}: {error}.") from None
