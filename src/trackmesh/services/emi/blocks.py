"""Samples averaged in cells: what a very large scan, or one sampled far more densely than it is deep, is fitted by."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from trackmesh.services.emi.kernels import FloatArray, IntArray
from trackmesh.services.emi.sensor import Coils

MOST_SAMPLES = 20_000
"""Larger scans are averaged, unless a cell is given."""
WANTED_CELLS = 10_000


class Blocks(NamedTuple):
    """Which cell each of W samples belongs to, and how many cells there are."""

    cell: IntArray
    n_cells: int


def blocks_of(positions_m: FloatArray, cell_m: float | None) -> Blocks | None:
    """Square cells (horizontally) of ``cell_m``; None where nothing is to be averaged."""
    if cell_m is None:
        if len(positions_m) <= MOST_SAMPLES:
            return None
        dx, dy = np.ptp(positions_m[:, :2], axis=0)
        cell_m = max(sqrt(dx * dy / WANTED_CELLS), max(dx, dy) / WANTED_CELLS, 1e-6)
    place = np.floor((positions_m[:, :2] - positions_m[:, :2].min(0)) / cell_m).astype(np.int64)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    return Blocks(cell.ravel().astype(np.int64), int(cell.max()) + 1)


def averaged_coils(coils: Coils, blocks: Blocks) -> Coils:
    """The geometry of the cells: mean positions and axes."""
    axis = coils.tx_axis if np.ndim(coils.tx_axis) == 1 else _means(coils.tx_axis, blocks)
    rotation = None
    if coils.rotation is not None:
        left, _, right = np.linalg.svd(_means(coils.rotation.reshape(-1, 9), blocks).reshape(-1, 3, 3))
        rotation = left @ right
    return coils._replace(positions_m=_means(coils.positions_m, blocks), tx_axis=axis, rotation=rotation)


def averaged_field(field_t: FloatArray, sigma_t: FloatArray | float, blocks: Blocks) -> tuple[FloatArray, FloatArray]:
    """Weighted means of a scan (C, W, K) over the cells, NaN where nothing is; and their standard deviations.

    ``sigma_t`` is that of the samples, broadcast against the field.
    """
    n_c, _, n_k = field_t.shape
    there = np.isfinite(field_t)
    weight = np.where(there, np.broadcast_to(sigma_t, field_t.shape) ** -2.0, 0.0)
    values = np.where(there, field_t, 0.0) * weight
    total, sums = (
        np.stack([[_sums(x[c, :, k], blocks) for k in range(n_k)] for c in range(n_c)]).transpose(0, 2, 1)
        for x in (weight, values)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return sums / total, np.where(total > 0.0, total**-0.5, 1.0)


def _sums(x: FloatArray, blocks: Blocks) -> FloatArray:
    return np.bincount(blocks.cell, weights=x, minlength=blocks.n_cells).astype(np.float64)


def _means(rows: FloatArray, blocks: Blocks) -> FloatArray:
    counts = np.bincount(blocks.cell, minlength=blocks.n_cells)
    return np.stack([_sums(column, blocks) / counts for column in np.asarray(rows, np.float64).T], 1)
