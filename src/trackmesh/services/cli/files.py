"""Commands that need no network: track, plot, convert, schema."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter, read_records
from trackmesh.protocol.messages import MESSAGES, Message, TrackFrame, TruthFrame
from trackmesh.services.cli.options import Config, Inputs, err, say, told
from trackmesh.services.cli.progress import progress_bar

M = TypeVar("M", bound=Message)

Tracks = Annotated[Path, typer.Argument(metavar="TRACKS.jsonl", help="As written by track, or watch --out.")]

convert = typer.Typer(help="Turn recordings of other formats into ours.", no_args_is_help=True)


def records_of(path: Path, kind: type[M]) -> Iterator[M]:
    """The records of a file that must all be of one kind."""
    for record in read_records(path, kind):
        assert isinstance(record, kind)
        yield record


@told
def track(
    plots: Annotated[Path, typer.Argument(metavar="PLOTS.jsonl", help="A recording, or a black box.")],
    out_path: Annotated[Path, typer.Option("--out", metavar="TRACKS.jsonl", help="File to write.")],
    config: Config = None,
    inputs: Inputs = None,
    refined: Annotated[
        Path | None,
        typer.Option(
            "--refined", metavar="REFINED.jsonl", help="Write here the refined states, where engine.lag is set."
        ),
    ] = None,
) -> None:
    """Track a recording, without a network. The same engine as live, and the same frames."""
    from trackmesh.services.fusion.offline import OfflineRun
    from trackmesh.services.fusion.settings import FusionSettings

    settings = FusionSettings.load(config, {"inputs": inputs})
    run = OfflineRun(settings.engine, settings.unit_id, settings.unit_number, settings.origin, settings.inputs)
    count, started_s = 0, time.process_time()
    with ExitStack() as opened:
        file = opened.enter_context(RecordWriter(out_path))
        if refined is not None:
            run.on_refined = opened.enter_context(RecordWriter(refined)).write
        advance = opened.enter_context(progress_bar("tracking", lines_of(plots)))
        for frame in run.frames(counted(read_records(plots), advance)):
            file.write(frame)
            count += 1
    spent_s = time.process_time() - started_s
    refused = ", ".join(f"{n} refused: {reason}" for reason, n in sorted(run.refused.items()))
    say(f"{count} frames of {run.plots} plots in {out_path}, {spent_s:.1f} s of CPU{'; ' + refused if refused else ''}")


def counted(records: Iterator[M], advance: Callable[[float], None]) -> Iterator[M]:
    """The records, each told to a progress bar when it is done with."""
    for number, record in enumerate(records, 1):
        yield record
        advance(number)


def lines_of(path: Path) -> int | None:
    """How many lines a file has, for a progress bar; None where nobody would see one."""
    if not err.is_terminal:
        return None
    try:
        with path.open("rb") as file:
            return sum(1 for _ in file)
    except OSError:
        return None


@told
def plot(
    tracks: Tracks,
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH.jsonl", help="Where the targets really were.")] = None,
    out_path: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="Picture to write: .png, .svg or .pdf.")
    ] = Path("tracks.png"),
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="PLOTS.jsonl", help="A recording, drawn as dots.")
    ] = None,
    title: Annotated[
        str | None, typer.Option("--title", metavar="TEXT", help="Over the picture; default: what it shows.")
    ] = None,
) -> None:
    """Draw tracks, over the truth."""
    from trackmesh.sim.drawing import draw_tracks

    draw_tracks(
        records_of(tracks, TrackFrame),
        records_of(truth, TruthFrame) if truth else None,
        read_records(plots) if plots else None,
        out=out_path,
        title=title,
    )
    say(f"picture in {out_path}")


@convert.command("autoferry")
@told
def convert_autoferry(
    detections: Annotated[
        Path,
        typer.Argument(
            metavar="DETECTIONS.json", help="scenarioN_detections.json; scenarioN_groundTruth.json beside it."
        ),
    ],
    out_path: Annotated[Path, typer.Option("--out", metavar="PLOTS.jsonl", help="File to write.")],
    truth: Annotated[Path | None, typer.Option("--truth", metavar="TRUTH.jsonl", help="File to write.")] = None,
) -> None:
    """Autoferry sensor fusion dataset. Radar and lidar become two sensors."""
    from trackmesh.sim.autoferry import convert_autoferry as work

    batches, plots = work(detections, out_path, truth)
    say(f"{plots} plots in {batches} batches in {out_path}")


@convert.command("joyride")
@told
def convert_joyride(
    mat: Annotated[Path, typer.Argument(metavar="JOYRIDE.mat", help="joyride.mat.")],
    out_path: Annotated[Path, typer.Option("--out", metavar="PLOTS.jsonl", help="File to write.")],
    truth: Annotated[Path | None, typer.Option("--truth", metavar="TRUTH.jsonl", help="File to write.")] = None,
) -> None:
    """Joyride: a ship's radar and one boat in hard manoeuvres."""
    from trackmesh.sim.joyride import convert_joyride as work

    batches, plots = work(mat, out_path, truth)
    say(f"{plots} plots in {batches} batches in {out_path}")


@told
def schema(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="A message, such as PlotBatch; default: all.")
    ] = None,
) -> None:
    """Print the JSON Schema of the messages."""
    by_name = {kind.__name__: kind for kind in MESSAGES.values()}
    if name is None:
        schemas = {ident: kind.model_json_schema() for ident, kind in MESSAGES.items()}
        print(json.dumps(schemas, indent=2))
        return
    if name not in by_name:
        raise TrackmeshError(f"There is no message {name!r}; there are {', '.join(by_name)}.")
    print(json.dumps(by_name[name].model_json_schema(), indent=2))
