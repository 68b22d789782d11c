"""Where decreasing alpha-beta gains are best held: the tables of Qiu and Qiu (2016) beside exact values.

Qiu and Qiu, "Analysis and simulation of basic issue of alpha-beta filters", Telecommunication Engineering 56(4), hold
the gains from plot k_end on and look for the best k_end in simulated errors of 100 tracks of 100 plots. The filter is
linear and its gains are known, so the errors can be computed: ours is the k_end with the least RMS position error over
plots 2 to 100, without any simulation. The tables themselves are pictures; the text names eight of their cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.alpha_beta import (
    FloatLike,
    combined_gains,
    decreasing_gains,
    error_covariances,
    k_end_rule,
    kalman_gains,
    manoeuvring_index,
    steady_gains,
    step,
)
from trackmesh.sim.studies.alpha_beta_charts import Curves, Printed, draw_errors, draw_k_end
from trackmesh.sim.studies.result import StudyResult, Table, study_row

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

PLOTS = 100
TRACKS = 100
"""Plots a track, and tracks a simulation, as in the paper."""

K_END = np.arange(2, 81)
VARIANCES_W_M2 = {"1": 25.0, "2": 400.0}
VARIANCES_V_M2S4 = np.array([0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 28.0, 35.0])
INTERVALS_S = np.array([0.5, 1.0, 2.0, 6.0, 10.0, 12.0])


class Cell(NamedTuple):
    """One cell of a table: variances of measured position (m^2) and of acceleration (m^2/s^4), and the interval."""

    variance_w: float
    variance_v: float
    dt_s: float

    @property
    def lambda_(self) -> float:
        """The manoeuvring index."""
        return float(manoeuvring_index(*self.physics))

    @property
    def physics(self) -> tuple[float, float, float]:
        """Interval and standard deviations of acceleration and position, as the numerics want them."""
        return self.dt_s, self.variance_v**0.5, self.variance_w**0.5

    @property
    def label(self) -> str:
        """For pictures."""
        return rf"$\sigma_w^2 = {self.variance_w:g}$, $\sigma_v^2 = {self.variance_v:g}$, $T = {self.dt_s:g}$ s"

    def __str__(self) -> str:
        return f"{self.variance_w:g}, {self.variance_v:g}, {self.dt_s:g} s"


PRINTED = {
    Cell(25, 10, 0.5): 7,
    Cell(25, 15, 0.5): 7,
    Cell(25, 0.1, 0.5): 26,
    Cell(25, 35, 0.5): 5,
    Cell(25, 0.1, 1): 10,
    Cell(400, 0.1, 1): 16,
    Cell(25, 15, 2): 2,
    Cell(25, 15, 6): 2,
}
"""The values of k_end that the text of the paper names."""


def run(plots: Path | None = None, runs: int = 0, progress: Callable[[float], None] | None = None) -> StudyResult:
    """Both tables, what the text says, and two pictures into the folder ``plots``.

    Args:
        plots: folder of the pictures, made where missing; None for none.
        runs: how often to repeat the paper's own procedure for the cells it names: the spread of what it picks becomes
            their ``ours_std``. The values themselves need no runs.
        progress: is told the share that is done.

    Raises:
        TrackmeshError: a picture cannot be drawn.
    """
    say = progress or (lambda _: None)
    best = {name: best_k_end(variance) for name, variance in VARIANCES_W_M2.items()}
    say(0.1)
    picked = dict(_picks(runs, say))
    result = StudyResult(list(_rows(best, picked, runs)), list(_notes(picked)))
    result.tables += [_cells_table(name, table) for name, table in best.items()]
    result.tables += [_printed_table(picked), _claims_table(best), _losses_table()]
    if plots is not None:
        result.pictures += [draw_k_end(plots, *_k_end_curve(), _printed_points()), draw_errors(plots, _error_curves())]
    say(1.0)
    return result


def held_gains(k_end: IntArray) -> tuple[FloatArray, FloatArray]:
    """Decreasing gains held from ``k_end`` (...) on, (..., 100)."""
    return decreasing_gains(np.minimum(np.arange(1, PLOTS + 1), np.asarray(k_end)[..., None]))


def rms_errors(
    gains: tuple[FloatArray, FloatArray], dt_s: FloatLike, sigma_v_mps2: FloatLike, sigma_w_m: FloatLike
) -> FloatArray:
    """RMS error over plots 2 to 100 of position and velocity, (..., 2), for ``gains`` (..., 100)."""
    P = error_covariances(*gains, dt_s, sigma_v_mps2, sigma_w_m)
    return np.asarray(np.sqrt(np.stack([P[..., 1:, 0, 0], P[..., 1:, 1, 1]], -1).mean(axis=-2)))


def cell_errors(cell: Cell, k_end: IntArray) -> FloatArray:
    """RMS errors (..., 2) in a cell with each of ``k_end`` (...)."""
    return rms_errors(held_gains(k_end), *cell.physics)


def best_k_end(variance_w: float) -> IntArray:
    """A whole table (10, 6): the k_end of the least RMS position error."""
    sigma_v, dt_s = np.sqrt(VARIANCES_V_M2S4)[:, None, None], INTERVALS_S[None, :, None]
    best = rms_errors(held_gains(K_END), dt_s, sigma_v, variance_w**0.5)[..., 0].argmin(axis=-1)
    return np.asarray(K_END[best])


def simulated_pick(cell: Cell, rng: np.random.Generator) -> int:
    """The k_end that the paper's procedure picks: least mean |position error| of 100 simulated tracks for each k_end.

    Each k_end gets tracks of its own. The two coordinates of the filter hold two tracks of the paper's one.
    """
    n = len(K_END) * TRACKS // 2
    alpha, beta = (np.repeat(g, TRACKS // 2, axis=0) for g in held_gains(K_END))
    x, dt_s, T = np.zeros((n, 4)), np.full(n, cell.dt_s), cell.dt_s
    truth, total = np.zeros((n, 4)), np.zeros(n)
    for k in range(PLOTS):
        push = rng.normal(0.0, cell.variance_v**0.5, (n, 2))
        if k:
            truth[:, :2] += T * truth[:, 2:] + T * T / 2.0 * push
            truth[:, 2:] += T * push
        z = truth[:, :2] + rng.normal(0.0, cell.variance_w**0.5, (n, 2))
        x = step(x, z, dt_s, np.full(n, k + 1), alpha[:, k].copy(), beta[:, k].copy())
        total += np.abs(x[:, :2] - truth[:, :2]).sum(axis=1)
    return int(K_END[total.reshape(len(K_END), -1).mean(axis=1).argmin()])


def _picks(runs: int, say: Callable[[float], None]) -> Iterator[tuple[Cell, IntArray]]:
    for i, cell in enumerate(PRINTED if runs else ()):
        yield cell, np.array([simulated_pick(cell, np.random.default_rng([i, r])) for r in range(runs)])
        say(0.1 + 0.7 * (i + 1) / len(PRINTED))


def _rows(best: dict[str, IntArray], picked: dict[Cell, IntArray], runs: int) -> Iterator[dict[str, object]]:
    for name, table in best.items():
        for (i, j), ours in np.ndenumerate(table):
            cell = Cell(VARIANCES_W_M2[name], float(VARIANCES_V_M2S4[i]), float(INTERVALS_S[j]))
            spread = float(picked[cell].std()) if cell in picked else 0.0
            yield study_row(
                name, f"{cell.variance_v:g}", f"T={cell.dt_s:g}",
                paper=PRINTED.get(cell), ours=int(ours), ours_std=spread, runs=runs if cell in picked else 0,
            )  # fmt: skip


def _cells_table(name: str, table: IntArray) -> Table:
    variance = VARIANCES_W_M2[name]
    body = []
    for variance_v, line in zip(VARIANCES_V_M2S4.tolist(), table.tolist(), strict=True):
        printed = (PRINTED.get(Cell(variance, variance_v, dt_s)) for dt_s in INTERVALS_S.tolist())
        shown = [f"{k}" if p is None else f"{k} ({p})" for k, p in zip(line, printed, strict=True)]
        body.append([f"{variance_v:g}", *shown])
    title = (
        f"Table {name}: best k_end at sigma_w^2 = {variance:g} m^2; the paper's in brackets, where its text names it"
    )
    return Table(title, ["sigma_v^2", *(f"T={dt_s:g}" for dt_s in INTERVALS_S)], body)


class Judged(NamedTuple):
    """A cell that the paper names: best k_end by position and by velocity, the range within 5 %, the paper's loss."""

    best: int
    by_velocity: int
    low: int
    high: int
    loss: float


