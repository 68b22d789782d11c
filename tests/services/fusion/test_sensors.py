from __future__ import annotations

from typing import Any

import numpy as np
import pymap3d
import pytest
from tests.services.estimation.makers import unpacked
from tests.services.fusion.makers import GEODETIC, POLAR, FloatArray, batch, position_sensor, radar

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic
from trackmesh.services.fusion.sensors import Sensor

ORIGIN = Geodetic(latitude_deg=50.0, longitude_deg=8.0, height_m=100.0)
AWAY = Geodetic(latitude_deg=50.6, longitude_deg=9.1, height_m=300.0)
ORIGIN_DEG = (50.0, 8.0, 100.0)
AWAY_DEG = (50.6, 9.1, 300.0)


# --- placing plots ---


def polar(
    azimuth_deg: FloatArray, range_m: FloatArray, elevation_deg: FloatArray | None = None
) -> tuple[FloatArray, list[str]]:
    columns = [range_m, np.radians(azimuth_deg)]
    names = POLAR
    if elevation_deg is not None:
        columns, names = [*columns, np.radians(elevation_deg)], [*POLAR, "elevation_rad"]
    return np.stack(columns, axis=1), names


def by_pymap3d(azimuth_deg: FloatArray, elevation_deg: FloatArray, range_m: FloatArray) -> FloatArray:
    """East and north in the plane of the origin of plots of the radar that stands away from it."""
    xyz = pymap3d.aer2ecef(azimuth_deg, elevation_deg, range_m, *AWAY_DEG)
    return np.stack(pymap3d.ecef2enu(*xyz, *ORIGIN_DEG)[:2], axis=1)


AZIMUTHS = np.array([0.0, 45.0, 100.0, 190.0, 300.0, 359.9])
RANGES = np.array([10.0, 1e3, 20e3, 50e3, 110e3, 80e3])


def test_a_site_in_the_plane() -> None:
    sensor = Sensor(0, radar(east_m=1000.0, north_m=-500.0), None)
    z, R = sensor.plane(batch("north", 0.0, np.array([[2000.0, np.pi / 2]]), POLAR))
    np.testing.assert_allclose(z, [[3000.0, -500.0]], atol=1e-9)
    np.testing.assert_allclose(unpacked(R)[0], np.diag([50.0**2, (2000 * 1.5e-3) ** 2]), atol=1e-6)


def test_a_geodetic_site_away_from_the_origin() -> None:
    """To a millimetre: the plane of the site is shifted, turned and tilted against that of the system."""
    sensor = Sensor(0, radar(site_enu_m=None, site=AWAY), ORIGIN)
    values, names = polar(AZIMUTHS, RANGES)
    z, _ = sensor.plane(batch("north", 0.0, values, names))
    np.testing.assert_allclose(z, by_pymap3d(AZIMUTHS, np.zeros(6), RANGES), atol=1e-3)


def test_elevation_counts_in_the_tilted_plane() -> None:
    sensor = Sensor(0, radar(site_enu_m=None, site=AWAY), ORIGIN)
    elevation = np.array([0.0, 10.0, 20.0, 8.0, 5.0, 3.0])
    values, names = polar(AZIMUTHS, RANGES, elevation)
    z, _ = sensor.plane(batch("north", 0.0, values, names))
    np.testing.assert_allclose(z, by_pymap3d(AZIMUTHS, elevation, RANGES), atol=1e-3)


def test_covariances_turn_with_the_site() -> None:
    sensor = Sensor(0, radar(site_enu_m=None, site=AWAY), ORIGIN)
    step, at = 1e-6, np.array([100.0])
    values, names = polar(at, np.array([50e3]))
    _, R = sensor.plane(batch("north", 0.0, values, names))
    here = by_pymap3d(at, np.zeros(1), np.array([50e3]))[0]
    along = (by_pymap3d(at, np.zeros(1), np.array([50e3 + 1.0]))[0] - here) * 50.0
    across = (by_pymap3d(at + np.degrees(step), np.zeros(1), np.array([50e3]))[0] - here) / step * 1.5e-3
    np.testing.assert_allclose(unpacked(R)[0], np.outer(along, along) + np.outer(across, across), rtol=1e-4, atol=0.5)


def test_the_site_at_the_origin_is_the_plane() -> None:
    sensor = Sensor(0, radar(site_enu_m=None, site=ORIGIN), ORIGIN)
    plain = Sensor(1, radar(), None)
    values, names = polar(AZIMUTHS, RANGES)
    for a, b in zip(
        sensor.plane(batch("north", 0.0, values, names)), plain.plane(batch("north", 0.0, values, names)), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_positions_are_taken_as_they_are() -> None:
    sensor = Sensor(0, position_sensor(), None)
    z, R = sensor.plane(batch("ais", 0.0, np.array([[5.0, -7.0], [1e5, 3.0]])))
    assert z.tolist() == [[5.0, -7.0], [1e5, 3.0]]
    assert R.tolist() == [[900.0, 0.0, 900.0]] * 2


@pytest.mark.parametrize("height_m", [None, 0.0, 9000.0])
def test_geodetic_plots(height_m: float | None) -> None:
    info = position_sensor(sigma={"latitude_deg": 15.0, "longitude_deg": 25.0})
    sensor = Sensor(0, info, ORIGIN)
    place = [50.4, 7.2]
    columns = GEODETIC if height_m is None else [*GEODETIC, "height_m"]
    values = place if height_m is None else [*place, height_m]
    z, R = sensor.plane(batch("ais", 0.0, np.array([values]), columns))
    want = pymap3d.geodetic2enu(*place, height_m or 0.0, *ORIGIN_DEG)[:2]
    np.testing.assert_allclose(z[0], want, atol=1e-6)
    assert R.tolist() == [[625.0, 0.0, 225.0]]  # longitude is east


def test_variances_of_the_batch_come_before_sigma() -> None:
    sensor = Sensor(0, position_sensor(), None)
    _, R = sensor.plane(batch("ais", 0.0, np.zeros((1, 2)), variances=np.array([[4.0, 9.0]])))
    assert R.tolist() == [[4.0, 0.0, 9.0]]


def test_range_rate_is_no_elevation() -> None:
    sensor = Sensor(0, radar(), None)
    z, _ = sensor.plane(batch("north", 0.0, np.array([[1e4, 0.0, 1.2]]), [*POLAR, "range_rate_mps"]))
    np.testing.assert_allclose(z, [[0.0, 1e4]], atol=1e-9)


@pytest.mark.parametrize(
    ("reason", "change", "columns"),
    [
        ("no_variance", {"sigma": {"east_m": 1.0}}, ["east_m", "north_m"]),
        ("no_variance", {"sigma": {}}, GEODETIC),
        ("no_site", {"sigma": {"range_m": 1.0, "azimuth_rad": 0.1}}, POLAR),
        ("no_origin", {"sigma": {"latitude_deg": 1.0, "longitude_deg": 1.0}}, GEODETIC),
    ],
)
def test_plots_that_cannot_be_placed_are_refused(reason: str, change: dict[str, Any], columns: list[str]) -> None:
    sensor = Sensor(0, position_sensor(**change), None)
    with pytest.raises(RefusedMessage) as error:
        sensor.plane(batch("ais", 0.0, np.zeros((1, 2)), columns))
    assert error.value.reason == reason
    assert error.value.detail.endswith(".")


# --- clutter ---
