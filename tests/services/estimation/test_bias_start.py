from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from tests.services.fusion.biased import Sky, Station

from trackmesh.services.estimation.bias import Geometry, Tracks
from trackmesh.services.estimation.bias_start import BiasStart, StartRules, global_start

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

FAR = (2000.0, float(np.deg2rad(2.0)), 0.0)
NORTH = Station("north", "polar", (0.0, 0.0), (-FAR[0], FAR[1], 0.0))
EAST = Station("east", "polar", (40e3, 10e3), FAR)
PLACES = Station("places", "position", (0.0, 0.0), (900.0, -1500.0, 0.0))


def seen(seed: int, n: int, stations: tuple[Station, Station], share: float) -> tuple[list[Tracks], list[IntArray]]:
    """Tracks of two stations, each of a share of n targets and in an order of its own; which target each is of."""
    sky = Sky(seed, n, stations)
    tracks, targets = [], []
    for station, look in zip(stations, sky.look(0.0), strict=True):
        rows = sky.rng.permutation(n)[: round(share * n)]
        geometry = Geometry(station.kind == "polar", np.array(station.site_m))
        tracks.append(Tracks(geometry, look.x[rows], look.P[rows]))
        targets.append(rows)
    return tracks, targets


def purity(found: BiasStart, targets: list[IntArray]) -> float:
    return float((targets[0][found.a] == targets[1][found.b]).mean())


def assert_near(found: FloatArray, station: Station, range_m: float = 100.0, azimuth_deg: float = 0.15) -> None:
    assert found[0] == pytest.approx(station.bias[0], abs=range_m)
    assert found[1] == pytest.approx(station.bias[1], abs=np.deg2rad(azimuth_deg))


@pytest.mark.parametrize("n", [50, 100])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_biases_of_two_kilometres_and_two_degrees_at_both_radars_are_found(n: int, seed: int) -> None:
    tracks, targets = seen(seed, n, (NORTH, EAST), 0.7)
    found = global_start(tracks[0], tracks[1])
    assert found.found, found.reason
    assert purity(found, targets) >= 0.95
    common = len(set(targets[0].tolist()) & set(targets[1].tolist()))
    assert len(found.a) >= 0.9 * common
    assert len(set(found.a.tolist())) == len(set(found.b.tolist())) == len(found.a)
    assert found.rivals <= 0.3 * len(found.a)
    assert_near(found.bias_a, NORTH)
    assert_near(found.bias_b, EAST)


def test_all_the_bias_is_that_of_the_sensor_that_is_no_reference() -> None:
    right = NORTH._replace(bias=(0.0, 0.0, 0.0))
    tracks, _ = seen(4, 50, (right, EAST), 0.7)
    found = global_start(tracks[0], tracks[1], reference_a=True)
    assert found.found
    assert not found.bias_a.any()
    assert_near(found.bias_b, EAST)
    turned = global_start(tracks[1], tracks[0], reference_b=True)
    assert turned.bias_a == pytest.approx(found.bias_b)
    assert turned.a.tolist() == found.b.tolist()


def test_a_radar_and_a_position_sensor_find_each_other() -> None:
    tracks, targets = seen(5, 50, (EAST, PLACES), 0.7)
    found = global_start(tracks[0], tracks[1])
    assert found.found
    assert purity(found, targets) >= 0.95
    assert_near(found.bias_a, EAST)
    assert found.bias_b == pytest.approx(PLACES.bias[:2], abs=100.0)


@pytest.mark.parametrize("kind", ["polar", "position"])
def test_of_sensors_that_tell_only_a_difference_the_least_biases_are_given(kind: str) -> None:
    one = NORTH if kind == "polar" else PLACES
    other = one._replace(name="other", bias=(0.0, 0.0, 0.0))
    tracks, targets = seen(6, 50, (one, other), 0.7)
    found = global_start(tracks[0], tracks[1])
    assert found.found
    assert purity(found, targets) >= 0.95
    assert found.bias_a == pytest.approx(-found.bias_b, rel=0.05)
    scale = [100.0, np.deg2rad(0.15)] if kind == "polar" else [100.0, 100.0]
    assert (found.bias_a - found.bias_b) / scale == pytest.approx(np.array(one.bias[:2]) / scale, abs=1.0)


@pytest.mark.parametrize(("n", "span_m"), [(50, 100e3), (100, 100e3), (100, 40e3), (100, 30e3), (20, 60e3)])
@pytest.mark.parametrize("seed", range(5))
def test_unrelated_tracks_are_refused(n: int, span_m: float, seed: int) -> None:
    found = global_start(*unrelated(seed, n, span_m))
    assert not found.found
    assert found.reason


def test_a_few_matches_among_very_many_tracks_are_chance() -> None:
    a, b = unrelated(77, 100, 30e3)
    assert global_start(a, b, StartRules(least_share=0.0)).found
    assert not global_start(a, b).found


