"""The command ``tune``: noise levels and sojourn times, or the words of ``tvimm``, that fit a recording."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import Message, SensorInfo, TrackFrame, TruthFrame
from trackmesh.services.cli.files import records_of
from trackmesh.services.cli.options import Config, Seed, err, out, say, told
from trackmesh.services.cli.toml_text import toml_text

if TYPE_CHECKING:
    from trackmesh.services.fusion.settings import EngineSettings, FusionSettings
    from trackmesh.services.fusion.tuning import Candidate, Evidence, Objective, Recording

HELD_OUT = 0.3
"""Share of the scored time, at its end, that the search does not see."""

_TUNED_ON = f"the first {100 * (1 - HELD_OUT):.0f} % of the time"
_CHECKED_ON = f"the last {100 * HELD_OUT:.0f} %"


class Goal(NamedTuple):
    """What is to be least, and on what.

    Attributes:
        name, unit, sign: how people are told; a score times ``sign`` is what is called by that name.
        objective: see the pure tuning.
        records: the whole recording; those from ``split`` on are held out.
        picture_s: least time between the pictures that are scored.
    """

    name: str
    unit: str
    sign: float
    objective: Objective
    records: list[Message]
    split: int
    picture_s: float

    def tuned_on(self, settings: EngineSettings) -> float:
        """The score on the part that the search sees."""
        return self._evaluate(self.records[: self.split], settings, 0)

    def held_out(self, settings: EngineSettings) -> float:
        """The score on the part that it does not see, tracked from the beginning; NaN if nothing of it is scored."""
        return self._evaluate(self.records, settings, self.split)

    def text(self, score: float, *, unit: bool = True) -> str:
        """A score as people are told it."""
        return f"{self.sign * score:#.5g}{self.unit if unit else ''}"

    def _evaluate(self, records: list[Message], settings: EngineSettings, begin: int) -> float:
        from trackmesh.services.fusion.tuning import evaluate

        return evaluate(records, settings, self.objective, begin=begin, picture_s=self.picture_s)


class Found(NamedTuple):
    """What came of a search: its last candidate, the score of its start, and the scores on the part held out."""

    last: Candidate
    start_score: float
    checked: tuple[float, float] | None
    stopped: bool


@told
def tune(
    plots: Annotated[Path, typer.Argument(metavar="PLOTS.jsonl", help="A recording, or a black box.")],
    truth: Annotated[Path | None, typer.Argument(metavar="TRUTH.jsonl", help="Where the targets really were.")] = None,
    config: Config = None,
    out_path: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="File to write; default: to stdout.")
    ] = None,
    filter_name: Annotated[
        str | None, typer.Option("--filter", metavar="NAME", help="Tune this filter; default: that of the settings.")
    ] = None,
    evaluations: Annotated[
        int, typer.Option("--evaluations", min=1, metavar="N", help="How often the recording is tracked at most.")
    ] = 40,
    seed: Seed = 1,
    c_m: Annotated[
        float, typer.Option("--c", min=1e-3, metavar="M", help="With TRUTH: cut-off distance of GOSPA, metres.")
    ] = 1000.0,
    warmup_s: Annotated[
        float, typer.Option("--warmup", min=0.0, metavar="S", help="With TRUTH: seconds not scored at the start.")
    ] = 40.0,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="With TRUTH of some targets only: score the nearest track of each target.")
    ] = False,
) -> None:
    """Find settings that fit a recording. By GOSPA against the truth, else by how well plots are predicted.

    Sought are noise levels and sojourn times (of filter tvimm: turn_rate_max_degps, acceleration_max_mps2, manoeuvre_s,
    quiet_s, q_quiet), from the settings given. The last 30 % of the time are held out to check what was found. Ctrl-C
    ends the search and keeps the best so far. --evaluations times the seconds of one pass is how long it takes.
    """
    from trackmesh.services.fusion.tuning import recording_of

    recording = recording_of(read_records(plots))
    if not recording.plots:
        raise TrackmeshError(f"{plots} holds no plots, so there is nothing to tune on.")
    settings, document = _given(config, filter_name, recording)
    if out_path:
        _must_be_writable(out_path)
    records = [*([settings.origin] if settings.origin else []), *recording.records]
    recording = recording._replace(records=records)
    if truth is None:
        goal = _likelihood_goal(recording, settings.engine)
    else:
        goal = _gospa_goal(recording, plots, truth, c_m, warmup_s, nearest=nearest)
    found = _search(goal, settings.engine, evaluations, seed, plots)
    sentence = _sentence(goal, found)
    source = f"# trackmesh tune {plots}{f' {truth}' if truth else ''}, seed {seed}"
    text = "\n".join([_comment(source), _comment(f"# {sentence}"), toml_text(_tuned(document, found.last.best))])
    _hand_over(text, out_path, goal, settings.engine, found.last.best)
    say(f"{sentence}{f'; settings in {out_path}' if out_path else ''}")
    _warn(goal, settings.engine, found)


def _given(config: Path | None, filter_name: str | None, recording: Recording) -> tuple[FusionSettings, dict[str, Any]]:
    """The settings to begin with, and the file that they are of: of --config, else of the black box."""
    from trackmesh.services.fusion.settings import FusionSettings

    chosen: dict[str, Any] = {"filter": filter_name} if filter_name else {}
    if config is None and recording.settings is not None:
        chosen = recording.settings.model_dump(exclude_unset=True) | chosen
    settings = FusionSettings.load(config, {"engine": chosen} if chosen else None)
    return settings, tomllib.loads(config.read_text(encoding="utf-8")) if config else {}


def _must_be_writable(path: Path) -> None:
    """Tell a wrong name before the long work, not after it."""
    new = not path.exists()
    path.open("a").close()
    if new:
        path.unlink()


def _likelihood_goal(recording: Recording, settings: EngineSettings) -> Goal:
    from trackmesh.services.fusion import tuning

    records = recording.records
    split = _split(records, recording.first_ns, recording.last_ns)
    if any(isinstance(record, SensorInfo) and record.clutter_density is None for record in records):
        records = tuning.with_clutter(records, tuning.measured_clutter(records[:split], settings))
    name = "log-likelihood of a plot"
    return Goal(name, "", -1.0, tuning.unlikelihood, records, split, tuning.NO_PICTURES_S)


def _gospa_goal(recording: Recording, plots: Path, truth: Path, c_m: float, warmup_s: float, *, nearest: bool) -> Goal:
    from trackmesh.services.fusion.tuning import picture_period_s
    from trackmesh.sim.scoring import TruthTimeline, score_nearest, score_tracks

    frames = list(records_of(truth, TruthFrame))
    timeline = TruthTimeline(frames)
    if timeline.last_ns < recording.first_ns or recording.last_ns < timeline.first_ns:
        raise TrackmeshError(f"{truth} does not overlap {plots} in time, so there is nothing to tune on.")
    warm_ns = timeline.first_ns + (0 if nearest else round(warmup_s * 1e9))
    first_ns, last_ns = max(recording.first_ns, warm_ns), min(recording.last_ns, timeline.last_ns)

    def gospa_m(shown: Iterable[TrackFrame], _: Evidence) -> float:
        if nearest:
            return score_nearest(shown, frames, c_m).gospa_m
        return score_tracks(shown, frames, c_m, warmup_s).gospa_m

    records = recording.records
    split = _split(records, first_ns, last_ns)
    return Goal("mean GOSPA", " m", 1.0, gospa_m, records, split, picture_period_s(records))


def _split(records: list[Message], first_ns: int, last_ns: int) -> int:
    from trackmesh.services.fusion.tuning import split_at

    return split_at(records, first_ns + round((1.0 - HELD_OUT) * max(last_ns - first_ns, 0)))


def _search(goal: Goal, start: EngineSettings, evaluations: int, seed: int, plots: Path) -> Found:
    from trackmesh.services.fusion.tuning import tune as candidates

    first = last = None
    checked, stopped = None, False
    try:
        with _bar(goal, evaluations) as bar:
            for last in candidates(start, goal.tuned_on, evaluations, seed):
                first = first or last
                if not math.isfinite(first.score):
                    break
                bar(last)
        if last and last.best != start:
            checked = _checked(goal, start, last.best)
    except KeyboardInterrupt:
        stopped = True
    if first is None or last is None:
        raise TrackmeshError("Stopped before the settings given were evaluated, so nothing was found.")
    if not math.isfinite(first.score):
        raise TrackmeshError(
            f"Nothing of {plots} is scored by the settings given: no plot is taken, or all is warm-up."
        )
    return Found(last, first.score, checked, stopped)


def _checked(goal: Goal, start: EngineSettings, best: EngineSettings) -> tuple[float, float] | None:
    given, found = goal.held_out(start), goal.held_out(best)
    return (given, found) if math.isfinite(given) and math.isfinite(found) else None


@contextmanager
def _bar(goal: Goal, evaluations: int) -> Iterator[Any]:
    """A progress bar that tells the best score so far; silent when stderr is not a terminal."""
    best = TextColumn("{task.fields[best]}")
    columns = (TextColumn("tuning"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), best)
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task("", total=evaluations, best="")

        def show(candidate: Candidate) -> None:
            bar.update(task, completed=candidate.number, best=f"{goal.name} {goal.text(candidate.best_score)}")

        yield show


def _sentence(goal: Goal, found: Found) -> str:
    """What came of it, in one line."""
    last = found.last
    after = f"{'stopped ' if found.stopped else ''}after {last.number} evaluation{'s'[: last.number > 1]}"
    if last.best_score == found.start_score:
        return f"{after}: nothing is better than the settings given, {goal.name} {goal.text(last.best_score)}"

    def change(given: float, better: float) -> str:
        return f"from {goal.text(given, unit=False)} to {goal.text(better)}"

    sentence = f"{after}: {goal.name} {change(found.start_score, last.best_score)} on {_TUNED_ON}"
    if found.checked:
        return f"{sentence}, {change(*found.checked)} on {_CHECKED_ON}, held out"
    return f"{sentence}; {_CHECKED_ON} not looked at"


def _comment(text: str) -> str:
    """One line, whatever a file is called."""
    return "".join(c if c.isprintable() else "?" for c in text)


def _tuned(document: dict[str, Any], best: EngineSettings) -> dict[str, Any]:
    """The file with the engine's settings as they were evaluated."""
    from trackmesh.services.fusion.tuning import ranges_of

    names = {"filter", *ranges_of(best)} | best.model_fields_set
    return document | {"engine": best.model_dump(mode="json", include=names, exclude_none=True)}


