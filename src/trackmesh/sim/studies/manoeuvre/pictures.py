"""What the pictures of the study show, taken from its measurements."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.studies.filtering import Estimates, errors, run_filter
from trackmesh.sim.studies.manoeuvre.cells import IN_FAMILY, NEW, OUT_OF_FAMILY, Cell, simulate
from trackmesh.sim.studies.manoeuvre.charts import (
    Dots,
    FlightSeen,
    Group,
    Profile,
    draw_flight,
    draw_onset,
    draw_ratios,
    draw_weights,
)
from trackmesh.sim.studies.manoeuvre.measurement import Case, Measured, missing
from trackmesh.sim.studies.manoeuvre.variants import BRANCH_A, IMM, MANOEUVRE, TVIMM, variants

_EXAMPLE = "R1/30"
_NAMES = {
    "T0": "three manoeuvres (T0)",
    "R": "turns, speed changes (R)",
    "radar": "R, seen by radar",
    "both": "both at once",
    "s-turns": "S-turns",
    "jink": "jink",
    "weave": "weave",
    "singer": "Singer",
    "wna": "white acceleration",
    "cv": "straight only",
}


def draw_all(folder: Path, found: Measured) -> list[Path]:
    """Draw the four pictures.

    Raises:
        TrackmeshError: matplotlib is missing, or a picture cannot be written.
    """
    groups = [_group(found, title) for title in (IN_FAMILY, OUT_OF_FAMILY, NEW)]
    example = next(case.cell for case in found.cases if case.cell.name == _EXAMPLE)
    return [
        draw_ratios(folder / "manoeuvre_ratios.png", groups, "plain IMM"),
        draw_onset(folder / "manoeuvre_onset.png", _profiles(found, example), _EXAMPLE),
        draw_weights(folder / "manoeuvre_weight.png", _weights(found)),
        draw_flight(folder / "manoeuvre_flight.png", _flight(example)),
    ]


def _group(found: Measured, title: str) -> Group:
    cells = [case.cell.name for case in found.select(group=title)]
    dots = [_dots(found, "all plots", TVIMM, cells), _dots(found, "manoeuvre branch alone", BRANCH_A, cells)]
    with_misses = [missing(cell) if missing(cell) in found.scores else None for cell in cells]
    return Group(title, cells, [*dots, _dots(found, "a fifth missing", TVIMM, with_misses)])


def _dots(found: Measured, label: str, name: str, cells: Sequence[str | None]) -> Dots:
    values, spread = np.full((2, len(cells), 2), np.nan)
    for i, cell in enumerate(cells):
        for k, metric in enumerate(("position", "velocity")):
            if cell is not None:
                ratio = found.value(cell, metric, name)
                values[i, k], spread[i, k] = ratio.value, 2.0 * (ratio.std or 0.0)
    return Dots(label, values, spread)


def _profiles(found: Measured, cell: Cell) -> list[Profile]:
    profiles = []
    for name in (TVIMM, IMM, f"{TVIMM}, lag 1", f"{IMM}, lag 1"):
        onset = found.scores[cell.name][name].onset
        error_m = np.sqrt(onset.over(np.ones((1, len(onset.total))))[0])
        profiles.append(Profile(name, cell.period_s * np.arange(float(len(error_m))), np.asarray(error_m)))
    return profiles


def _weights(found: Measured) -> dict[str, FloatArray]:
    """Mean weight of the manoeuvre branch of every flight with all its plots, by family."""
    return {
        name: np.concatenate([_per_flight(found, c) for c in found.select() if _kind(c.cell) == kind])
        for kind, name in _NAMES.items()
    }


def _kind(cell: Cell) -> str:
    return "radar" if cell.radar else cell.family


def _per_flight(found: Measured, case: Case) -> FloatArray:
    weight = found.scores[str(case)][TVIMM].weight
    return np.asarray(weight.total / weight.scans)


def _flight(cell: Cell) -> FlightSeen:
    given = simulate(cell, 1)
    seen: dict[str, Estimates] = {}
    for name, variant in variants("", certain=False).items():
        seen[name] = run_filter(variant.models, given.case, plots=given.plots)
    mu, own = seen[TVIMM].mu[:, 0], len(MANOEUVRE.models)
    return FlightSeen(
        t_s=np.asarray(cell.period_s * np.arange(1.0, len(mu) + 1.0)),
        way_km=given.flights.truth[0, 1:, :2] / 1e3,
        seen_km=seen[TVIMM].mean[:, 0, :2] / 1e3,
        busy=given.flights.manoeuvring[:, 0].astype(float),
        error_m={name: np.hypot(*errors(seen[name], given.case)[:, 0, :2].T) for name in (IMM, TVIMM)},
        parts=["straight", "turn left", "turn right", "speed change", "free acceleration", "generic branch"],
        probability=np.column_stack([mu[:, :own], mu[:, own:].sum(axis=1)]),
    )
