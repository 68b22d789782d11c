"""Areas of units: Voronoi cells of their centres or convex polygons, as signed depths of points.

A cell is an intersection of half-planes; its depth at a point is the least signed distance to their borders, positive
inside. With centres c, the depth at p in the cell of c_i is the minimum over j of
(|p - c_j|^2 - |p - c_i|^2) / (2 |c_j - c_i|), one matrix product (F. Aurenhammer, "Voronoi diagrams", ACM Computing
Surveys 23 (1991)).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

_SAME_PLACE_M = 1.0


class Cell(NamedTuple):
    """An intersection of half-planes {p: normal . p + offset >= 0}: unit normals (k, 2), offsets (k,) in metres."""

    normal: FloatArray
    offset: FloatArray

    def depth(self, points: FloatArray) -> FloatArray:
        """Signed distances (n,) of points (n, 2) to the nearest border line; infinite where there is none."""
        if not len(self.offset):
            return np.full(len(points), np.inf)
        return np.asarray((points @ self.normal.T + self.offset).min(axis=1))


EVERYWHERE = Cell(np.empty((0, 2)), np.empty(0))
NOWHERE = Cell(np.zeros((1, 2)), np.array([-np.inf]))


class Polygon(NamedTuple):
    """A convex polygon: its corners (k, 2), and the half-planes whose intersection it is."""

    corners: FloatArray
    cell: Cell

    def depth(self, points: FloatArray) -> FloatArray:
        """Signed distances (n,) of points (n, 2) to its edge, positive inside."""
        depth = self.cell.depth(points)
        outside = depth < 0.0
        depth[outside] = -_distance(points[outside], self.corners)
        return depth


class Area(NamedTuple):
    """What is deeper in one cell than in any of the others; all of the cell where there are no others."""

    cell: Cell | Polygon
    others: tuple[Cell | Polygon, ...] = ()

    @property
    def everywhere(self) -> bool:
        """Whether it is the whole plane."""
        return isinstance(self.cell, Cell) and not len(self.cell.offset)

    def depth(self, points: FloatArray) -> FloatArray:
        """Signed depths (n,) of points (n, 2): half of what they are deeper in this cell than in any other."""
        if not self.others:
            return self.cell.depth(points)
        deepest = np.maximum.reduce([cell.depth(points) for cell in self.others])
        return np.asarray(0.5 * (self.cell.depth(points) - deepest))


class Place(NamedTuple):
    """What a unit is told to look after.

    Attributes:
        centre_m: (2,) of its Voronoi cell; of a polygon, the mean of its corners.
        polygon_m: (k, 2) corners of a convex polygon, or None for the Voronoi cell.
    """

    centre_m: FloatArray
    polygon_m: FloatArray | None = None

    def same(self, other: Place) -> bool:
        """Whether both are one area."""
        if (self.polygon_m is None) != (other.polygon_m is None):
            return False
        if self.polygon_m is not None and other.polygon_m is not None:
            return self.polygon_m.shape == other.polygon_m.shape and bool(
                np.allclose(self.polygon_m, other.polygon_m, atol=_SAME_PLACE_M)
            )
        return bool(np.hypot(*(self.centre_m - other.centre_m)) < _SAME_PLACE_M)


def voronoi(centre: FloatArray, others: Sequence[FloatArray]) -> Cell:
    """The Voronoi cell of a centre (2,) among others; one at the same place does not count."""
    if not len(others):
        return EVERYWHERE
    c = np.array(others)
    between = centre - c
    apart = np.hypot(between[:, 0], between[:, 1])
    far = apart >= _SAME_PLACE_M
    normal = between[far] / apart[far, None]
    middle = 0.5 * (c[far] + centre)
    return Cell(normal, -np.einsum("ij,ij->i", normal, middle))


def convex(corners: FloatArray) -> Polygon:
    """A convex polygon by its corners (k, 2), in either direction.

    Raises:
        ValueError: it has fewer than three corners, or is not convex.
    """
    step = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(step[:, 0], step[:, 1])
    following = np.roll(step, -1, axis=0)
    turn = step[:, 0] * following[:, 1] - step[:, 1] * following[:, 0]
    if len(corners) < 3 or (length == 0.0).any() or not ((turn > 0.0).all() or (turn < 0.0).all()):
        raise ValueError("a polygon must be convex, with three corners or more, each in its turn")
    way = np.arctan2(step[:, 1], step[:, 0])
    turned = np.abs(np.angle(np.exp(1j * (np.roll(way, -1) - way)))).sum()
    if turned > 2.0 * np.pi + 1e-6:
        raise ValueError("a polygon must go round once")
    left = np.sign(turn[0])
    normal = left * np.stack([-step[:, 1], step[:, 0]], axis=1) / length[:, None]
    return Polygon(corners, Cell(normal, -np.einsum("ij,ij->i", normal, corners)))


def _distance(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Distances (n,) of points (n, 2) to the nearest edge between corners (k, 2)."""
    edge = np.roll(corners, -1, axis=0) - corners
    off = points[:, None] - corners
    along = np.clip((off * edge).sum(axis=2) / (edge * edge).sum(axis=1), 0.0, 1.0)
    left = off - along[:, :, None] * edge
    return np.asarray(np.hypot(left[:, :, 0], left[:, :, 1]).min(axis=1))


def area_of(place: Place, owners: Sequence[Place]) -> Area:
    """What belongs to a unit while those at the places ``owners`` (without itself) own areas too.

    Without others it is everything. Voronoi cells fill the plane by themselves. Of polygons, what lies in none, as that
    of a unit which is gone, belongs to the nearest one, and what lies in several to the one in which it is deepest.
    """
    if not owners:
        return Area(EVERYWHERE)
    every = [place, *owners]
    cells = [_cell(one, every[:k] + every[k + 1 :]) for k, one in enumerate(every)]
    polygons = any(one.polygon_m is not None for one in every)
    return Area(cells[0], tuple(cells[1:]) if polygons else ())


def _cell(place: Place, others: Sequence[Place]) -> Cell | Polygon:
    if place.polygon_m is not None:
        return convex(place.polygon_m)
    return voronoi(place.centre_m, [one.centre_m for one in others])