def judged(cell: Cell) -> Judged:
    """The paper's value of a cell beside all others."""
    rms = cell_errors(cell, K_END)
    best, by_velocity = K_END[rms.argmin(axis=0)].tolist()
    good = K_END[rms[:, 0] <= 1.05 * rms[:, 0].min()]
    loss = rms[PRINTED[cell] - K_END[0], 0] / rms[:, 0].min() - 1.0
    return Judged(best, by_velocity, int(good[0]), int(good[-1]), float(loss))


def _printed_table(picked: dict[Cell, IntArray]) -> Table:
    body = []
    for cell, printed in PRINTED.items():
        j = judged(cell)
        spread = f"{picked[cell].min()} to {picked[cell].max()}" if cell in picked else "-"
        best = [f"{j.best}", f"{j.by_velocity}", f"{k_end_rule(cell.lambda_)}"]
        judgement = [f"{j.low} to {j.high}", f"{100 * j.loss:.1f} %", spread]
        body.append([f"{cell}", f"{cell.lambda_:.3g}", f"{printed}", *best, *judgement])
    header = ["sigma_w^2, sigma_v^2, T", "lambda", "paper", "best", "by velocity", "rule", "within 5 %", "paper's loss"]
    header += ["simulated"]
    return Table("Cells that the text of the paper names", header, body)


