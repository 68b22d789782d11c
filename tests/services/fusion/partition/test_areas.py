"""Areas: depths against brute force, polygons, what falls to whom when a unit dies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trackmesh.services.fusion.partition.areas import EVERYWHERE, NOWHERE, Area, Place, area_of, convex, voronoi

coordinates = st.floats(-1e5, 1e5)
points = st.tuples(coordinates, coordinates)
SQUARE = np.array([[0.0, 0.0], [10e3, 0.0], [10e3, 10e3], [0.0, 10e3]])


def places(*centres: tuple[float, float]) -> list[Place]:
    return [Place(np.array(centre)) for centre in centres]


@given(st.lists(points, min_size=2, max_size=6), st.lists(points, min_size=1, max_size=20))
def test_a_voronoi_cell_is_where_its_centre_is_nearest(
    centres: list[tuple[float, float]], at: list[tuple[float, float]]
) -> None:
    c, p = np.array(centres), np.array(at)
    apart = np.hypot(*(c[1:] - c[0]).T)
    if (apart < 2.0).any():
        return
    depth = voronoi(c[0], list(c[1:])).depth(p)
    d2 = ((p[:, None] - c) ** 2).sum(axis=2)
    expected = ((d2[:, 1:] - d2[:, :1]) / (2.0 * apart)).min(axis=1)
    np.testing.assert_allclose(depth, expected, atol=1e-3)


@given(st.lists(points, min_size=2, max_size=5, unique=True), points)
def test_every_point_belongs_to_one_unit(centres: list[tuple[float, float]], at: tuple[float, float]) -> None:
    c = np.array(centres)
    apart = np.hypot(*(c[:, None] - c).transpose(2, 0, 1)) + 10.0 * np.eye(len(c))
    if (apart < 2.0).any():
        return
    every = places(*centres)
    depths = [area_of(one, every[:k] + every[k + 1 :]).depth(np.array([at]))[0] for k, one in enumerate(every)]
    assert max(depths) > -1e-3
    assert sum(depth > 1e-3 for depth in depths) <= 1


def test_a_unit_alone_owns_everything() -> None:
    assert area_of(places((5.0, 5.0))[0], []).depth(np.zeros((1, 2)))[0] == np.inf
    assert EVERYWHERE.depth(np.zeros((3, 2))).shape == (3,)


@pytest.mark.parametrize("corners", [SQUARE, SQUARE[::-1]])
def test_a_polygon_is_deep_in_its_middle_either_way_round(corners: np.ndarray) -> None:
    at = np.array([[5e3, 5e3], [1e3, 5e3], [-2e3, 5e3], [11e3, 5e3]])
    np.testing.assert_allclose(convex(corners).depth(at), [5e3, 1e3, -2e3, -1e3])


def test_what_is_no_convex_polygon_is_refused() -> None:
    star = SQUARE[[0, 2, 1, 3]]
    pentagram = np.array([[np.sin(k * 4 * np.pi / 5), np.cos(k * 4 * np.pi / 5)] for k in range(5)])
    for corners in (SQUARE[:2], star, pentagram, SQUARE[[0, 0, 1, 2]], np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])):
        with pytest.raises(ValueError, match="polygon"):
            convex(corners)


def test_the_cell_of_a_dead_unit_falls_to_its_neighbours() -> None:
    a, b, c = places((0.0, 0.0), (10e3, 0.0), (20e3, 0.0))
    at = np.array([[9e3, 0.0], [11e3, 0.0]])
    assert (area_of(a, [b, c]).depth(at) < 0.0).all()
    np.testing.assert_array_equal(area_of(a, [c]).depth(at) > 0.0, [True, False])


def rectangles(n: int) -> list[Place]:
    """Side by side from west to east."""
    return [Place(at.mean(axis=0), at) for at in (SQUARE + np.array([k * 10e3, 0.0]) for k in range(n))]


def test_polygons_side_by_side_are_as_deep_as_they_are_far_from_their_border() -> None:
    left, right = rectangles(2)
    at = np.array([[7e3, 5e3], [9e3, 5e3], [12e3, 5e3]])
    np.testing.assert_allclose(area_of(left, [right]).depth(at), [3e3, 1e3, -2e3])
    np.testing.assert_allclose(area_of(right, [left]).depth(at), [-3e3, -1e3, 2e3])


def test_what_lies_in_no_polygon_belongs_to_the_nearest_and_what_lies_in_two_to_the_deeper() -> None:
    left, _, right = rectangles(3)
    at = np.array([[12e3, 5e3], [18e3, 5e3], [5e3, -40e3], [25e3, 60e3]])
    np.testing.assert_array_equal(area_of(left, [right]).depth(at) >= 0.0, [True, False, True, False])
    np.testing.assert_array_equal(area_of(right, [left]).depth(at) >= 0.0, [False, True, False, True])
    wide = Place(SQUARE.mean(axis=0), SQUARE * np.array([1.5, 1.0]))
    inside_both = np.array([[11e3, 5e3], [14e3, 5e3]])
    middle = rectangles(2)[1]
    np.testing.assert_array_equal(area_of(wide, [middle]).depth(inside_both) > 0.0, [True, False])


@given(st.integers(2, 5), points)
def test_every_point_belongs_to_one_polygon(n: int, at: tuple[float, float]) -> None:
    every = rectangles(n)
    depths = [area_of(one, every[:k] + every[k + 1 :]).depth(np.array([at]))[0] for k, one in enumerate(every)]
    assert max(depths) > -1e-3
    assert sum(depth > 1e-3 for depth in depths) <= 1


def test_nowhere_is_nowhere_deep() -> None:
    assert Area(NOWHERE).depth(np.array([[0.0, 0.0], [1e6, 1e6]])).tolist() == [-np.inf, -np.inf]
    assert not Area(NOWHERE).everywhere and Area(EVERYWHERE).everywhere
