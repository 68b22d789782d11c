"""Commands about induction scans: invert them, read them from survey logs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import ValidationError

from trackmesh.protocol.codec import refusal
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RecordWriter, read_records, to_line
from trackmesh.protocol.inversion import Inversion
from trackmesh.protocol.messages import EmiOptions, EmiReceiver, EmiResult, EmiScanBatch, EmiTransmitter
from trackmesh.services.cli.options import AsJson, Config, Connect, Realm, Unit, client, out, say, told
from trackmesh.services.cli.progress import progress_bar
from trackmesh.services.cli.tables import result_table
from trackmesh.services.process import on_signal

Invert = Callable[[EmiScanBatch], Iterable[EmiResult]]
LOOK_S = 0.2
WORTH_PROCESSES = 1_000_000
"""Numbers above which worker processes are started for --local."""


@told
def invert(
    scans: Annotated[Path, typer.Argument(metavar="SCANS.jsonl", help="Batches of scans.")],
    as_json: AsJson = False,
    local: Annotated[bool, typer.Option("--local", help="Compute here, ask no service.")] = False,
    processes: Annotated[
        int | None,
        typer.Option(
            "--processes", min=0, metavar="N", help="With --local: that compute; default: all cores if it is worth it."
        ),
    ] = None,
    out_path: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the results as JSON lines.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="FOLDER", help="Draw each scan with what was found in it.")
    ] = None,
    unit: Unit = "*",
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=0.1, metavar="S", help="How long a batch may take, seconds.")
    ] = 600.0,
    config: Config = None,
    connect: Connect = None,
    realm: Realm = None,
) -> None:
    """Ask the EMI services where the buried targets are.

    All services that are alive share the work, unless --unit names one.
    """
    batches = [record for record in read_records(scans, EmiScanBatch) if isinstance(record, EmiScanBatch)]
    stop = threading.Event()
    with on_signal(lambda _: stop.set()):
        if local:
            with _here(batches, processes) as work:
                results = _all_results(batches, work, stop)
        else:
            with client(connect, realm, config) as ask:
                results = _all_results(batches, lambda batch: ask.invert(batch, unit, timeout_s=timeout_s), stop)
    _write(results, out_path, as_json)
    if plot:
        _draw(batches, results, plot)
    if stop.is_set():
        raise TrackmeshError(f"Stopped: {len(results)} of {sum(len(b.field) for b in batches)} scans are done.")


def _all_results(batches: list[EmiScanBatch], work: Invert, stop: threading.Event) -> list[EmiResult]:
    results: list[EmiResult] = []
    for batch in batches:
        results += sorted(_results(batch, work, stop), key=lambda result: result.index)
    return results


def _results(batch: EmiScanBatch, work: Invert, stop: threading.Event) -> Iterator[EmiResult]:
    with progress_bar(batch.batch_id, len(batch.field)) as advance:
        for done, result in enumerate(_until(stop, work(batch)), 1):
            yield result
            advance(done)


def _until(stop: threading.Event, found: Iterable[EmiResult]) -> Iterator[EmiResult]:
    """What is found until told to stop; who is asked over the network may also not answer at all."""
    if not isinstance(found, Inversion):
        yield from takewhile(lambda _: not stop.is_set(), found)
        return
    with found:
        while not stop.is_set() and found.done < found.total:
            if (result := found.receive(LOOK_S)) is not None:
                yield result


@contextmanager
def _here(batches: list[EmiScanBatch], processes: int | None) -> Iterator[Invert]:
    from trackmesh.services.emi.service.local import invert_locally
    from trackmesh.services.emi.service.main import cores
    from trackmesh.services.emi.service.pool import OwnWork, Solver, WorkerPool

    if processes is None:
        processes = cores() if sum(batch.field.size for batch in batches) > WORTH_PROCESSES else 0
    solver: Solver = WorkerPool(processes) if processes else OwnWork()
    try:
        yield lambda batch: invert_locally(solver, batch)
    finally:
        solver.close()


def _write(results: list[EmiResult], out_path: Path | None, as_json: bool) -> None:
    if out_path:
        with RecordWriter(out_path) as file:
            for result in results:
                file.write(result)
    if as_json:
        for result in results:
            print(to_line(result))
    else:
        out.print(result_table(results))


def _draw(batches: list[EmiScanBatch], results: list[EmiResult], folder: Path) -> None:
    from trackmesh.sim.emi_drawing import draw_scans

    pictures = draw_scans(batches, results, folder)
    say(f"{len(pictures)} pictures in {folder}")


@told
def convert_emi_csv(
    log: Annotated[Path, typer.Argument(metavar="LOG.csv", help="One row a sample, the first one names the columns.")],
    out_path: Annotated[Path, typer.Option("--out", metavar="SCANS.jsonl", help="File to write.")],
    x: Annotated[str, typer.Option("--x", metavar="COLUMN", help="Metres; may be an easting.")],
    y: Annotated[str, typer.Option("--y", metavar="COLUMN", help="Metres; may be a northing.")],
    field: Annotated[
        list[str],
        typer.Option(
            "--field", metavar="COLUMNS", help="Components of a channel, by commas; once a channel (frequency, gate)."
        ),
    ],
    radius_m: Annotated[float, typer.Option("--radius", min=0.0, metavar="M", help="Of the transmitter coil.")],
    z: Annotated[str | None, typer.Option("--z", metavar="COLUMN", help="Height of the sensor; default: 0.")] = None,
    scan: Annotated[
        str | None, typer.Option("--scan", metavar="COLUMN", help="Rows alike in it are one scan; default: all are.")
    ] = None,
    heading: Annotated[
        str | None,
        typer.Option("--heading", metavar="COLUMN", help="Degrees clockwise from y, of the sensor's y axis."),
    ] = None,
    pitch: Annotated[str | None, typer.Option("--pitch", metavar="COLUMN", help="Degrees, nose up.")] = None,
    roll: Annotated[str | None, typer.Option("--roll", metavar="COLUMN", help="Degrees, right side down.")] = None,
    receiver: Annotated[
        list[str] | None,
        typer.Option(
            "--receiver",
            metavar="X,Y,Z[,z]",
            help="Offset of a receiver, and z if it has that component only; repeatable.",
        ),
    ] = None,
    turns: Annotated[float, typer.Option("--turns", metavar="N", help="Of the transmitter coil.")] = 1.0,
    current_a: Annotated[float, typer.Option("--current", metavar="A", help="In the transmitter coil.")] = 1.0,
    dipole: Annotated[bool, typer.Option("--dipole", help="Take the transmitter as a point dipole.")] = False,
    offset: Annotated[
        str, typer.Option("--offset", metavar="X,Y,Z", help="Of the transmitter from the place in the log.")
    ] = "0,0,0",
    unit: Annotated[Literal["T", "nT", "pT", "arbitrary"], typer.Option("--unit", help="Of the field.")] = "nT",
    sigma: Annotated[
        float | None, typer.Option("--sigma", metavar="NOISE", help="Standard deviation; default: estimated.")
    ] = None,
    background: Annotated[
        Literal["none", "const", "plane"], typer.Option("--background", help="What lies beneath the targets.")
    ] = "const",
    max_targets: Annotated[int, typer.Option("--targets", min=1, max=3, help="Sought in each scan.")] = 1,
    delimiter: Annotated[str, typer.Option("--delimiter", metavar="CHAR", help="Between columns.")] = ",",
) -> None:
    """Survey log of an induction sensor. Its rows become scans for invert.

    Example: --x easting --y northing --field bx,by,bz --radius 0.5 --current 20
    """
    from trackmesh.sim.emi_csv import Columns, Setup, read_log

    try:
        setup = Setup(
            EmiTransmitter(
                model="dipole" if dipole else "loop", radius_m=radius_m, turns=turns, current_a=current_a,
                offset_m=_numbers(offset, "--offset"),
            ),
            [_receiver(text) for text in receiver or ["0,0,0"]],
            unit,
            sigma,
            EmiOptions(background=background, max_targets=max_targets),
        )  # fmt: skip
    except ValidationError as error:
        raise refusal("The setup", error) from None
    fields = tuple(tuple(name.strip() for name in text.split(",")) for text in field)
    found = read_log(log, Columns(x, y, z, fields, scan, heading, pitch, roll), setup, delimiter=delimiter)
    with RecordWriter(out_path) as file:
        for batch in found.batches:
            file.write(batch)
    samples = sum(batch.field.shape[2] for batch in found.batches)
    words = [f"{len(found.batches)} scans, {samples} samples in {out_path}"]
    if found.without_place:
        words.append(f"{found.without_place} rows without a place left out")
    if found.origin_m.any():
        words.append(f"places are from x = {found.origin_m[0]:.0f} m, y = {found.origin_m[1]:.0f} m")
    say("; ".join(words))


def _receiver(text: str) -> EmiReceiver:
    place, is_z = (text[:-2], True) if text.endswith(",z") else (text, False)
    return EmiReceiver(offset_m=_numbers(place, "--receiver"), components="z" if is_z else "xyz")


def _numbers(text: str, option: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise typer.BadParameter(f"{text!r} must be 3 numbers separated by commas.", param_hint=option)
    return numbers
