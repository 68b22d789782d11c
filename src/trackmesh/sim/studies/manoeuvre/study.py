"""The study: the default filter beside the plain filter that it contains, over every kind of target we thought of.

The plain filter is the interacting multiple model filter of three models that the default one has as its second branch,
tuned on the same mixture of targets. All targets are simulated, one at a time, without false plots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from trackmesh.sim.studies.manoeuvre.acceptance import Judged, judge
from trackmesh.sim.studies.manoeuvre.cells import IN_FAMILY, NEW, OTHERS, OUT_OF_FAMILY, P_DETECT, all_cells
from trackmesh.sim.studies.manoeuvre.measurement import Case, Measured, measure
from trackmesh.sim.studies.manoeuvre.pictures import draw_all
from trackmesh.sim.studies.manoeuvre.scores import Value
from trackmesh.sim.studies.manoeuvre.variants import BRANCH_A, IMM, LAGGED, TVIMM
from trackmesh.sim.studies.result import StudyResult, Table, study_row

RUNS = 60
"""Of each cell, unless it is told otherwise."""


def run(plots: Path | None = None, runs: int = 0, progress: Callable[[float], None] | None = None) -> StudyResult:
    """All cells: rows, the table of claims, tables by kind of target, and four pictures into the folder ``plots``.

    Args:
        plots: folder of the pictures, made where missing; None for none.
        runs: flights of each cell; 0 for 60.
        progress: is told the share that is done.

    Raises:
        TrackmeshError: a picture cannot be drawn.
    """
    say = progress or (lambda _: None)
    found = measure(all_cells(), runs or RUNS, lambda share: say(0.95 * share))
    judged = judge(found)
    result = StudyResult(list(_rows(found, runs or RUNS)), list(_notes(found, judged, runs or RUNS)))
    result.tables += [_claims_table(judged), _families_table(found)]
    result.tables += [_cells_table(found, group) for group in (IN_FAMILY, OUT_OF_FAMILY, NEW)]
    result.tables.append(_lags_table(found))
    if plots is not None:
        result.pictures += draw_all(plots, found)
    say(1.0)
    return result


def _rows(found: Measured, runs: int) -> Iterator[dict[str, object]]:
    for label, scores in found.scores.items():
        for metric in ("position", "velocity", "peak", "anees"):
            for name in scores:
                value = found.value(label, metric, name, None if metric == "anees" else IMM)
                if value.known:
                    yield study_row(label, metric, name, paper=None, ours=value.value, ours_std=value.std, runs=runs)


def _claims_table(judged: list[Judged]) -> Table:
    body = []
    for claim in judged:
        where = f" ({claim.where})" if claim.where else ""
        body.append(
            [claim.text, claim.bound, claim.before, _shown(claim.found) + where, "yes" if claim.holds else "NO"]
        )
    return Table("What is claimed, and what was found", ["claim", "bound", "before", "measured", "holds"], body)


def _families(found: Measured, certain: bool) -> Iterator[tuple[str, list[Case]]]:
    """Kinds of targets, and their cases."""
    known = found.select(group=IN_FAMILY, certain=certain)
    for title, periods in (("1 to 2 s", (1.0, 2.0)), ("4 s", (4.0,)), ("10 s", (10.0,))):
        yield f"T0 and R, {title}", [case for case in known if case.cell.period_s in periods]
    yield "T0 and R, all", known
    others = found.select(certain=certain)
    for family in (*OTHERS, "both", "s-turns"):
        yield family, [case for case in others if case.cell.family == family]
    for rate in (False, True) if certain else ():
        seen = [case for case in others if case.cell.radar and case.cell.radar.measures_rate is rate]
        yield f"R, radar{', range rate' if rate else ''}", seen


def _families_table(found: Measured) -> Table:
    body = []
    for certain in (True, False):
        for title, cases in _families(found, certain):
            means = [_mean(found, cases, metric, TVIMM) for metric in ("position", "velocity", "peak")]
            worst = [f"{found.worst(cases, metric)[1].value:.3f}" for metric in ("position", "velocity")]
            alone = [_mean(found, cases, metric, BRANCH_A) for metric in ("position", "velocity")]
            body.append([title, "1" if certain else f"{P_DETECT:g}", f"{len(cases)}", *means, *worst, *alone])
    header = ["targets", "Pd", "cells", "position", "velocity", "peak", "worst position", "worst velocity"]
    title = f"{TVIMM} over {IMM}, geometric mean of the cells, and {BRANCH_A} over it"
    return Table(title, [*header, "A: position", "A: velocity"], body)


def _mean(found: Measured, cases: list[Case], metric: str, name: str) -> str:
    with_one = [case for case in cases if found.value(str(case), metric, name).known]
    return f"{found.group_mean(with_one, metric, name).value:.3f}" if with_one else "-"


def _cells_table(found: Measured, group: str) -> Table:
    body = []
    for certain in (True, False):
        for case in found.select(group=group, certain=certain):
            label = str(case)
            plain = [f"{found.value(label, metric, IMM, None).value:.2f}" for metric in ("position", "velocity")]
            ours = [_shown(found.value(label, metric)) for metric in ("position", "velocity", "peak")]
            sure = [_sureness(found, label, name) for name in (TVIMM, IMM)]
            covered = f"{found.value(label, 'cov95', TVIMM, None).value:.3f}"
            body.append([label, *plain, *ours, *sure, covered, f"{weight_of(found, label):.2f}"])
    header = ["cell", "imm (m)", "imm (m/s)", "position", "velocity", "peak"]
    header += ["ANEES (in manoeuvre)", "imm's ANEES", "within 95 %", "weight of A"]
    return Table(f"{group[0].upper()}{group[1:]}: {TVIMM}, the first three over {IMM}", header, body)


def _sureness(found: Measured, label: str, name: str) -> str:
    whole, within = (found.value(label, m, name, None) for m in ("anees", "anees in manoeuvre"))
    return f"{whole.value:.2f}" + (f" ({within.value:.2f})" if within.known else "")


def weight_of(found: Measured, label: str) -> float:
    """Mean weight of the manoeuvre branch in the default filter."""
    weight = found.scores[label][TVIMM].weight
    return float(weight.total.sum() / weight.scans.sum())


def _lags_table(found: Measured) -> Table:
    body = []
    for cell in LAGGED:
        for name in (TVIMM, BRANCH_A, IMM):
            numbers = []
            for column in (name, f"{name}, lag 1", f"{name}, lag 2"):
                ratios = [found.value(cell, metric, column) for metric in ("position", "velocity", "peak")]
                sure = found.value(cell, "anees in manoeuvre", column, None)
                numbers.append(f"{', '.join(f'{r.value:.3f}' for r in ratios)} ({sure.value:.2f})")
            body.append([cell, name, *numbers])
    title = f"States some plots ago: position, velocity, peak over {IMM} without lag (ANEES in manoeuvre)"
    return Table(title, ["cell", "filter", "lag 0", "lag 1", "lag 2"], body)


def _notes(found: Measured, judged: list[Judged], runs: int) -> Iterator[str]:
    missed = [f"{c.text} {_shown(c.found)}, bound {c.bound}" for c in judged if not c.holds]
    yield f"{len(judged) - len(missed)} of {len(judged)} claims hold. " + (
        f"Missed: {'; '.join(missed)}." if missed else "None is missed."
    )
    near = [c.text for c in judged if c.holds and _is_near(c)]
    if near:
        yield f"Within two standard errors of the bound, so that another seed may miss it: {'; '.join(near)}."
    for text, cases in _families(found, certain=True):
        if text.startswith("T0 and R, ") and not text.endswith("all"):
            yield f"{text}: {', '.join(_change(found, cases, m) for m in ('position', 'velocity', 'peak'))}."
    yield _note_on_new(found)
    yield _note_on_rate(found)
    yield (
        f"No filter here knows its error within manoeuvres: over T0 and R {TVIMM} has an ANEES of "
        f"{_range(found, TVIMM)} there, {IMM} of {_range(found, IMM)}, 1 if it did."
    )
    yield (
        f"The reference is our own tuned filter of three models, targets are simulated, {runs} flights a cell. Filters "
        "tuned for one cell alone, or of more models, are not among those compared. Errors count at scans without a "
        "plot too; the filters are started about the truth. Standard errors are of the bootstrap over the flights."
    )
    yield (
        "The other targets are seen every 1, 2, 4 and 10 s with 10, 30, 30 and 100 m. Weave, singer and wna manoeuvre "
        "all the time and cv never does: they have no onset, hence no peak."
    )


def _is_near(claim: Judged) -> bool:
    gap = min(claim.found.value - claim.low, claim.high - claim.found.value)
    return gap < 2.0 * (claim.found.std or 0.0)


def _change(found: Measured, cases: list[Case], metric: str) -> str:
    mean = found.group_mean(cases, metric)
    return f"{metric} {100.0 * (mean.value - 1.0):+.1f} % (standard error {100.0 * (mean.std or 0.0):.1f})"


def _note_on_new(found: Measured) -> str:
    told = []
    for certain in (True, False):
        cells = [c for c in found.select(group=NEW, certain=certain) if c.cell.family in ("both", "s-turns")]
        told.append(", ".join(f"{c.cell.name} {found.value(str(c), 'position').value:.3f}" for c in cells))
    return (
        f"Turning and changing speed at once, and S-turns, position over {IMM}: {told[0]}; with Pd {P_DETECT:g} "
        f"{told[1]}."
    )


def _note_on_rate(found: Measured) -> str:
    gains = []
    for case in found.select(group=NEW):
        if case.cell.radar and not case.cell.radar.measures_rate:
            name = case.cell.name
            both = [found.value(f"{name}{rate}", "position").value for rate in ("", " range rate")]
            gains.append(f"{name} {both[0]:.3f} and {both[1]:.3f}")
    return f"Radar 60 to 100 km away, position over {IMM} without and with range rate: {'; '.join(gains)}."


def _range(found: Measured, name: str) -> str:
    known = [found.value(str(case), "anees in manoeuvre", name, None).value for case in found.select(group=IN_FAMILY)]
    return f"{min(known):.1f} to {max(known):.1f}"


def _shown(value: Value) -> str:
    """A number with its standard error."""
    if not value.known:
        return "-"
    return f"{value.value:.3f}" + (f" ± {value.std:.3f}" if value.std is not None else "")