class Claim(NamedTuple):
    """A sentence of the paper on a cell: errors of position (m) and velocity (m/s) with each k_end decide on it."""

    text: str
    cell: Cell
    k_end: tuple[int, ...]
    holds: Callable[[FloatArray, FloatArray], np.bool_]


CLAIMS = (
    Claim(
        "fig. 1: of 10, 20, 30, 40 the first is best", Cell(25, 10, 0.5), (10, 20, 30, 40), lambda p, _: p.argmin() == 0
    ),
    Claim(
        "fig. 2: 4, 7, 10 alike in position, 13 clearly worse",
        Cell(25, 10, 0.5),
        (4, 7, 10, 13),
        lambda p, _: p[3] > 1.15 * p[:3].max(),
    ),
    Claim(
        "fig. 4: 7 costs 1.5 m and 1 m/s more than 26",
        Cell(25, 0.1, 0.5),
        (7, 26),
        lambda p, v: np.abs(p[0] - p[1] - 1.5) + np.abs(v[0] - v[1] - 1.0) < 0.5,
    ),
    Claim(
        "fig. 4: 7 little worse than 5", Cell(25, 35, 0.5), (5, 7), lambda p, v: max(p[1] / p[0], v[1] / v[0]) < 1.15
    ),
    Claim(
        "fig. 6: 2 and 3 alike in position, not in velocity",
        Cell(25, 15, 2),
        (2, 3),
        lambda p, v: (p[1] < 1.05 * p[0]) & (v[1] > 1.2 * v[0]),
    ),
    Claim("fig. 7: 2 clearly better than 3 in position", Cell(25, 15, 6), (2, 3), lambda p, _: p[1] > 2.0 * p[0]),
)


def _claims_table(best: dict[str, IntArray]) -> Table:
    body = [[text, numbers, "yes" if holds else "no"] for text, numbers, holds in (*_claims(), *_trends(best))]
    return Table("What the text of the paper says", ["paper", "computed", "holds"], body)


