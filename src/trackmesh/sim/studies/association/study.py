"""The study: the tables of Long, Cai, Li and Qiu (2022) anew, and their methods beside others where it gets difficult.

The first part does the paper's experiment again, as far as the print allows; the second gives the tracks of two
simulated radars to the same methods, to the nearest neighbour and to the service's own test, without and with
registration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from trackmesh.sim.studies.association import paper, pictures
from trackmesh.sim.studies.association.setting import PAPER_RUNS
from trackmesh.sim.studies.association.stress import evidence, table
from trackmesh.sim.studies.association.stress.cases import CASES, Case
from trackmesh.sim.studies.association.stress.evidence import Pairs
from trackmesh.sim.studies.result import StudyResult

_PAPER, _STRESS = 0.12, 0.92
"""Shares of the time after which the parts are done."""


def run(plots: Path | None = None, runs: int = 0, progress: Callable[[float], None] | None = None) -> StudyResult:
    """Both parts: rows, tables, notes, and three pictures into the folder ``plots``.

    Args:
        plots: folder of the pictures, made where missing; None for none.
        runs: of the paper's experiment, and the most of each case of the stress table; 0 for 100, and one to six.
        progress: is told the share that is done.

    Raises:
        TrackmeshError: a picture cannot be drawn.
    """
    return run_cases(CASES, plots, runs, progress or (lambda _: None))


def run_cases(cases: tuple[Case, ...], plots: Path | None, runs: int, say: Callable[[float], None]) -> StudyResult:
    """As ``run``, with these cases in the stress table."""
    shares, fresh, alike = paper.simulate_all(runs, lambda done: say(_PAPER * done))
    result = paper.compare(shares, fresh, alike, runs or PAPER_RUNS)
    found = table.measure(cases, runs, lambda done: say(_PAPER + (_STRESS - _PAPER) * done))
    told = pictures.evidence_pairs(
        min(runs or evidence.RUNS, evidence.RUNS), lambda done: say(_STRESS + 0.9 * (1.0 - _STRESS) * done)
    )
    second = table.present(found)
    result.rows += second.rows
    result.tables += second.tables
    result.notes += [*second.notes, *_notes(told)]
    if plots is not None:
        result.pictures += pictures.draw_all(plots, shares, found, told)
    say(1.0)
    return result


def _notes(told: dict[str, Pairs]) -> Iterator[str]:
    rho = told["true"].autocorrelation(30)
    alpha, untold = evidence.ALPHAS[1], told["untold"]
    mean, lost = float(np.nanmean(untold.distance)) / 4.0, 100.0 * float(untold.rejected(alpha)[-1])
    yield (
        "Why the sum is not chi-square: differences of true pairs two, four and six seconds apart are correlated by "
        f"{rho[1]:.2f}, {rho[2]:.2f} and {rho[3]:.2f}, so their sum of squares scatters as if each were there "
        f"{evidence.repeats(rho):.1f} times. With interference that is not in R a single distance is {mean:.2f} times "
        f"its degrees of freedom, almost honest, and yet {lost:.0f} % of the true pairs are rejected at "
        f"alpha = {alpha:g}; in the nominal case covariances are too large, which hides it."
    )
