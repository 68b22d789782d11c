"""False plots: their density over all and by area."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.services.fusion.makers import (
    EAST,
    NORTH,
    ONE,
    Fleet,
    FloatArray,
    batch,
    drive,
    engine,
    in_time_order,
    live,
    scans,
    seen,
)

from trackmesh.protocol.messages import PlotBatch, ScanPart
from trackmesh.services.estimation.plots import Plots, make_plots
from trackmesh.services.fusion.clutter import Clutter

SITE, RANGE_M = np.array([5e3, -3e3]), 100e3
AREA_M2 = np.pi * RANGE_M**2


def plots_at(z: FloatArray) -> Plots:
    return make_plots(z, [1.0, 0.0, 1.0], 0.0)


def anywhere(rng: np.random.Generator, n: int) -> FloatArray:
    r, angle = RANGE_M * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    return SITE + np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


def looked(clutter: Clutter, looks: int, per_look: float, seed: int, patch: int = 0, share: float = 1.0) -> Clutter:
    """Poisson numbers of plots anywhere, and ``patch`` more within 2 km of a place 40 km east, a look."""
    rng = np.random.default_rng(seed)
    for _ in range(round(looks / share)):
        z = anywhere(rng, rng.poisson(per_look * share))
        more = SITE + np.array([40e3, 0.0]) + rng.uniform(-2e3, 2e3, (rng.poisson(patch * share), 2))
        clutter.add(plots_at(np.vstack([z, more])), np.zeros(len(z) + len(more), bool), share)
    return clutter


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), per_look=st.sampled_from([20.0, 100.0]), share=st.sampled_from([1.0, 1.0 / 16]))
def test_even_clutter_has_about_one_density_everywhere(seed: int, per_look: float, share: float) -> None:
    clutter = looked(Clutter(SITE, RANGE_M, None, True), 40, per_look, seed, share=share)
    assert clutter.whole() * AREA_M2 == pytest.approx(per_look, rel=0.5)
    at = clutter.at(plots_at(anywhere(np.random.default_rng(seed + 1), 400)), share) * AREA_M2
    assert np.median(at) == pytest.approx(per_look, rel=0.5)
    assert at.min() > 0.15 * per_look
    assert at.max() < 5.0 * per_look


def test_a_patch_is_told_from_the_rest() -> None:
    clutter = looked(Clutter(SITE, RANGE_M, None, True), 40, 20.0, 3, patch=10)
    inside, outside = clutter.at(plots_at(SITE + np.array([[40e3, 0.0], [-40e3, 0.0]])), 1.0)
    assert inside > 20.0 * outside
    assert outside * AREA_M2 < 40.0


def test_without_areas_or_a_site_there_is_one_density() -> None:
    for clutter in (Clutter(SITE, RANGE_M, None, False), Clutter(None, RANGE_M, None, True)):
        looked(clutter, 20, 20.0, 4, patch=10)
        at = clutter.at(plots_at(SITE + np.array([[40e3, 0.0], [-40e3, 0.0]])), 1.0)
        assert at.tolist() == [clutter.whole()] * 2


def test_what_is_explained_is_no_clutter() -> None:
    clutter = Clutter(SITE, RANGE_M, None, True)
    for _ in range(30):
        clutter.add(plots_at(SITE + np.array([[1e3, 1e3], [2e3, 2e3]])), np.array([True, True]), 1.0)
    assert clutter.whole() * AREA_M2 == pytest.approx(0.5), "the floor: half a plot a look"


def test_a_declared_density_holds_until_looks_tell_otherwise() -> None:
    clutter = Clutter(SITE, RANGE_M, 50.0 / AREA_M2, True)
    assert clutter.at(plots_at(SITE[None]), 1.0) * AREA_M2 == pytest.approx(50.0)
    looked(clutter, 40, 10.0, 5)
    assert clutter.whole() * AREA_M2 == pytest.approx(10.0, rel=0.4)


def test_plots_beyond_the_coverage_count_at_its_rim() -> None:
    clutter = Clutter(SITE, RANGE_M, None, True)
    clutter.add(plots_at(np.array([[1e9, -1e9]])), np.array([False]), 1.0)
    assert np.isfinite(clutter.at(plots_at(np.array([[1e9, -1e9], [0.0, 0.0]])), 1.0)).all()


def unexplained(n: int) -> tuple[Plots, npt.NDArray[np.bool_]]:
    return plots_at(anywhere(np.random.default_rng(n), n)), np.zeros(n, bool)


def test_clutter_is_learnt_and_followed() -> None:
    clutter = Clutter(SITE, RANGE_M, None, True)
    for _ in range(60):
        clutter.add(*unexplained(20), 1.0)
    assert clutter.whole(0, 1.0) == pytest.approx(20 / AREA_M2)
    for _ in range(60):
        clutter.add(*unexplained(5), 1.0)
    assert clutter.whole(0, 1.0) == pytest.approx(5 / AREA_M2, rel=1e-3)


def test_sectors_add_up_to_looks() -> None:
    whole, parts = Clutter(SITE, RANGE_M, None, True), Clutter(SITE, RANGE_M, None, True)
    for _ in range(40):
        whole.add(*unexplained(32), 1.0)
        for _ in range(32):
            parts.add(*unexplained(1), 1 / 32)
    assert parts.whole(0, 1 / 32) == pytest.approx(whole.whole(0, 1.0), rel=1e-9)


def test_before_anything_was_counted_all_plots_are_clutter() -> None:
    assert Clutter(SITE, RANGE_M, None, True).whole(50, 1.0) == pytest.approx(50 / AREA_M2)
    assert Clutter(SITE, RANGE_M, None, True).whole(3, 1 / 32) == pytest.approx(96 / AREA_M2)


def test_a_declared_density_is_where_it_begins() -> None:
    clutter = Clutter(SITE, RANGE_M, 7 / AREA_M2, True)
    assert clutter.whole(500, 1.0) == pytest.approx(7 / AREA_M2)
    for _ in range(100):
        clutter.add(*unexplained(20), 1.0)
    assert clutter.whole(0, 1.0) == pytest.approx(20 / AREA_M2, rel=1e-3)


def test_a_clear_sky_is_never_quite_clear() -> None:
    clutter = Clutter(SITE, RANGE_M, None, True)
    for _ in range(100):
        clutter.add(*unexplained(0), 1.0)
    assert clutter.whole(0, 1.0) == pytest.approx(0.5 / AREA_M2)


# --- what it is for ---


def wind_farm(until_s: float, per_look: int = 8) -> list[PlotBatch]:
    """One target, and many false plots a turn within 8 km by 8 km."""
    rng = np.random.default_rng(8)
    out = []
    for one in scans(NORTH, ONE, until_s):
        z = np.array([-40e3, 30e3]) + rng.uniform(-4e3, 4e3, (rng.poisson(per_look), 2))
        false = seen(NORTH, float(one.t_ns[0] - 1_700_000_000 * 10**9) / 1e9, z, np.zeros_like(z))
        values, t_ns = np.concatenate([one.values, false.values]), np.full(1 + len(z), one.t_ns[0])
        out.append(one.model_copy(update={"values": values, "t_ns": t_ns}))
    return out


def test_a_patch_of_clutter_makes_few_false_tracks_only_if_areas_are_kept() -> None:
    shown = dict[bool, float]()
    for areas in (True, False):
        frames = drive(engine(NORTH, clutter_areas=areas), wind_farm(160.0))
        shown[areas] = float(np.mean([len(live(frame)) for frame in frames[20:]]))
    assert shown[True] < 2.0, shown
    assert shown[False] > 6.0


def test_sectors_without_plots_count_as_looks() -> None:
    """Else the density of a radar that sends by sectors would be that of its busy sectors."""
    tracker = engine(NORTH)
    rng = np.random.default_rng(9)
    for turn in range(30):
        for sector in range(32):
            n = int(sector == 3)
            z = np.array([[20e3, 50e3]]) + rng.uniform(-1e4, 1e4, (1, 2))
            one = seen(NORTH, turn * 4.0 + sector / 8.0, z, np.zeros((1, 2)))
            scan = ScanPart(index=turn, sector=sector, sectors=32)
            empty = batch("north", np.zeros(0), one.values[:0], one.columns)
            tracker.plots((one if n else empty).model_copy(update={"scan": scan}))
    sensor = tracker.sensors["north"]
    area = np.pi * sensor.info.max_range_m**2
    assert sensor.local_clutter.whole() * area == pytest.approx(1.0, rel=0.3)


def test_time_offsets_are_learnt_where_one_clock_is_right() -> None:
    rng = np.random.default_rng(10)
    angle = rng.uniform(0, 2 * np.pi, 12)
    targets = Fleet(rng.uniform(-40e3, 40e3, (12, 2)), 200.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    late = [
        b.model_copy(update={"t_ns": b.t_ns + 600_000_000}) for b in scans(EAST, targets, 160.0, offset_s=0.7, seed=2)
    ]
    batches = in_time_order(scans(NORTH, targets, 160.0), late)
    errors = {}
    for bias_time_s in (0.0, 0.5):
        tracker = engine(NORTH, EAST, bias_time_s=bias_time_s, right_clocks=["north"])
        frame = drive(tracker, batches)[-1]
        truth = targets.at((frame.t_ns - 1_700_000_000 * 10**9) / 1e9)
        distance = np.linalg.norm(frame.state[:, None, :2] - truth, axis=2).min(axis=1)
        errors[bias_time_s] = float(np.sqrt((distance**2).mean()))
        told = tracker.corrections.message("main", "test", 0, 0).sensors
        assert told[0].time_offset_s == 0.0
        if bias_time_s:
            assert told[1].time_offset_s == pytest.approx(-0.6, abs=0.15)
            assert 0.0 < told[1].time_offset_sigma_s < 0.1
    assert errors[0.5] < 0.75 * errors[0.0]


# --- a sensor that moves ---


def test_what_was_counted_stays_where_it_was_when_the_sensor_moves() -> None:
    clutter = looked(Clutter(SITE, RANGE_M, None, True), 40, 20.0, 3, patch=10)
    patch, other = SITE + np.array([40e3, 0.0]), SITE + np.array([-20e3, 10e3])
    before = clutter.at(plots_at(np.stack([patch, other])), 1.0)
    for k in range(1, 51):
        clutter.follow(SITE + k * np.array([700.0, -300.0]))
    after = clutter.at(plots_at(np.stack([patch, other])), 1.0)
    assert after[0] > 0.3 * before[0]
    assert after[0] > 10.0 * after[1]
    clutter.follow(SITE + np.array([5e5, 0.0]))
    gone = clutter.at(plots_at(np.stack([patch, patch + np.array([5e5, 0.0])])), 1.0)
    assert gone[0] < clutter.whole() and gone[1] < clutter.whole()


def test_where_no_areas_are_kept_nothing_has_to_follow() -> None:
    clutter = looked(Clutter(SITE, RANGE_M, None, False), 10, 20.0, 3)
    before = clutter.whole()
    clutter.follow(SITE + 1e5)
    assert clutter.at(plots_at(SITE[None]), 1.0)[0] == before


@pytest.mark.parametrize(("step", "kept"), [((1, 0), 23 * 24), ((-3, 5), 21 * 19), ((30, 0), 0), ((0, 0), 24 * 24)])
def test_cells_that_are_still_covered_are_kept(step: tuple[int, int], kept: int) -> None:
    clutter = Clutter(SITE, 12e3, None, True)
    clutter.restore(clutter.kept() | {"cells": 1.0 + np.arange(24.0 * 24.0).reshape(24, 24)})
    clutter.follow(SITE + 1e3 * np.array(step))
    after = clutter.kept()
    assert (after["cells"] > 0.0).sum() == kept
    np.testing.assert_allclose(after["corner"], SITE - 12e3 + 1e3 * np.array(step))
    if kept:
        i, j = np.argwhere(after["cells"] > 0.0)[0]
        assert after["cells"][i, j] == 1.0 + 24.0 * (i + step[0]) + j + step[1]
