from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trackmesh.protocol.messages import Geodetic
from trackmesh.sim.plane import geodetic_to_enu, place_enu_m
from trackmesh.sim.scenario import ScenarioError, load_scenario, scenario_names

GOOD = """
duration_s = 60.0
[origin]
latitude_deg = 48.0
longitude_deg = 11.0
[targets]
count = 3
area_enu_m = [-40e3, -40e3, 40e3, 40e3]
speed_mps = [100.0, 200.0]
[[radars]]
id = "a"
site_enu_m = [0.0, 0.0, 0.0]
period_s = 4.0
sigma_range_m = 50.0
sigma_azimuth_deg = 0.1
max_range_m = 100e3
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_the_packaged_scenarios_load() -> None:
    assert {"two-radars", "many", "rfid19"} <= set(scenario_names())
    for name in scenario_names():
        assert load_scenario(name).name == name


def test_a_file_is_named_after_itself_and_degrees_become_radians(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, GOOD))
    assert scenario.name == "mine"
    assert scenario.radars[0].sigma_azimuth_rad == pytest.approx(math.radians(0.1))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("count = 3", "count = 3\nspeed = 4", r"targets\.speed: Extra inputs"),
        ("count = 3", "count = 0", r"targets\.count: .* greater than or equal to 1"),
        ("[100.0, 200.0]", "[200.0, 100.0]", "is not ascending"),
        ("[100.0, 200.0]", "[100.0, nan]", r"targets\.speed_mps"),
        ("40e3, 40e3]", "40e3, -39e3]", "no room to turn: it needs more than 15279 m"),
        ("count = 3", "count = 3\nquiet_count = 4", r"quiet_count \(4\) is above count \(3\)"),
        ("sigma_azimuth_deg = 0.1", "", r"radars\.0\.sigma_azimuth_rad: Field required"),
        ("sigma_azimuth_deg = 0.1", "sigma_azimuth_deg = 0.1\nsigma_azimuth_rad = 1", "not both"),
        ("sigma_azimuth_deg = 0.1", 'sigma_azimuth_deg = "x"', "sigma_azimuth_deg"),
        ("site_enu_m = [0.0, 0.0, 0.0]", "", "give either site_enu_m or site"),
        ('id = "a"', 'id = "A b"', r"radars\.0\.id"),
        ("[origin]", "[origin", "is not valid TOML"),
        ("latitude_deg = 48.0", "latitude_deg = 98.0", r"origin\.latitude_deg"),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    with pytest.raises(ScenarioError, match=sentence) as caught:
        load_scenario(written(tmp_path, GOOD.replace(old, new)))
    assert "\n" not in str(caught.value)
    assert "'mine'" in str(caught.value)


def test_a_radar_id_used_twice_is_refused(tmp_path: Path) -> None:
    radar = GOOD[GOOD.index("[[radars]]") :]
    with pytest.raises(ScenarioError, match="the radar id 'a' is used more than once"):
        load_scenario(written(tmp_path, GOOD + radar))


def test_an_unknown_scenario_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"no scenario 'nothing'.*many, rfid19, two-radars"):
        load_scenario("nothing")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="not UTF-8"):
        load_scenario(tmp_path / "bytes.toml")


def test_an_unknown_radar_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="no radar 'b'; it has a"):
        load_scenario(written(tmp_path, GOOD)).radar("b")


def test_a_geodetic_site_is_placed_in_the_plane(tmp_path: Path) -> None:
    site = "site = {latitude_deg = 48.2, longitude_deg = 11.3, height_m = 600.0}"
    scenario = load_scenario(written(tmp_path, GOOD.replace("site_enu_m = [0.0, 0.0, 0.0]", site)))
    expected = pymap3d.geodetic2enu(48.2, 11.3, 600.0, 48.0, 11.0, 0.0)
    assert scenario.radars[0].position_m(scenario.origin) == pytest.approx(expected, abs=1e-6)


@given(
    st.tuples(st.floats(-89, 89), st.floats(-180, 180), st.floats(-100, 9000)),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-100, 9000)),
)
def test_the_plane_agrees_with_pymap3d(base: tuple[float, float, float], step: tuple[float, float, float]) -> None:
    origin = Geodetic(latitude_deg=base[0], longitude_deg=base[1], height_m=base[2])
    place = (base[0] + step[0], base[1] + step[1], step[2])
    expected = pymap3d.geodetic2enu(*place, *base)
    np.testing.assert_allclose(geodetic_to_enu(np.array([place]), origin)[0], expected, atol=1e-5)
    assert place_enu_m(origin, origin) == (0.0, 0.0, 0.0)