def _claims() -> Iterator[tuple[str, str, bool]]:
    for claim in CLAIMS:
        position, velocity = cell_errors(claim.cell, np.array(claim.k_end)).T
        numbers = (" / ".join(f"{e:.2f}" for e in errors) for errors in (position, velocity))
        yield claim.text, "{} m, {} m/s".format(*numbers), bool(claim.holds(position, velocity))


def _trends(best: dict[str, IntArray]) -> Iterator[tuple[str, str, bool]]:
    low, high = best.values()
    falls = all(bool(np.all(np.diff(table, axis=a) <= 0)) for table in (low, high) for a in (0, 1))
    yield "k_end falls with T and sigma_v^2, rises with sigma_w^2", "", falls and bool(np.all(high >= low))
    spans = [int(np.ptp(table[:, 0])) for table in (low, high)]
    text = f"by {spans[0]} there, by {spans[1]} at sigma_w^2 = 400"
    yield "k_end changes most with sigma_v^2 at sigma_w^2 = 25, T = 0.5 s", text, spans[0] >= spans[1]
    change = (high - low)[0]
    text = f"by {change[1]} there, by {change[0]} at T = 0.5 s"
    yield "k_end changes most with sigma_w^2 at sigma_v^2 = 0.1, T = 1 s", text, bool(change[1] >= change.max())
    T, v, w = _exponents(best)
    text = f"k_end ~ T^{T:.2f} (sigma_v^2)^{v:.2f} (sigma_w^2)^{w:+.2f}"
    yield "T matters most, then sigma_v^2, then sigma_w^2", text, abs(T) > abs(v) > 1.2 * abs(w)


def _exponents(best: dict[str, IntArray]) -> tuple[float, float, float]:
    """Log-log regression of k_end on T, sigma_v^2 and sigma_w^2 over the cells with k_end > 3."""
    k = np.stack([*best.values()])
    w, v, T = np.meshgrid(np.array([*VARIANCES_W_M2.values()]), VARIANCES_V_M2S4, INTERVALS_S, indexing="ij")
    use = k > 3
    A = np.stack([np.ones(use.sum()), *(np.log(a[use]) for a in (T, v, w))], axis=1)
    _, *exponents = np.linalg.lstsq(A, np.log(k[use]), rcond=None)[0].tolist()
    return exponents[0], exponents[1], exponents[2]


def _losses_table() -> Table:
    """RMS errors over those of the Kalman filter, over all 120 cells: how good each kind of gains is."""
    sigma_w = np.sqrt([*VARIANCES_W_M2.values()])[:, None, None]
    sigma_v, dt_s = np.sqrt(VARIANCES_V_M2S4)[:, None], INTERVALS_S
    index = manoeuvring_index(dt_s, sigma_v, sigma_w)
    best, k = np.stack([best_k_end(v) for v in VARIANCES_W_M2.values()]), np.arange(1, PLOTS + 1)
    steady = [
        np.where(k > 2, s[..., None], g) for s, g in zip(steady_gains(index), held_gains(np.array(2)), strict=True)
    ]
    kinds = {
        "best k_end": held_gains(best),
        "k_end by rule": held_gains(k_end_rule(index)),
        "greater of decreasing and steady": combined_gains(k, index[..., None]),
        "steady from plot 3 on": (steady[0], steady[1]),
    }
    least = rms_errors(kalman_gains(PLOTS, index), dt_s, sigma_v, sigma_w)
    body = []
    for name, gains in kinds.items():
        ratio = (rms_errors(gains, dt_s, sigma_v, sigma_w) / least).reshape(-1, 2)
        body.append([name, *(f"{v:.4f}" for a in range(2) for v in (ratio[:, a].mean(), ratio[:, a].max()))])
    header = ["gains", "position, mean", "position, worst", "velocity, mean", "velocity, worst"]
    return Table("RMS error over the Kalman filter's, all 120 cells", header, body)


