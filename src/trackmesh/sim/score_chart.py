"""Scores over time and who followed whom, as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.sim.drawing import GRID, INK, MUTED, PAPER, TRACKS, TRUTH, short_names
from trackmesh.sim.metrics import Cover, Segments, segments
from trackmesh.sim.scoring import FrameScore, Scorer, pairs_of, presence
from trackmesh.sim.studies.charts import dress, log_ticks, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_ROWS = 60
"""More targets than this are not told apart; those with the most changes and gaps are shown."""

MOST_POINTS = 400
"""Curves are averaged over time to about as many points: the eye sees no more."""

NAMED_PART = 0.04
"""A stretch that is shorter than this part of the time has no room for its track's number."""

PARTS = (
    ("localisation", "#9cc3e0"),
    ("missed targets", "#d1495b"),
    ("false tracks", "#e08a1e"),
    ("changes of assignment", "#7353ba"),
)

NEES_TICKS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 100.0)


class Row(NamedTuple):
    """One target of the timeline: when it was there and who followed it, first to last, in seconds."""

    target_id: int
    there: FloatArray
    followed: FloatArray
    track_id: IntArray

    @property
    def changes(self) -> int:
        """How often it was followed by another track than before."""
        return int((np.diff(self.track_id) != 0).sum())

    @property
    def unfollowed_s(self) -> float:
        """How long it was there and not followed."""
        return float((self.there[:, 1] - self.there[:, 0]).sum() - (self.followed[:, 1] - self.followed[:, 0]).sum())


def draw_scores(scorer: Scorer, out: Path, title: str | None = None) -> None:
    """Draw GOSPA with its parts, the numbers of tracks and targets, NEES and the timeline of every target.

    Raises:
        TrackmeshError: there is no score, matplotlib is not installed, or the file cannot be written.
    """
    if not scorer.scores:
        raise TrackmeshError("There is nothing to draw: no frame lies within the time of the truth.")
    t_s = np.array([(score.t_ns - scorer.scores[0].t_ns) * 1e-9 for score in scorer.scores])
    rows = timeline(scorer, t_s)
    shown = worst(rows, MOST_ROWS)
    tall = max(1.2, 0.135 * len(shown) + 0.3)
    figure = new_figure((11.0, 6.6 + tall))
    top, middle, bottom, lines = figure.subplots(4, 1, sharex=True, height_ratios=[2.4, 1.3, 1.6, tall])
    _draw_gospa(top, t_s, scorer)
    _draw_numbers(middle, t_s, scorer.scores)
    _draw_nees(bottom, t_s, scorer.scores)
    _draw_timeline(lines, shown, len(rows))
    for axes in (top, middle, bottom, lines):
        _mark_warmup(axes, t_s, scorer.scores)
    lines.set_xlabel("seconds", color=INK)
    lines.set_xlim(0.0, _until(t_s))
    _title(figure, scorer, title)
    save(figure, out)


def timeline(scorer: Scorer, t_s: FloatArray) -> list[Row]:
    """The timeline of every target, by its id; a stretch lasts until the next frame."""
    pairs, ends_s = pairs_of(scorer.compared), np.append(t_s[1:], _until(t_s))
    there = _by_target(segments(presence(scorer.compared)), t_s, ends_s)
    followed = _by_target(segments(Cover(pairs.frame, pairs.target_id, pairs.track_id)), t_s, ends_s)
    nobody = (np.zeros((0, 2)), np.zeros(0, np.int64))
    return [Row(target, spans, *followed.get(target, nobody)) for target, (spans, _) in there.items()]


def worst(rows: Sequence[Row], most: int) -> list[Row]:
    """The rows with the most changes, then gaps, in order of their ids."""
    chosen = sorted(rows, key=lambda row: (-row.changes, -row.unfollowed_s))[:most]
    return sorted(chosen, key=lambda row: row.target_id)


