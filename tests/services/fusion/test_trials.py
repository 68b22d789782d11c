"""The trials are what they say, and are judged as the peers were."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import peer_scenario
from benchmarks.fusion_cases import judged, mean, spread, table
from benchmarks.peer_cases import CASES, Bound
from benchmarks.trials import (
    CLUTTER,
    EAST,
    NORTH,
    Trial,
    biased,
    coming_and_going,
    crossing,
    crossings,
    in_pairs,
    late,
    silent,
    trial,
    unseen,
    with_positions,
)
from benchmarks.verdicts import drive, judge

from trackmesh.services.fusion.engine import FusionEngine, Unit
from trackmesh.services.fusion.settings import EngineSettings

pytestmark = pytest.mark.skipif(not peer_scenario.available(), reason="the peers' scenario is not here")


@pytest.fixture(scope="module")
def short() -> Trial:
    return trial(4, 60.0)


def errors_of(given: Trial, sensor_id: str) -> tuple[np.ndarray, np.ndarray]:
    """When (n,) and by how much (n, 2) the plots of targets are off the truth, in their own columns."""
    info = next(s for s in given.sensors if s.sensor_id == sensor_id)
    t_s, off = [np.zeros(0)], [np.zeros((0, 2))]
    for feed in (f for f in given.feeds if f.batch.sensor_id == sensor_id):
        real = feed.target != CLUTTER
        place = given.state_at(feed.t_s)[feed.target[real], :2]
        if info.kind == "radar":
            assert info.site_enu_m is not None
            east, north = (place - info.site_enu_m[:2]).T
            place = np.stack([np.hypot(east, north), np.arctan2(east, north)], axis=1)
        wrong = feed.batch.values[real] - place
        if info.kind == "radar":
            wrong[:, 1] = (wrong[:, 1] + np.pi) % (2 * np.pi) - np.pi
        t_s.append(np.full(len(wrong), feed.t_s))
        off.append(wrong)
    return np.concatenate(t_s), np.concatenate(off)


def test_plots_know_their_targets(short: Trial) -> None:
    for name, sigma_m, sigma_deg in ((NORTH, 50.0, 0.08), (EAST, 60.0, 0.10)):
        _, off = errors_of(short, name)
        assert len(off) > 400
        np.testing.assert_allclose(off.std(axis=0), [sigma_m, np.deg2rad(sigma_deg)], rtol=0.12)
        assert abs(off[:, 0].mean()) < 10.0


def test_a_bias_begins_when_it_should(short: Trial) -> None:
    given = biased(short, EAST, 150.0, 0.4, from_s=30.0)
    t_s, off = errors_of(given, EAST)
    np.testing.assert_allclose(off[t_s >= 30.0].mean(axis=0), [150.0, np.deg2rad(0.4)], rtol=0.08)
    assert abs(off[t_s < 30.0, 0].mean()) < 15.0
    assert np.array_equal(errors_of(given, NORTH)[1], errors_of(short, NORTH)[1])
    for feed in given.feeds:
        assert (feed.batch.values[:, 1] >= 0).all() and (feed.batch.values[:, 1] < 2 * np.pi).all()


def test_parameters_of_the_radars() -> None:
    given = trial(4, 60.0, radars={"p_detect": 0.7, "clutter_per_scan": 200.0})
    clutter = np.mean([(f.target == CLUTTER).sum() for f in given.feeds])
    seen = np.mean([(f.target != CLUTTER).sum() for f in given.feeds])
    assert clutter == pytest.approx(200.0, rel=0.05) and seen == pytest.approx(35.0, rel=0.08)
    assert [s.p_detect for s in given.sensors] == [0.7, 0.7]


def test_silence(short: Trial) -> None:
    dead = silent(short, 20.0, 40.0, NORTH)
    assert {f.batch.sensor_id for f in dead.feeds if 20.0 <= f.t_s < 40.0} == {EAST}
    assert dead.ticks_s == () and len(dead.feeds) == len(short.feeds) - 5
    dark = silent(short, 20.0, 35.0)
    assert not [f for f in dark.feeds if 20.0 <= f.t_s < 35.0]
    assert dark.ticks_s == tuple(range(21, 35))


def test_targets_that_nobody_sees(short: Trial) -> None:
    some = np.array([3, 9])
    gone = unseen(short, 20.0, 35.0, some)
    assert sum(len(f.target) for f in gone.feeds) < sum(len(f.target) for f in short.feeds)
    for before, after in zip(short.feeds, gone.feeds, strict=True):
        away = (np.isin(before.target, some)) & (20.0 <= before.t_s < 35.0)
        assert np.array_equal(after.target, before.target[~away])
        assert np.array_equal(after.batch.values, before.batch.values[~away])
        assert len(after.batch.t_ns) == len(after.target)


def test_late_batches_overtake(short: Trial) -> None:
    given = late(trial(4, 60.0, sectors=32), 4, 1.0)
    arrival, seen = np.array([(f.arrival_s, f.t_s) for f in given.feeds]).T
    assert (np.diff(arrival) >= 0).all() and (np.diff(seen) < 0).sum() > 50
    assert (arrival >= seen).all() and (arrival - seen).max() <= 1.0
    assert len(late(short, 4, 0.0).feeds) == len(short.feeds)


def test_a_third_sensor(short: Trial) -> None:
    given = with_positions(short, 4, 3.0, 80.0, 0.8)
    t_s, off = errors_of(given, "positions")
    assert np.diff(np.unique(t_s)) == pytest.approx(3.0)
    assert len(off) == pytest.approx(20 * 50 * 0.8, rel=0.06)
    assert off.std(axis=0) == pytest.approx([80.0, 80.0], rel=0.1)


def test_pairs_fly_side_by_side() -> None:
    given = trial(4, 60.0, rearrange=in_pairs(4, 500.0))
    apart = given.truth[:, 1::2] - given.truth[:, ::2]
    assert np.hypot(apart[..., 0], apart[..., 2]) == pytest.approx(500.0)
    assert not apart[..., 1::2].any()
    _, off = errors_of(given, NORTH)
    assert off[:, 0].std() == pytest.approx(50.0, rel=0.12), "the radars see them there"


def test_pairs_cross() -> None:
    meet = crossings(4, 25, 200.0)
    given = trial(4, 200.0, rearrange=crossing(meet))
    for k in range(25):
        one, other = given.state_at(float(meet.t_s[k]))[[2 * k, 2 * k + 1]]
        assert np.hypot(*(other - one)[:2]) < 130.0, "100 m, and what they fly within a step"
        course = [np.arctan2(v[2], v[3]) for v in (one, other)]
        between = np.rad2deg(abs((course[1] - course[0] + np.pi) % (2 * np.pi) - np.pi))
        assert 19.0 < between < 41.0
    step = np.diff(given.truth[:, :, [0, 2]], axis=0) / 0.1
    np.testing.assert_allclose(step, given.truth[:-1, :, 1::2], atol=1e-6)


def test_the_verdict_is_that_of_the_peers(short: Trial) -> None:
    case = peer_scenario.make(4, duration_s=60.0)
    engine = FusionEngine(EngineSettings(), Unit())
    for sensor in short.sensors:
        engine.sensor(sensor)
    shown, _ = drive(engine, short)
    theirs = peer_scenario.score(case, [frame for _, frame in shown])
    ours = judge(short, EngineSettings())
    for name, theirs_name in (("gospa_m",) * 2, ("rmse_m",) * 2, ("missed",) * 2, ("false",) * 2):
        assert ours[name] == pytest.approx(theirs[theirs_name], rel=1e-9)
    assert ours["switches"] == theirs["id_switches"]


def test_bounds_and_the_table() -> None:
    names = ["gospa_m", "rmse_m", "switches", "missed", "false", "kept_pct", "nees", "start_gospa_m"]
    names += [
        "start_missed_pct",
        "shown_after_s",
        "gone_after_s",
        "bias_120_m",
        "bias_120_deg",
        "bias_m",
        "bias_deg",
        "pairs_right_pct",
        "paired_pct",
    ]
    one = dict.fromkeys(names, 100.0) | {"bias_m": np.nan}
    runs = {2: one, 3: one | {"gospa_m": 110.0, "bias_m": 5.0}}
    assert mean(runs)["gospa_m"] == 105.0 and spread(runs)["gospa_m"] == 5.0
    assert mean(runs)["bias_m"] == 5.0 and np.isnan(spread(runs)["bias_m"])
    means = {"nominal": mean(runs), "bias-150": mean(runs) | {"gospa_m": 108.0}}
    assert not judged(Bound("gospa_m", 1.02, of="nominal"), "bias-150", means)
    assert judged(Bound("gospa_m", 1.03, of="nominal"), "bias-150", means)
    assert judged(Bound("kept_pct", 98.0, least=True), "nominal", means)
    text = table({"nominal": runs})
    assert "| 105 (5) |" in text and "gospa_m <= 515<br>rmse_m <= 73" in text and "ok<br>SHORT<br>ok" in text
    assert all(case.about for case in CASES.values())


def test_who_is_not_there_gives_no_plot_and_is_not_missed(short: Trial) -> None:
    given = coming_and_going(short, 4)
    assert given.lives_s is not None
    seen = [(feed.t_s, row) for feed in given.feeds for row in feed.target[feed.target != CLUTTER].tolist()]
    assert all(row in given.there(t_s) for t_s, row in seen)
    assert len(given.there(0.0)) < given.targets > len(given.there(given.duration_s))
    clutter = [sum(int((f.target == CLUTTER).sum()) for f in one.feeds) for one in (given, short)]
    assert clutter[0] == clutter[1]
    figures = judge(given, EngineSettings())
    assert figures["missed"] < 4.0
    assert 0.0 < figures["shown_after_s"] < 10.0
    assert 0.0 < figures["gone_after_s"] < 20.0