def _notes(picked: dict[Cell, IntArray]) -> Iterator[str]:
    small, large, quiet = Cell(25, 0.1, 0.5), Cell(400, 0.1, 1), Cell(25, 0.1, 1)
    yield (
        "In units of sigma_w and sigma_w / T everything depends on lambda = T^2 sigma_v / sigma_w alone, and so does "
        "the best k_end. The paper does not use this."
    )
    j = judged(small)
    yield (
        f"({small}) and ({large}) have the same lambda, {small.lambda_:.4f}, and therefore the same best k_end. The "
        f"paper prints {PRINTED[small]} and {PRINTED[large]}: both cannot be matched. The least error is at {j.best}, "
        f"and from {j.low} to {j.high} it is at most 5 % larger."
    )
    j = judged(quiet)
    yield f"({quiet}): the paper's {PRINTED[quiet]} costs {100 * j.loss:.1f} % against the best {j.best}."
    P = error_covariances(*held_gains(np.array([7, 26])), *small.physics)
    more = -np.diff(np.sqrt(np.diagonal(P[:, -1], axis1=-2, axis2=-1)), axis=0)[0]
    yield (
        f"Fig. 4 says that 7 costs 1.5 m and 1 m/s more than 26 in ({small}); even once settled it is {more[0]:.2f} m "
        f"and {more[1]:.2f} m/s."
    )
    if picked:
        spread = "; ".join(f"({cell}) {k.min()} to {k.max()}, std {k.std():.1f}" for cell, k in picked.items())
        yield f"What the paper's procedure picks when it is repeated with new noise: {spread}."
    yield (
        "Not comparable: the tables are pictures, and the text names eight of their 120 cells; where position, "
        "velocity and smoothness disagree, the paper chooses by eye."
    )
    yield (
        "Slips of the paper: 600 m/s for 0.5 s is 300 m, not 30 m, and for 1 s 600 m, not 60 m; sigma_w^2 is in m^2, "
        "once printed m^2/s^4; the English caption of fig. 7 says T = 2 s for 6 s."
    )


def _k_end_curve() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Indices (n,), best k_end with the ends of its 5 % range (n, 3), and the rule (n,)."""
    index = np.geomspace(0.003, 40.0, 400)
    rms = rms_errors(held_gains(K_END), 1.0, index[:, None], 1.0)[..., 0]
    good = rms <= 1.05 * rms.min(axis=1, keepdims=True)
    best = np.stack(
        [K_END[rms.argmin(axis=1)], K_END[good.argmax(axis=1)], K_END[::-1][good[:, ::-1].argmax(axis=1)]], 1
    )
    return index, best.astype(float), k_end_rule(index).astype(float)


def _printed_points() -> list[Printed]:
    return [Printed(cell.label, cell.lambda_, k_end) for cell, k_end in PRINTED.items()]


def _error_curves() -> list[Curves]:
    """Standard deviations over the plots where the paper shows such curves, beside the Kalman filter."""
    shown = {
        "Fig. 2": (Cell(25, 10, 0.5), (4, 7, 10, 13)),
        "Fig. 4 a, b": (Cell(25, 0.1, 0.5), (7, 21, 26)),
        "Fig. 4 c, d": (Cell(25, 35, 0.5), (5, 7)),
        "Fig. 6": (Cell(25, 15, 2), (2, 3)),
    }
    found = []
    for figure, (cell, k_ends) in shown.items():
        both = zip(held_gains(np.array(k_ends)), kalman_gains(PLOTS, cell.lambda_), strict=True)
        alpha, beta = (np.concatenate([ours, best[None]]) for ours, best in both)
        sigma = np.sqrt(np.diagonal(error_covariances(alpha, beta, *cell.physics), axis1=-2, axis2=-1))
        names = [rf"$k_\mathrm{{end}}$ = {k}" for k in k_ends]
        found.append(Curves(f"{figure}: {cell.label}", [*names, "Kalman filter"], sigma))
    return found
