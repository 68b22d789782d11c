"""The command ``score``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.services.cli.files import Tracks, counted, lines_of, records_of
from trackmesh.services.cli.options import AsJson, out, say, told
from trackmesh.services.cli.progress import progress_bar

GROUPS: dict[str, dict[str, str]] = {
    "what was scored": {
        "frames": "frames after the warm-up",
        "without_truth": "frames outside the time of the truth, left out",
        "tracks": "different tracks shown",
        "c_m": "cut-off of GOSPA and OSPA",
        "switch_m": "cost of a change of assignment",
        "gate_m": "farther from every target a track is spurious (SIAP)",
    },
    "sets of tracks": {
        "gospa_m": "mean GOSPA: errors, missed targets and false tracks in one figure",
        "localisation_m2": "its part of errors: mean sum of squares",
        "missed": "targets without a track, a frame",
        "false": "tracks without a target, a frame",
        "gospa_switching_m": "mean GOSPA with changes of assignment",
        "switching": "changes of assignment, a frame",
        "ospa_m": "mean OSPA: the same by the target",
    },
    "errors": {
        "rmse_m": "of the matched positions",
        "rmse_velocity_mps": "of their velocities",
        "nees": "squared error by covariance: 2 if the covariance is right",
        "nees_low": "95 % of consistent frames lie above",
        "nees_high": "95 % of consistent frames lie below",
        "nees_in_band": "share of frames within their band: .95 if consistent",
        "within_95": "share of errors within the 95 % ellipse",
        "nees_state": "with the velocity: 4 if the covariance is right",
    },
    "identity": {
        "coverage": "share of targets with a track",
        "mostly_tracked": "share of targets with a track four fifths of their time",
        "id_switches": "targets followed by another track than before",
        "purity": "share of matches in which a track follows its main target",
        "continuity": "share of matches in which a target has its main track",
    },
    "single integrated air picture": {
        "siap_completeness": "share of targets tracked; best 1",
        "siap_ambiguity": "tracks for a tracked target; best 1",
        "siap_spuriousness": "share of tracks with no target; best 0",
        "siap_position_m": "mean error of tracks with a target",
        "siap_velocity_mps": "mean error of their velocities",
        "siap_number_changes": "changes of a target's track number",
        "siap_changes_per_h": "the same for each hour of a tracked target",
        "siap_longest_segment": "longest stretch of one track by the target's life; best 1",
    },
}


@told
def score(
    tracks: Tracks,
    truth: Annotated[Path, typer.Argument(metavar="TRUTH.jsonl", help="Where the targets really were.")],
    as_json: AsJson = False,
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Write the scores of every frame here.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE", help="Draw the scores over time: .png, .svg or .pdf.")
    ] = None,
    c_m: Annotated[
        float, typer.Option("--c", min=1e-3, metavar="M", help="Cut-off distance of GOSPA and OSPA, metres.")
    ] = 1000.0,
    switch_m: Annotated[
        float | None,
        typer.Option("--switch", min=0.0, metavar="M", help="Cost of a change of assignment; default: half of --c."),
    ] = None,
    gate_m: Annotated[
        float | None,
        typer.Option("--gate", min=1e-3, metavar="M", help="A track is of a target within this; default: --c."),
    ] = None,
    warmup_s: Annotated[
        float, typer.Option("--warmup", min=0.0, metavar="S", help="Seconds not scored at the start.")
    ] = 40.0,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Score the nearest track of each target: for truth of some targets only.")
    ] = False,
) -> None:
    """Score tracks against the truth. By GOSPA, OSPA, SIAP, RMSE, NEES and identity; over time on request."""
    if nearest and (csv or plot):
        raise typer.BadParameter("--nearest has no scores over time: leave out --csv and --plot.")
    if nearest:
        figures = _nearest(tracks, truth, c_m)
    else:
        figures = _over_time(tracks, truth, c_m, switch_m, gate_m, warmup_s, csv, plot)
    if as_json:
        # JSON knows no NaN.
        print(json.dumps({name: value if math.isfinite(value) else None for name, value in figures.items()}))
    else:
        out.print(figure_table(figures, f"{tracks} against {truth}"))


def figure_table(figures: Mapping[str, float], title: str) -> Table:
    """The figures by groups, each with what it says."""
    table = Table("figure", title=title, title_justify="left")
    table.add_column("value", justify="right")
    table.add_column("what it says")
    for group, texts in GROUPS.items():
        names = [name for name in texts if name in figures]
        if names:
            table.add_section()
            table.add_row(f"[bold]{group}[/bold]", "", "")
        for name in names:
            table.add_row(name, _value(figures[name]), texts[name])
    return table


def _value(value: float) -> str:
    if isinstance(value, int):
        return f"{value}"
    return f"{value:.4g}" if math.isfinite(value) else "-"


def _nearest(tracks: Path, truth: Path, c_m: float) -> dict[str, float | int]:
    from trackmesh.sim.scoring import score_nearest

    with progress_bar("scoring", lines_of(tracks)) as advance:
        frames = counted(records_of(tracks, TrackFrame), advance)
        figures = score_nearest(frames, records_of(truth, TruthFrame), c_m).as_dict()
    return _something(figures, tracks)


def _over_time(
    tracks: Path,
    truth: Path,
    c_m: float,
    switch_m: float | None,
    gate_m: float | None,
    warmup_s: float,
    csv: Path | None,
    plot: Path | None,
) -> dict[str, float | int]:
    from trackmesh.sim.scoring import Scorer, TruthTimeline, write_series

    with progress_bar("reading the truth", lines_of(truth)) as advance:
        timeline = TruthTimeline(counted(records_of(truth, TruthFrame), advance))
    scorer = Scorer(timeline, c_m, warmup_s, switch_m, gate_m)
    with progress_bar("scoring", lines_of(tracks)) as advance:
        for frame in counted(records_of(tracks, TrackFrame), advance):
            scorer.add(frame)
    figures, written = _something(scorer.summary().as_dict(), tracks), list[str]()
    if csv is not None:
        write_series(scorer.scores, csv)
        written.append(f"scores of {len(scorer.scores)} frames in {csv}")
    if plot is not None:
        from trackmesh.sim.score_chart import draw_scores

        draw_scores(scorer, plot, f"{tracks.name} against {truth.name}")
        written.append(f"picture in {plot}")
    if written:
        say(", ".join(written))
    return figures


def _something(figures: dict[str, float | int], tracks: Path) -> dict[str, float | int]:
    if not figures["frames"]:
        raise TrackmeshError(f"No frame of {tracks} is to be scored: all lie outside the truth or within the warm-up.")
    return figures
