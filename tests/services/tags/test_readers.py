"""Readers that come, move and go; names of tags and their rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymap3d
import pytest

from trackmesh.protocol.messages import Geodetic, SensorInfo
from trackmesh.services.tags.readers import Readers
from trackmesh.services.tags.roll import Roll


def reader(name: str, *place: float, **more: Any) -> SensorInfo:
    fields: dict[str, Any] = {"site_enu_m": list(place)} if place else {}
    fields |= {"kind": "ranging", "period_s": 0.1, "p_detect": 0.9, "max_range_m": 30.0, "sigma": {"range_m": 0.5}}
    return SensorInfo(sensor_id=name, **fields | more)


def test_readers_have_rows() -> None:
    readers = Readers(None, None, 2.0)
    assert readers.add(reader("a", 1.0, 2.0, 3.0)) and readers.add(reader("b", 4.0, 5.0, 6.0, sigma={}))
    assert not readers.add(reader("a", 1.0, 2.0, 3.0))
    assert readers.rows(["b", "x", "a"]).tolist() == [1, -1, 0]
    assert readers.place.tolist() == [[1.0, 2.0, 0.0], [4.0, 5.0, 0.0]]
    assert readers.variance.tolist() == [0.25, 4.0]


def test_heights_count_where_that_of_the_tags_is_known() -> None:
    readers = Readers(None, 1.2, 1.0)
    readers.add(reader("a", 1.0, 2.0, 3.0))
    assert readers.place[0].tolist() == pytest.approx([1.0, 2.0, 1.8])


def test_a_reader_that_moves_gets_a_row_of_its_own() -> None:
    readers = Readers(None, None, 1.0)
    readers.add(reader("a", 0.0, 0.0, 0.0))
    readers.add(reader("a", 9.0, 0.0, 0.0))
    assert readers.rows(["a"]).tolist() == [1]
    assert readers.names == ["a", "a"] and readers.place[:, 0].tolist() == [0.0, 9.0]


def test_a_reader_may_go() -> None:
    readers = Readers(None, None, 1.0)
    readers.add(reader("a", 0.0, 0.0, 0.0))
    assert readers.drop("a") and not readers.drop("a")
    assert readers.rows(["a"]).tolist() == [-1]
    readers.add(reader("a", 0.0, 0.0, 0.0))
    assert readers.rows(["a"]).tolist() == [1]


def test_geodetic_readers_stand_in_the_plane_of_the_first() -> None:
    readers = Readers(None, None, 1.0)
    first = Geodetic(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0)
    second = Geodetic(latitude_deg=48.0003, longitude_deg=11.0004, height_m=502.0)
    readers.add(reader("a", site=first))
    readers.add(reader("b", site=second))
    assert readers.origin == first
    east, north, _ = pymap3d.geodetic2enu(48.0003, 11.0004, 502.0, 48.0, 11.0, 500.0)
    np.testing.assert_allclose(readers.place, [[0.0, 0.0, 0.0], [east, north, 0.0]], atol=1e-9)


def test_rows_of_tags_serve_again() -> None:
    roll = Roll(3)
    assert roll.rows(["x", "y", "x"]).tolist() == [0, 1, 0]
    roll.release(np.array([0]))
    assert roll.rows(["z", "y"]).tolist() == [0, 1]
    assert roll.names == ["z", "y"] and len(roll) == 2 == roll.size


def test_there_are_no_more_tags_than_there_may_be() -> None:
    roll = Roll(2)
    assert roll.rows(["a", "b", "c", "a"]).tolist() == [0, 1, -1, 0]
    roll.release(np.array([1]))
    assert roll.rows(["c", "d"]).tolist() == [1, -1]
