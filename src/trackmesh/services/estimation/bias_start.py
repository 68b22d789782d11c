"""Global start of registration: large biases of two sensors, from tracks of which nobody knows which belong together.

Pairs of tracks whose velocities agree are candidates. Each candidate, with each of a grid of biases of sensor b, tells
the biases of sensor a exactly: a Hough transform (Duda and Hart 1972) over the biases of both. Its highest cells are
refined by robust least squares over all candidates, and the one that explains the most tracks one to one is taken, if
it explains clearly more than the best that can be found among the candidates that it does not use.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import assignment, bias
from trackmesh.services.estimation.bias import Geometry, Tracks

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_SLACK = (0.25, 0.125, 0.05, 0.0, 0.0)
_NOTHING = 1e-300


class StartRules(NamedTuple):
    """Constants of the global start.

    Attributes:
        limit_range_m, limit_azimuth_rad, limit_position_m: biases that are sought; little larger ones may be found.
        cells: cells of the grid from minus to plus the limit, an odd number.
        seeds: cells that are refined.
        velocity_gate, position_gate: largest squared Mahalanobis distances of candidates and of matches, two values.
        turn: how far biases may change a velocity, as a share of it.
        most_tracks: tracks of each sensor that are looked at: the fastest, which are the same at both.
        most: candidates that are looked at, those that agree best.
        least_matches, least_share: fewer are no proof, nor is a smaller share of the tracks that have candidates.
        most_rivals: the best other solution must not have more than this share of the matches.
    """

    limit_range_m: float = 2_000.0
    limit_azimuth_rad: float = float(np.deg2rad(2.0))
    limit_position_m: float = 2_000.0
    cells: int = 11
    seeds: int = 12
    velocity_gate: float = 9.2
    position_gate: float = 11.8
    turn: float = 0.1
    most_tracks: int = 250
    most: int = 2_000
    least_matches: int = 6
    least_share: float = 0.35
    most_rivals: float = 0.5

    def limit(self, polar: bool) -> FloatArray:
        """Largest biases (2,) of a sensor."""
        return np.array([self.limit_range_m, self.limit_azimuth_rad] if polar else [self.limit_position_m] * 2)


class BiasStart(NamedTuple):
    """What a global start found.

    Attributes:
        found: whether it can be relied upon.
        reason: in one sentence, why not; empty if found.
        a, b: (k,) rows of the tracks of a and b that it makes one target each.
        bias_a, bias_b: (2,) of the sensors.
        rivals: matches of the best other solution.
    """

    found: bool
    reason: str
    a: IntArray
    b: IntArray
    bias_a: FloatArray
    bias_b: FloatArray
    rivals: int


class _Search(NamedTuple):
    """What is searched: limits (4,) of the biases, and pairs of tracks row by row with their numbers (m,)."""

    rules: StartRules
    limits: FloatArray
    row_a: IntArray
    row_b: IntArray
    a: Tracks
    b: Tracks

    def only(self, kept: BoolArray) -> _Search:
        """The same with some of the pairs."""
        a, b = self.a, self.b
        return self._replace(
            row_a=self.row_a[kept],
            row_b=self.row_b[kept],
            a=Tracks(a.geometry, a.x[kept], a.P[kept]),
            b=Tracks(b.geometry, b.x[kept], b.P[kept]),
        )


def global_start(
    a: Tracks, b: Tracks, rules: StartRules | None = None, *, reference_a: bool = False, reference_b: bool = False
) -> BiasStart:
    """Biases of two sensors up to the limits of the rules, from their local tracks (n, 4) at one time.

    Where only a difference of biases is observable, that with the smallest biases is given; a reference has none.
    """
    rules = rules or StartRules()
    if reference_a and not reference_b:
        # The biases of the first sensor are voted for, those of the second are on the grid, where 0 is one cell.
        turned = global_start(b, a, rules, reference_b=True)
        return turned._replace(a=turned.b, b=turned.a, bias_a=turned.bias_b, bias_b=turned.bias_a)
    limit_a, limit_b = rules.limit(a.geometry.polar), rules.limit(b.geometry.polar)
    limits = np.concatenate([np.zeros(2) if reference_a else limit_a, np.zeros(2) if reference_b else limit_b])
    search = _candidates(a, b, limits, rules)
    beta, used = _best(search)
    # The same search over the candidates that were not used tells what chance, or a pattern of targets, can do.
    _, rival = _best(search.only(~used))
    matches, rivals = int(used.sum()), int(rival.sum())
    possible = min(len(np.unique(search.row_a)), len(np.unique(search.row_b)))
    reason = ""
    if matches < max(rules.least_matches, rules.least_share * possible):
        reason = f"Only {matches} tracks match of {possible} that might."
    elif rivals > rules.most_rivals * matches:
        reason = f"Ambiguous: {matches} tracks match, and with other biases {rivals} others."
    return BiasStart(not reason, reason, search.row_a[used], search.row_b[used], beta[:2], beta[2:], rivals)


def _usable(tracks: Tracks, most: int) -> IntArray:
    """Rows of the fastest tracks that are finite and whose covariances are."""
    good = np.isfinite(tracks.x).all(axis=1) & np.isfinite(tracks.P).all(axis=(1, 2))
    good &= bias.positive_definite(tracks.P[:, :2, :2]) & bias.positive_definite(tracks.P[:, 2:, 2:])
    rows = np.flatnonzero(good)
    fastest = np.argsort(-(tracks.x[rows, 2:] ** 2).sum(axis=1), kind="stable")
    return np.sort(rows[fastest[:most]])


def _candidates(a: Tracks, b: Tracks, limits: FloatArray, rules: StartRules) -> _Search:
    """Pairs whose velocities agree, and whose positions do as far as biases within the limits allow."""
    rows_a, rows_b = _usable(a, rules.most_tracks), _usable(b, rules.most_tracks)
    xa, Pa, xb, Pb = a.x[rows_a, None], a.P[rows_a, None], b.x[rows_b], b.P[rows_b]
    turned = ((rules.turn * xa[..., 2:]) ** 2).sum(axis=-1)[..., None, None] * np.eye(2)
    dv = (xa - xb)[..., 2:, None]
    distance = (bias.whitened(Pa[..., 2:, 2:] + Pb[:, 2:, 2:] + turned, dv) ** 2).sum(axis=(-1, -2))
    spread = np.sqrt(np.trace(Pa[..., :2, :2] + Pb[:, :2, :2], axis1=-2, axis2=-1))
    reach = _reach(a.geometry, xa, limits[:2]) + _reach(b.geometry, xb, limits[2:]) + 3.0 * spread
    near = ((xa - xb)[..., :2] ** 2).sum(axis=-1) < reach * reach
    i, j = np.nonzero(near & (distance < rules.velocity_gate))
    if len(i) > rules.most:
        chosen = np.sort(np.argsort(distance[i, j], kind="stable")[: rules.most])
        i, j = i[chosen], j[chosen]
    i, j = rows_a[i], rows_b[j]
    of_a = Tracks(a.geometry, a.x[i, :2], a.P[i, :2, :2])
    of_b = Tracks(b.geometry, b.x[j, :2], b.P[j, :2, :2])
    return _Search(rules, limits, i, j, of_a, of_b)


def _reach(geometry: Geometry, x: FloatArray, limit: FloatArray) -> FloatArray:
    """How far biases within the limits can move tracks."""
    if not geometry.polar:
        return np.full(x.shape[:-1], np.hypot(limit[0], limit[1]))
    offset = x[..., :2] - geometry.site_m
    return np.asarray(limit[0] + limit[1] * np.hypot(offset[..., 0], offset[..., 1]))


def _best(search: _Search) -> tuple[FloatArray, BoolArray]:
    """Biases (4,) that explain the most candidates one to one, and which (m,) these are."""
    used = np.zeros(len(search.row_a), np.bool_)
    if not len(used):
        return np.zeros(4), used
    beta = _seeds(search)
    for share in _SLACK:
        beta = _refined(search, beta, share * max(search.limits[0], search.limits[2]))
    gate = search.rules.position_gate
    distance, _ = _fit(search, beta, 0.0)
    near = distance < gate
    count = np.minimum(_different(near, search.row_a), _different(near, search.row_b))
    # Of solutions with as many matches, the one that fits best.
    loose = np.where(near, distance, 0.0).sum(axis=1) / (gate * np.maximum(near.sum(axis=1), 1))
    k = int(np.argmax(count - 0.9 * loose))
    i, j = search.row_a[near[k]], search.row_b[near[k]]
    chosen = assignment.assign(
        i, j, 1.0 + gate - distance[k, near[k]], int(i.max(initial=-1)) + 1, int(j.max(initial=-1)) + 1
    )
    used[near[k]] = chosen[j] == i
    return beta[k], used


def _seeds(search: _Search) -> FloatArray:
    """The highest cells (k, 4) of the transform, each counted with its neighbours in the biases of a."""
    cells, limits = search.rules.cells, search.limits
    middle = (cells - 1) // 2
    side = [np.linspace(-limit, limit, cells) if limit else np.zeros(1) for limit in limits[2:]]
    grid = np.stack(np.meshgrid(*side, indexing="ij"), axis=-1).reshape(-1, 2)
    told = bias.told(search.a.geometry, search.a.x, bias.corrected(search.b.geometry, search.b.x, _with_time(grid)))
    step = np.maximum(limits[:2], _NOTHING) / middle
    cell = np.rint(told / step) + middle
    inside = ((cell >= 0) & (cell < cells)).all(axis=-1)
    at = np.nonzero(inside)[0], *cell[inside].astype(np.int64).T
    votes = np.zeros((len(grid), cells + 2, cells + 2))
    np.add.at(votes[:, 1:-1, 1:-1], at, _voice(search)[np.nonzero(inside)[1]])
    count = np.add.reduce([votes[:, i : i + cells, j : j + cells] for i in range(3) for j in range(3)])
    best = np.argsort(-count.ravel(), kind="stable")[: search.rules.seeds]
    of_b, i, j = np.unravel_index(best, count.shape)
    return np.concatenate([(np.stack([i, j], axis=1) - middle) * step, grid[of_b]], axis=1)


def _voice(search: _Search) -> FloatArray:
    """What each candidate counts in the vote: a track has one voice, however many candidates it is in."""
    return np.asarray(
        1.0 / np.maximum(np.bincount(search.row_a)[search.row_a], np.bincount(search.row_b)[search.row_b])
    )


def _with_time(beta: FloatArray) -> FloatArray:
    """Biases (k, 2) as (k, 1, 3), to go with candidates."""
    return np.pad(beta, ((0, 0), (0, 1)))[:, None]


def _fit(search: _Search, beta: FloatArray, slack_m: float) -> tuple[FloatArray, FloatArray]:
    """Squared distances (k, m) of candidates under biases (k, 4), and [residual, H] (k, m, 2, 5), whitened."""
    left, H = bias.residuals(search.a, _with_time(beta[:, :2]), search.b, _with_time(beta[:, 2:]))
    rows = np.concatenate([left[..., None], H[..., :2], H[..., 3:5]], axis=-1)
    rows = bias.whitened(search.a.P + search.b.P + slack_m**2 * np.eye(2), rows)
    return (rows[..., 0] ** 2).sum(axis=-1), rows


def _refined(search: _Search, beta: FloatArray, slack_m: float) -> FloatArray:
    """One step of least squares by the candidates near each solution, held by the limits as one sigma."""
    distance, rows = _fit(search, beta, slack_m)
    near = (distance < search.rules.position_gate)[..., None, None]
    flat = (rows * near).reshape(len(beta), -1, 5)
    free = search.limits > 0.0
    H = flat[..., 1:][..., free]
    normal = np.swapaxes(H, 1, 2) @ H + np.diag(search.limits[free] ** -2.0)
    right = np.swapaxes(H, 1, 2) @ (flat[..., :1] + H @ beta[:, free, None])
    result = beta.copy()
    result[:, free] = np.linalg.solve(normal, right)[..., 0]
    return result


def _different(near: BoolArray, rows: IntArray) -> IntArray:
    """How many different rows are near, for each of k solutions."""
    seen = np.zeros((len(near), int(rows.max()) + 1), np.bool_)
    k, m = np.nonzero(near)
    seen[k, rows[m]] = True
    return np.asarray(seen.sum(axis=1))