def steps(t_s: FloatArray, *columns: FloatArray) -> tuple[FloatArray, ...]:
    """The columns as steps, each from its time to the next, the last until the end of its frame.

    Means are taken over equal numbers of frames, so that at most ``MOST_POINTS`` are left; what is NaN is left out.
    """
    starts = np.arange(0, len(t_s), -(-len(t_s) // MOST_POINTS))

    def mean(values: FloatArray) -> FloatArray:
        known = np.isfinite(values)
        total = np.add.reduceat(np.where(known, values, 0.0), starts)
        count = np.add.reduceat(known.astype(float), starts)
        means = np.divide(total, count, out=np.full(len(starts), np.nan), where=count > 0)
        return np.append(means, means[-1])

    return np.append(t_s[starts], _until(t_s)), *(mean(np.asarray(column, np.float64)) for column in columns)


def _by_target(found: Segments, t_s: FloatArray, ends_s: FloatArray) -> dict[int, tuple[FloatArray, IntArray]]:
    spans = np.stack([t_s[found.first], ends_s[found.last]], axis=1)
    order = np.lexsort((spans[:, 0], found.target_id))
    targets, first = np.unique(found.target_id[order], return_index=True)
    parts = zip(np.split(spans[order], first[1:]), np.split(found.track_id[order], first[1:]), strict=True)
    return dict(zip(targets.tolist(), parts, strict=False))


def _draw_gospa(axes: Axes, t_s: FloatArray, scorer: Scorer) -> None:
    """The parts add up in squares; each takes its share of the height."""
    scores, half = scorer.scores, 0.5 * scorer.rules.c_m**2
    total = np.array([score.gospa_switching_m for score in scores])
    squares = np.array([
        [s.localisation_m2, half * s.missed, half * s.false, s.switching * scorer.rules.switch_m**2] for s in scores
    ])  # fmt: skip
    shares = squares / np.maximum(total, 1e-9)[:, None]
    t, *heights = steps(t_s, *shares.T)
    axes.stackplot(t, *heights, colors=[color for _, color in PARTS], step="post", linewidth=0, zorder=2)
    axes.plot(t, np.sum(heights, axis=0), color=INK, lw=1.0, drawstyle="steps-post", zorder=3)
    axes.set_ylim(0.0, 1.08 * max(float(_of_interest(t, np.sum(heights, axis=0), t_s, scores).max()), 1e-3))
    _dress(axes, "GOSPA (m), with the shares of its square")
    _legend(axes, [(name, color, 6.0) for name, color in PARTS])


def _draw_numbers(axes: Axes, t_s: FloatArray, scores: Sequence[FrameScore]) -> None:
    from matplotlib.ticker import MaxNLocator

    t, targets, tracks = steps(t_s, *(np.array([getattr(s, n) for s in scores], float) for n in ("targets", "tracks")))
    axes.plot(t, targets, color=TRUTH, lw=3.2, drawstyle="steps-post", zorder=2)
    axes.plot(t, tracks, color=TRACKS[0], lw=1.3, drawstyle="steps-post", zorder=3)
    both = np.concatenate([_of_interest(t, line, t_s, scores) for line in (targets, tracks)])
    margin = 0.1 * float(np.ptp(both)) + 1.5
    axes.set_ylim(max(float(both.min()) - margin, -0.5), float(both.max()) + margin)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    _dress(axes, "How many")
    _legend(axes, [("targets", TRUTH, 3.2), ("tracks", TRACKS[0], 1.3)])


def _draw_nees(axes: Axes, t_s: FloatArray, scores: Sequence[FrameScore]) -> None:
    names = ("nees", "nees_low", "nees_high")
    t, nees, low, high = steps(t_s, *(np.array([getattr(s, n) for s in scores], float) for n in names))
    axes.fill_between(t, low, high, color=GRID, step="post", linewidth=0, zorder=1)
    axes.axhline(2.0, color=MUTED, lw=0.9, ls="--", zorder=2)
    axes.plot(t, nees, color=TRACKS[0], lw=1.3, drawstyle="steps-post", zorder=3)
    axes.set_yscale("log")
    log_ticks(axes.yaxis, NEES_TICKS)
    known = np.concatenate([_of_interest(t, line, t_s, scores) for line in (nees, low, high)])
    known = known[np.isfinite(known) & (known > 0.0)]
    if len(known):
        axes.set_ylim(max(0.05, 0.8 * float(known.min())), min(1e3, 1.25 * float(known.max())))
    _dress(axes, "NEES of positions: 2 if the covariance is right")
    _legend(axes, [("mean of a frame", TRACKS[0], 1.3), ("95 % of consistent frames", GRID, 6.0)])


def _draw_timeline(axes: Axes, rows: Sequence[Row], targets: int) -> None:
    from matplotlib.collections import LineCollection

    numbers = [int(track) for row in rows for track in row.track_id]
    names, named_s = short_names(numbers), NAMED_PART * max((row.there.max() for row in rows), default=0.0)
    there, followed, colors = [], [], []
    for y, row in enumerate(rows):
        there += [[(a, y), (b, y)] for a, b in row.there.tolist()]
        followed += [[(a, y), (b, y)] for a, b in row.followed.tolist()]
        order = list(dict.fromkeys(row.track_id.tolist()))
        colors += [TRACKS[order.index(track) % len(TRACKS)] for track in row.track_id.tolist()]
        _name_changes(axes, y, row, names, named_s)
    axes.add_collection(LineCollection(there, colors=TRUTH, linewidths=6.5, capstyle="butt", zorder=2))
    axes.add_collection(LineCollection(followed, colors=colors, linewidths=6.5, capstyle="butt", zorder=3))
    axes.set_ylim(len(rows) - 0.3, -0.7)
    axes.set_yticks(range(len(rows)), [str(row.target_id) for row in rows])
    some = "" if len(rows) == targets else f", the {len(rows)} of {targets} with the most changes and gaps"
    _dress(axes, f"Who followed each target{some}")
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(visible=False, axis="y")
    _legend(axes, [("first track", TRACKS[0], 6.0), ("another", TRACKS[1], 6.0), ("none", TRUTH, 6.0)])


def _of_interest(t: FloatArray, line: FloatArray, t_s: FloatArray, scores: Sequence[FrameScore]) -> FloatArray:
    """The part of a curve that the axis must hold: what is scored, or all where nothing is."""
    scored = np.flatnonzero([score.scored for score in scores])
    part = line[t >= t_s[scored[0]]] if len(scored) else line
    return part if len(part) else line


def _name_changes(axes: Axes, y: int, row: Row, names: dict[int, str], named_s: float) -> None:
    """The number of each track where it takes over from another."""
    for k in np.flatnonzero(np.diff(row.track_id)) + 1:
        begin, end = row.followed[k].tolist()
        axes.plot([begin, begin], [y - 0.45, y + 0.45], color=INK, lw=1.0, zorder=4)
        if end - begin >= named_s:
            name, place = names[int(row.track_id[k])], (begin, y)
            text = axes.annotate(name, place, xytext=(2, -0.4), textcoords="offset points", va="center")
            text.set(fontsize=6, color=PAPER, zorder=5)


def _mark_warmup(axes: Axes, t_s: FloatArray, scores: Sequence[FrameScore]) -> None:
    early = np.flatnonzero([not score.scored for score in scores])
    if len(early):
        axes.axvspan(t_s[0], t_s[min(early[-1] + 1, len(t_s) - 1)], color=MUTED, alpha=0.13, lw=0, zorder=6)


def _title(figure: Figure, scorer: Scorer, title: str | None) -> None:
    summary, tall_in = scorer.summary(), float(figure.get_figheight())
    warm = "; grey: warm-up, not scored" if not all(score.scored for score in scorer.scores) else ""
    text = (
        f"mean GOSPA {summary.gospa_m:.0f} m, with changes {summary.gospa_switching_m:.0f} m; "
        f"RMSE {summary.rmse_m:.1f} m; {summary.id_switches} identity switches; NEES {summary.nees:.2f}{warm}"
    )
    # Above the figure's own area, which the axes fill; the file is cut out with it.
    head = figure.text(0.012, 1.0 + 0.38 / tall_in, title or "Tracks against the truth")
    head.set(fontsize=14, fontweight="bold", color=INK)
    figure.text(0.012, 1.0 + 0.12 / tall_in, text, fontsize=9.5, color=MUTED)


def _dress(axes: Axes, name: str) -> None:
    dress(axes)
    axes.set_title(name, loc="left", fontsize=10.5, color=INK)


def _legend(axes: Axes, entries: Sequence[tuple[str, str, float]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, lw=width, label=name) for name, color, width in entries]
    axes.legend(
        handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(handles), frameon=False, fontsize=8.5,
        labelcolor=INK, borderaxespad=0.2, handlelength=1.4,
    )  # fmt: skip


def _until(t_s: FloatArray) -> float:
    """The end of the last frame: it lasts as long as the median one."""
    return float(t_s[-1] + (np.median(np.diff(t_s)) if len(t_s) > 1 else 1.0))