def unrelated(seed: int, n: int, span_m: float) -> tuple[Tracks, Tracks]:
    """Tracks of two stations that see different targets."""
    skies = [Sky(seed + offset, n, [station], span_m=span_m) for offset, station in ((0, NORTH), (100, EAST))]
    a, b = (Tracks(Geometry(True, np.array(sky.stations[0].site_m)), *sky.look(0.0)[0]) for sky in skies)
    return a, b


def test_a_pattern_that_fits_in_more_than_one_way_is_refused() -> None:
    rng, n = np.random.default_rng(7), 30
    lane = np.stack([np.arange(n) * 4e3 - 40e3, np.full(n, 20e3), np.full(n, 200.0), np.zeros(n)], axis=1)
    P = np.tile(np.diag([1e4, 1e4, 225.0, 225.0]), (n, 1, 1))
    tracks = [
        Tracks(
            Geometry(True, np.array(site)), lane + [shift, 0, 0, 0] + rng.normal(0, 1, (n, 4)) * [100, 100, 15, 15], P
        )
        for site, shift in (((0.0, 0.0), 0.0), ((40e3, 10e3), 2000.0))
    ]
    found = global_start(tracks[0], tracks[1])
    assert not found.found
    assert found.reason.startswith("Ambiguous")


def test_too_few_tracks_and_no_tracks_are_refused() -> None:
    for n in (0, 1, 4):
        tracks, _ = seen(8, n, (NORTH, EAST), 1.0)
        found = global_start(tracks[0], tracks[1])
        assert not found.found
        assert found.reason.startswith(f"Only {len(found.a)} tracks match")


def test_other_limits_can_be_sought() -> None:
    stations = NORTH._replace(bias=(-5000.0, -0.08, 0.0)), EAST._replace(bias=(5000.0, 0.08, 0.0))
    tracks, targets = seen(13, 100, stations, 0.7)
    found = global_start(tracks[0], tracks[1], StartRules(limit_range_m=5000.0, limit_azimuth_rad=0.09))
    assert found.found
    assert purity(found, targets) >= 0.95
    assert_near(found.bias_a, stations[0])
    assert_near(found.bias_b, stations[1])


def test_many_tracks_of_one_target_count_once() -> None:
    tracks, targets = seen(14, 20, (NORTH, EAST), 1.0)
    a, b = tracks
    swarm = np.repeat(a.x[:1] + np.array([2500.0, 1500.0, 0.0, 0.0]), 60, axis=0)
    swarm[:, :2] += np.random.default_rng(1).normal(0, 50, (60, 2))
    b = Tracks(b.geometry, np.concatenate([b.x, swarm]), np.concatenate([b.P, np.tile(b.P[:1], (60, 1, 1))]))
    found = global_start(a, b)
    assert found.found
    assert purity(found, [targets[0], np.concatenate([targets[1], np.full(60, -1)])]) >= 0.9


def test_biases_beyond_the_limits_are_not_claimed() -> None:
    tracks, _ = seen(9, 50, (NORTH._replace(bias=(0.0, 0.0, 0.0)), EAST._replace(bias=(6000.0, 0.0, 0.0))), 1.0)
    assert not global_start(tracks[0], tracks[1]).found


def test_tracks_that_are_no_numbers_are_passed_over() -> None:
    tracks, targets = seen(10, 50, (NORTH, EAST), 1.0)
    tracks[0].x[3], tracks[0].P[5], tracks[1].P[7] = np.nan, 0.0, np.inf
    found = global_start(tracks[0], tracks[1])
    assert found.found
    assert not {3, 5} & set(found.a.tolist())
    assert 7 not in found.b.tolist()
    assert purity(found, targets) >= 0.95


def test_of_very_many_tracks_the_fastest_do() -> None:
    tracks, targets = seen(11, 1000, (NORTH, EAST), 0.7)
    found = global_start(tracks[0], tracks[1], rules=StartRules(most_tracks=60))
    assert found.found
    assert purity(found, targets) >= 0.95
    assert_near(found.bias_a, NORTH)


def test_in_a_small_world_smaller_limits_do() -> None:
    scale = 1e-3
    station = EAST._replace(site_m=(40.0, 10.0), bias=(2.0, FAR[1], 0.0))
    tracks, targets = seen(12, 50, (NORTH._replace(bias=(0.0, 0.0, 0.0)), EAST), 1.0)
    small = [
        Tracks(Geometry(True, np.array(site)), one.x * scale, one.P * scale**2)
        for one, site in zip(tracks, ((0.0, 0.0), station.site_m), strict=True)
    ]
    found = global_start(small[0], small[1], rules=StartRules(limit_range_m=2.0))
    assert found.found
    assert purity(found, targets) >= 0.95
    assert_near(found.bias_b, station, range_m=0.1)