def _hand_over(text: str, out_path: Path | None, goal: Goal, start: EngineSettings, best: EngineSettings) -> None:
    from trackmesh.services.fusion.tuning import numbers_of, ranges_of

    if out_path is None:
        print(text, end="")
        return
    out_path.write_text(text, encoding="utf-8")
    table = Table("setting", "given", "found", title=f"by {goal.name}", title_justify="left")
    for name in ranges_of(best):
        table.add_row(name, *(", ".join(f"{n:g}" for n in numbers_of(settings, name)) for settings in (start, best)))
    out.print(table)


def _warn(goal: Goal, start: EngineSettings, found: Found) -> None:
    """Say what speaks against using what was found."""
    from trackmesh.services.fusion.tuning import at_bounds

    extreme = at_bounds(start, found.last.best)
    if extreme:
        say(
            f"Beware: {' and '.join(extreme)} went to the bound of the search; where the recording holds too few"
            " manoeuvres to tell, choose a safer value.",
            style="yellow",
        )
    if found.checked and found.checked[1] > found.checked[0]:
        given, better = (goal.text(score) for score in found.checked)
        say(
            f"Beware: on {_CHECKED_ON}, held out, the settings found are worse than those given ({goal.name} {better},"
            f" not {given}): the recording may be too short to tune on.",
            style="yellow",
        )
