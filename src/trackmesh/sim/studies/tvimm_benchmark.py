"""The filters of the tracker on one target with one measured position for all models, where the paper has two.

One flight with three manoeuvres, its position measured every second with 20 m per axis. Three sets of models, each with
the same initial chain (a model is kept for a second with 0.95):

* A: constant velocity with 0.5 and with 16 m/s^1.5 of acceleration noise;
* B: constant velocity with 0.5, constant acceleration with 4 m/s^2.5 of jerk noise;
* C: constant velocity with 0.5, turns of 6 deg/s to either side with 8 m/s^1.5.

Each set is run as a conventional IMM, with transitions learned from the track itself, and as published. The service's
default filter, whose models are its own, stands beside them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.bank import Branch, Models, make_models
from trackmesh.services.estimation.motion import CONSTANT_ACCELERATION, CONSTANT_VELOCITY, TURN, Model
from trackmesh.sim.studies.filtering import run_filter
from trackmesh.sim.studies.manoeuvre.cells import Cell, Simulated, simulate
from trackmesh.sim.studies.manoeuvre.scores import Score, measured, ratio, score
from trackmesh.sim.studies.manoeuvre.variants import GENERIC, MANOEUVRE
from trackmesh.sim.studies.result import StudyResult, Table, study_row
from trackmesh.sim.studies.tvimm_benchmark_charts import Curves, draw_error

RUNS = 200
STAY = 0.95
"""Probability that a model is kept for a second."""

IMM, DIRICHLET, PAPER, TVIMM = "imm", "tvimm-dirichlet", "tvimm-paper", "tvimm"
PRIOR_COUNT, MEMORY_S, REFERENCE_S = 20.0, 80.0, 4.0
"""How the service learns transitions unless it is told otherwise."""

_QUIET = Model("cv", CONSTANT_VELOCITY, 0.5**2)
_RATE_RADPS, _FOR_EVER_S = math.radians(6.0), 1e6
SETS = {
    "A": (_QUIET, Model("rough", CONSTANT_VELOCITY, 16.0**2)),
    "B": (_QUIET, Model("acceleration", CONSTANT_ACCELERATION, 4.0**2, sd=1.0)),
    "C": (
        _QUIET,
        Model("left", TURN, 8.0**2, _RATE_RADPS, 0.0, _FOR_EVER_S),
        Model("right", TURN, 8.0**2, -_RATE_RADPS, 0.0, _FOR_EVER_S),
    ),
}
_FLIGHT = Cell("T0", "", "T0", 1.0, 20.0, 172.0)
_METRICS = {"rmse": "position", "anees": "anees", "cov95": "cov95"}

Scores = dict[tuple[str, str], Score]
"""By set and filter."""


def compare(plots: Path | None, runs: int, progress: Callable[[float], None]) -> StudyResult:
    """The three sets, what is claimed of them, and a picture into ``plots``.

    Raises:
        TrackmeshError: the picture cannot be drawn.
    """
    n = runs or RUNS
    given, scores, over_time = simulate(_FLIGHT, n), {}, {}
    filters = {name: filters_of(name) for name in SETS}
    for i, (name, own) in enumerate(filters.items()):
        for filter_name, models in own.items():
            estimates = run_filter(models, given.case)
            scores[name, filter_name] = score(models, estimates, given)
            if name == "A":
                off = estimates.mean[..., :2] - np.swapaxes(given.case.truth[:, 1:, :2], 0, 1)
                over_time[filter_name] = np.sqrt((off**2).sum(axis=-1).mean(axis=1))
        progress(0.9 * (i + 1) / len(filters))
    result = StudyResult(list(_rows(scores, n)), list(_notes(scores)), [_table(scores, n), _claims_table(scores)])
    if plots is not None:
        result.pictures.append(draw_error(plots / "tvimm_benchmark.png", _curves(given, over_time)))
    progress(1.0)
    return result


def filters_of(name: str) -> dict[str, Models]:
    """The four filters of a set."""
    models = SETS[name]
    branch = Branch(models, (sojourn_s(len(models)),) * len(models))
    learning = branch._replace(prior_count=PRIOR_COUNT)
    return {
        IMM: make_models((branch,)),
        DIRICHLET: make_models((learning,), memory_s=MEMORY_S, reference_s=REFERENCE_S),
        PAPER: make_models((branch,), printed=True),
        TVIMM: make_models((MANOEUVRE, GENERIC)),
    }


def sojourn_s(r: int) -> float:
    """Mean time in each of r models, left for any other alike, that keeps one for a second with ``STAY``.

    Pi_ii(t) = 1/r + (1 - 1/r) exp(-r t / ((r - 1) tau)), solved for tau.
    """
    return -r / ((r - 1.0) * math.log((STAY - 1.0 / r) / (1.0 - 1.0 / r)))


def _rows(scores: Scores, runs: int) -> Iterator[dict[str, object]]:
    for row, metric in _METRICS.items():
        for (name, filter_name), of in scores.items():
            value = measured(metric, of)
            yield study_row(name, row, filter_name, paper=None, ours=value.value, ours_std=value.std, runs=runs)


def _table(scores: Scores, runs: int) -> Table:
    body = []
    for (name, filter_name), of in scores.items():
        whole, quiet, busy = (measured(m, of).value for m in ("position", "quiet", "manoeuvre"))
        sure, covered = (measured(m, of).value for m in ("anees", "cov95"))
        other = ratio("position", of, scores[name, IMM])
        shown = [f"{whole:.2f} ({quiet:.1f} / {busy:.1f})", f"{other.value:.4f}", f"{sure:.2f}", f"{covered:.3f}"]
        body.append([name, filter_name, *shown])
    title = f"One position for all models: three manoeuvres, {runs} runs; tvimm has models of its own in every set"
    header = ["set", "filter", "RMSE m (quiet / manoeuvre)", "over imm", "ANEES", "within 95 %"]
    return Table(title, header, body)


def _claims(scores: Scores) -> Iterator[tuple[str, str, bool]]:
    for name in SETS:
        plain = scores[name, IMM]
        learned, sure = (ratio(m, scores[name, DIRICHLET], plain) for m in ("position", "anees"))
        text = f"{name}: learned transitions cost at most 1 % of RMSE and 15 % of ANEES"
        numbers = f"{learned.value:.4f} and {sure.value:.3f} of imm's"
        yield text, numbers, learned.value <= 1.01 and sure.value <= 1.15
        printed = ratio("position", scores[name, PAPER], plain)
        text = f"{name}: the published form diverges (more than twice the RMSE)"
        yield text, f"{printed.value:.2f} times imm's", printed.value > 2.0


def _claims_table(scores: Scores) -> Table:
    body = [[text, numbers, "yes" if holds else "NO"] for text, numbers, holds in _claims(scores)]
    return Table("What is claimed of one position for all models", ["claim", "measured", "holds"], body)


def _notes(scores: Scores) -> Iterator[str]:
    printed = [measured(m, scores[name, PAPER]).value for name in SETS for m in ("position", "anees")]
    plain = [measured("position", scores[name, IMM]).value for name in SETS]
    yield (
        "With one measured position for all models TV-IMM as published has an RMSE of {:.0f}, {:.0f} and {:.0f} m with "
        "sets A, B and C".format(*printed[::2])
        + " and an ANEES of {:.0f}, {:.0f} and {:.0f} where 1 is right".format(*printed[1::2])
        + "; the conventional IMM has {:.1f}, {:.1f} and {:.1f} m. ".format(*plain)
        + "The product counts the position once a model, and probabilities that do not see it trust the surest model."
    )
    learned = [ratio("position", scores[name, DIRICHLET], scores[name, IMM]) for name in SETS]
    changes = ", ".join(f"{100.0 * (v.value - 1.0):+.2f} %" for v in learned)
    yield f"Learned transitions change the RMSE by {changes} in A, B and C, whose prior is a sound one."
    default = ratio("position", scores["A", TVIMM], scores[min(zip(plain, SETS, strict=True))[1], IMM])
    change = f"{100.0 * (default.value - 1.0):+.1f} %"
    yield f"The service's default filter, with models of its own, has {change} against the best conventional set."


def _curves(given: Simulated, over_time: dict[str, FloatArray]) -> Curves:
    busy = given.flights.manoeuvring[:, 0].astype(float)
    return Curves(np.arange(1.0, len(busy) + 1.0), busy, over_time)
