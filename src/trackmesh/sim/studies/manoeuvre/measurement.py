"""Runs all filters over all cells and keeps what is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from trackmesh.sim.studies.filtering import run_filter
from trackmesh.sim.studies.manoeuvre.cells import P_DETECT, Cell, Simulated, simulate, with_misses
from trackmesh.sim.studies.manoeuvre.scores import Score, Value, geometric_mean, measured, ratio, score
from trackmesh.sim.studies.manoeuvre.variants import IMM, TVIMM, Variant, variants


class Case(NamedTuple):
    """A cell with certain detection or not."""

    cell: Cell
    certain: bool = True

    def __str__(self) -> str:
        return self.cell.name if self.certain else missing(self.cell.name)


class Measured(NamedTuple):
    """The scores of all filters in all cases, by the case's label and the filter's name."""

    cases: tuple[Case, ...]
    scores: dict[str, dict[str, Score]]

    def value(self, label: str, metric: str, name: str = TVIMM, over: str | None = IMM) -> Value:
        """A metric of a filter, over that of another one in the same case, or as it is."""
        of = self.scores[label]
        return measured(metric, of[name]) if over is None else ratio(metric, of[name], of[over])

    def group_mean(self, cases: Iterable[Case], metric: str, name: str = TVIMM) -> Value:
        """Geometric mean over cases of the ratio to the plain filter."""
        return geometric_mean([self.value(str(case), metric, name) for case in cases])

    def worst(self, cases: Iterable[Case], metric: str) -> tuple[Case, Value]:
        """The case in which the ratio to the plain filter is largest, and that ratio."""
        found = [(case, self.value(str(case), metric)) for case in cases]
        return max(found, key=lambda pair: pair[1].value)

    def select(self, *, group: str | None = None, certain: bool = True) -> list[Case]:
        """The cases of a group of cells, or of all."""
        return [c for c in self.cases if c.certain is certain and group in (None, c.cell.group)]


def missing(name: str) -> str:
    """The label of a cell in which plots are missing."""
    return f"{name} Pd {P_DETECT:g}"


def measure(cells: tuple[Cell, ...], runs: int, progress: Callable[[float], None]) -> Measured:
    """Simulate every cell, with every plot and without some, and run its filters; of radars only with every plot."""
    cases: list[Case] = []
    scores: dict[str, dict[str, Score]] = {}
    for i, cell in enumerate(cells):
        simulated = simulate(cell, runs)
        for certain in (True,) if cell.radar else (True, False):
            case = Case(cell, certain)
            given = simulated if certain else with_misses(cell, simulated)
            cases.append(case)
            scores[str(case)] = {name: _scored(v, given) for name, v in variants(cell.name, certain).items()}
        progress((i + 1) / len(cells))
    return Measured(tuple(cases), scores)


def _scored(variant: Variant, given: Simulated) -> Score:
    models, lag = variant
    return score(models, run_filter(models, given.case, plots=given.plots, detected=given.detected, lag=lag), given)
