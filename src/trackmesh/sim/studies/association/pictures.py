"""What of the results goes into the pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.track_distances import acceptance_limit
from trackmesh.services.estimation.uncertain import NOISE_MODELS
from trackmesh.sim.drawing import INK, MUTED, TRACKS
from trackmesh.sim.studies.association.charts import (
    Band,
    Evidence,
    Grid,
    Line,
    Panel,
    draw_evidence,
    draw_stress,
    draw_tables,
)
from trackmesh.sim.studies.association.decisions import Key, Shares
from trackmesh.sim.studies.association.paper import printed, rms_apart
from trackmesh.sim.studies.association.setting import COUNTS, METHODS
from trackmesh.sim.studies.association.stress import evidence, methods, table
from trackmesh.sim.studies.association.stress.cases import CYCLE_S
from trackmesh.sim.studies.association.stress.evidence import Pairs

_TRUE, _WRONG, _BIAS, _UNTOLD = TRACKS[0], TRACKS[1], TRACKS[3], TRACKS[4]
_SHOWN_FROM = 3
"""Looks before are left out: there are few pairs yet."""


def draw_all(folder: Path, shares: Shares, found: table.Scores, told: dict[str, Pairs]) -> list[Path]:
    """The three pictures, in ``folder``.

    Args:
        folder: made where missing.
        shares: of the paper's experiment. found: of the stress table. told: of ``evidence_pairs``.

    Raises:
        TrackmeshError: matplotlib is missing, or a picture cannot be written.
    """
    panels = [_panel(shares, k) for k in range(len(METHODS))]
    return [
        draw_tables(folder / "association_tables.png", panels, rms_apart(shares)),
        draw_stress(folder / "association_stress.png", _grid(found, ""), _grid(found, methods.REGISTERED)),
        draw_evidence(folder / "association_statistic.png", _evidence(told)),
    ]


def evidence_pairs(runs: int, progress: Callable[[float], None]) -> dict[str, Pairs]:
    """Pairs whose statistic is drawn."""
    cases = {"true": evidence.NOMINAL, "bias": evidence.BIASED, "untold": evidence.UNTOLD}
    told = {}
    for k, (name, case) in enumerate(cases.items()):
        told[name] = evidence.true_pairs(case, runs)
        progress((k + 1) / (len(cases) + 1))
    told["wrong"] = evidence.wrong_pairs(evidence.FORMATIONS, runs)
    progress(1.0)
    return told


def _panel(shares: Shares, number: int) -> Panel:
    method = METHODS[number]
    cells = [[Key(method, noise, count) for count in COUNTS] for noise in NOISE_MODELS]
    return Panel(
        f"Table {number + 1}: {method}",
        COUNTS,
        np.array([[printed(key) for key in line] for line in cells]),
        np.array([[shares[key].mean() for key in line] for line in cells]),
        np.array([[shares[key].std() for key in line] for line in cells]),
    )


def _grid(found: table.Scores, registered: str) -> Grid:
    names = list(methods.METHODS)
    correct, wrong = (
        np.array([[table.mean(found, case, name + registered, what) for name in names] for case in found])
        for what in ("correct", "wrong")
    )
    return Grid(list(found), names, correct, wrong)


def _evidence(told: dict[str, Pairs]) -> Evidence:
    true = told["true"]
    loose = evidence.ALPHAS[0]
    honest = float(np.nanmean(true.distance)) / 4.0
    groups = (("true", "true pairs", _TRUE), ("bias", "true pairs, one radar biased", _BIAS),
              ("wrong", "wrong pairs, 500 m apart", _WRONG))  # fmt: skip
    bands = [
        Band(label, color, _quantiles(told[name])[:, _SHOWN_FROM:], filled=name != "bias")
        for name, label, color in groups
    ]
    looks = np.nanmax(true.looks, axis=1)
    limits = [
        Line(f"chi-square, alpha = {alpha:g}", color, _limit(looks, alpha)[_SHOWN_FROM:])
        for alpha, color in zip(evidence.ALPHAS, (INK, MUTED), strict=True)
    ]
    rejected = [
        Line("one radar biased", _BIAS, told["bias"].rejected(loose)),
        Line("interference not in R", _UNTOLD, told["untold"].rejected(loose)),
        Line("nominal, covariances scaled to be honest", _TRUE, true.rejected(loose, honest), dashed=True),
        Line("nominal, covariances as they are (too large)", _TRUE, true.rejected(loose)),
    ]
    rho = true.autocorrelation()
    return Evidence(
        evidence.times_s(true)[_SHOWN_FROM:], bands, limits,
        [line._replace(values=100.0 * line.values[_SHOWN_FROM:]) for line in rejected], 100.0 * loose,
        CYCLE_S * np.arange(float(len(rho))), rho, evidence.repeats(true.autocorrelation(30)),
    )  # fmt: skip


def _quantiles(pairs: Pairs) -> FloatArray:
    """5, 50 and 95 % of the pairs, (3, looks); NaN where there is none yet."""
    values = pairs.per_freedom()
    found = np.full((3, len(values)), np.nan)
    there = np.isfinite(values).any(axis=1)
    found[:, there] = np.nanquantile(values[there], (0.05, 0.5, 0.95), axis=1)
    return found


def _limit(looks: FloatArray, alpha: float) -> FloatArray:
    return acceptance_limit(np.maximum(looks, 1.0), 4, alpha) / (4.0 * np.maximum(looks, 1.0))
