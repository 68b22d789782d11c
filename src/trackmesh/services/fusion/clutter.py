"""False plots: how many a look and square metre, over all and area by area.

Counted are the plots that no confirmed track took; at a cold start these are all, so that nothing is confirmed too
easily. The whole is an exponential mean over the last looks. An area, one cell of a square grid over the coverage,
shrinks towards the whole: with n plots counted in a cell of exposure E (area times looks, both forgotten
exponentially), lambda = (a + n) / (a / lambda_whole + E): the mean of a gamma prior of ``a`` plots after Poisson
counts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.estimation.plots import Plots

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Within = Callable[[FloatArray], BoolArray]
"""Which of points (n, 2) are meant."""

_LOOKS_REMEMBERED = 5.0
_LOOKS_REMEMBERED_BY_CELLS = 30.0
_CELLS = 24
_PRIOR_PLOTS = 4.0
_POINTS = 8


class Clutter:
    """Of one sensor in one layer.

    Args:
        site: (2,) middle of the coverage; None where it is not known, then there are no areas.
        max_range_m: radius of the coverage.
        declared: density that the sensor declares, 1/m^2, where it does.
        areas: whether to keep them.
    """

    def __init__(self, site: FloatArray | None, max_range_m: float, declared: float | None, areas: bool) -> None:
        self._max_range_m = max_range_m
        self._area_m2 = float(np.pi * max_range_m**2)
        self._floor = 0.5 / self._area_m2
        self._plots = (declared or 0.0) * self._area_m2
        self._area_seen_m2 = self._area_m2 if declared else 0.0
        self._corner = np.zeros(2) if site is None else site - max_range_m
        self._cell_m = 2.0 * max_range_m / _CELLS
        self._cells = np.zeros((_CELLS, _CELLS))
        self._looks = 0.0
        self._placed = site is not None
        self._within: Within | None = None
        self._covered_m2 = _covered(_CELLS) * self._cell_m**2 if areas and site is not None else None

    def add(self, plots: Plots, explained: BoolArray, share_of_look: float) -> None:
        """Count the unexplained plots of a batch that was this share of a whole look."""
        keep = np.exp(-share_of_look / _LOOKS_REMEMBERED)
        self._plots = self._plots * keep + len(plots) - int(explained.sum())
        self._area_seen_m2 = self._area_seen_m2 * keep + share_of_look * self._area_m2
        if self._covered_m2 is not None:
            keep = np.exp(-share_of_look / _LOOKS_REMEMBERED_BY_CELLS)
            self._looks = self._looks * keep + share_of_look
            _count(self._cells, keep, self._corner, self._cell_m, plots, explained)

    def follow(self, site: FloatArray) -> None:
        """The middle of the coverage has moved: what was counted stays where it was, as far as it is still covered."""
        if self._covered_m2 is None:
            return
        steps = np.rint((site - self._max_range_m - self._corner) / self._cell_m).astype(np.int64)
        if not steps.any():
            return
        self._corner = self._corner + steps * self._cell_m
        if self._within is not None:
            self._measure()
        old, self._cells = self._cells, np.zeros((_CELLS, _CELLS))
        (to_i, from_i), (to_j, from_j) = (_overlap(int(step)) for step in steps)
        self._cells[to_i, to_j] = old[from_i, from_j]

    def limit(self, within: Within | None) -> None:
        """Plots come from a part of the coverage only; what was counted area by area is counted anew."""
        if not self._placed:
            return
        self._within = within
        self._cells[:], self._looks = 0.0, 0.0
        self._measure()

    def _measure(self) -> None:
        """How large the coverage is, or what is left of it."""
        shares, area_m2 = _covered(_CELLS), float(np.pi * self._max_range_m**2)
        if self._within is not None:
            shares = shares_within(self._corner, self._cell_m, self._within)
            area_m2 = max(float(shares.sum()), 1.0) * self._cell_m**2
        self._area_m2, self._floor = area_m2, 0.5 / area_m2
        if self._covered_m2 is not None:
            self._covered_m2 = shares * self._cell_m**2

    def whole(self, plots_now: int = 0, share_of_look: float = 1.0) -> float:
        """The density over all, 1/m^2; before any batch was counted, that of the batch at hand."""
        if self._area_seen_m2 == 0.0:
            return max(plots_now / (share_of_look * self._area_m2), self._floor)
        return max(self._plots / self._area_seen_m2, self._floor)

    def at(self, plots: Plots, share_of_look: float) -> FloatArray:
        """The density (m,) where each plot of a batch lies."""
        whole = self.whole(len(plots), share_of_look)
        if self._covered_m2 is None:
            return np.full(len(plots), whole)
        return _densities(self._cells, self._covered_m2, self._looks, whole, self._corner, self._cell_m, plots)

    def kept(self) -> dict[str, npt.NDArray[np.float64]]:
        """What is to be known after a restart."""
        whole = np.array([self._plots, self._area_seen_m2, self._looks])
        return {"whole": whole, "cells": self._cells.copy(), "corner": self._corner.copy()}

    def restore(self, arrays: dict[str, npt.NDArray[np.float64]]) -> None:
        """Go on with what ``kept`` gave."""
        self._plots, self._area_seen_m2, self._looks = arrays["whole"].tolist()
        self._cells[:] = arrays["cells"]
        self._corner[:] = arrays["corner"]


def _overlap(step: int) -> tuple[slice, slice]:
    """Cells of a row moved on by ``step`` that lie in the old row, and which those were."""
    kept = max(_CELLS - abs(step), 0)
    ahead, behind = slice(max(step, 0), max(step, 0) + kept), slice(max(-step, 0), max(-step, 0) + kept)
    return behind, ahead


def _covered(cells: int) -> FloatArray:
    """Share of each cell that a circle through the middles of the sides covers, (cells, cells)."""
    fine = (np.arange(cells * _POINTS) + 0.5) / (cells * _POINTS) * 2.0 - 1.0
    inside = fine[:, None] ** 2 + fine**2 < 1.0
    return np.asarray(inside.reshape(cells, _POINTS, cells, _POINTS).mean(axis=(1, 3)))


def shares_within(corner: FloatArray, cell_m: float, within: Within) -> FloatArray:
    """As ``_covered``, of what lies ``within`` alone; the grid has its lower left corner (2,) there."""
    fine = (np.arange(_CELLS * _POINTS) + 0.5) / (_CELLS * _POINTS) * 2.0 - 1.0
    east, north = np.meshgrid(fine, fine, indexing="ij")
    inside = east**2 + north**2 < 1.0
    points = corner + (np.stack([east, north], axis=-1)[inside] + 1.0) * (0.5 * _CELLS * cell_m)
    inside[inside] = within(points)
    return np.asarray(inside.reshape(_CELLS, _POINTS, _CELLS, _POINTS).mean(axis=(1, 3)))


@kernel
def _cell(value: float, corner: float, cell_m: float) -> int:
    return int(min(max((value - corner) // cell_m, 0.0), _CELLS - 1.0))


@kernel
def _count(
    cells: FloatArray, keep: float, corner: FloatArray, cell_m: float, plots: Plots, explained: BoolArray
) -> None:
    for i in range(_CELLS):
        for j in range(_CELLS):
            cells[i, j] *= keep
    for k in range(len(plots)):
        if not explained[k]:
            z = plots[k].z
            cells[_cell(z[0], corner[0], cell_m), _cell(z[1], corner[1], cell_m)] += 1.0


@kernel
def _densities(
    cells: FloatArray,
    covered_m2: FloatArray,
    looks: float,
    whole: float,
    corner: FloatArray,
    cell_m: float,
    plots: Plots,
) -> FloatArray:
    out = np.empty(len(plots))
    for k in range(len(plots)):
        z = plots[k].z
        i, j = _cell(z[0], corner[0], cell_m), _cell(z[1], corner[1], cell_m)
        # A cell at the rim counts as half covered at least: what little falls there would weigh too much.
        exposure = looks * max(covered_m2[i, j], 0.5 * cell_m * cell_m)
        out[k] = (_PRIOR_PLOTS + cells[i, j]) / (_PRIOR_PLOTS / whole + exposure)
    return out
