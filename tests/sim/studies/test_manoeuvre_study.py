from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.services.estimation.bank import as_array, make_models
from trackmesh.services.estimation.imm_tracks import ImmTracks
from trackmesh.services.estimation.motion import SINGER, TANGENTIAL, TURN
from trackmesh.services.fusion.settings import EngineSettings
from trackmesh.sim.studies.filtering import Estimates, run_filter
from trackmesh.sim.studies.manoeuvre import study, targets
from trackmesh.sim.studies.manoeuvre.acceptance import Judged
from trackmesh.sim.studies.manoeuvre.cells import Cell, Simulated, all_cells, simulate, with_misses
from trackmesh.sim.studies.manoeuvre.charts import spans
from trackmesh.sim.studies.manoeuvre.measurement import measure
from trackmesh.sim.studies.manoeuvre.radar import DISTANCE_M, Radar, plots_of_radar
from trackmesh.sim.studies.manoeuvre.scores import Mean, Value, geometric_mean, measured, ratio, score
from trackmesh.sim.studies.manoeuvre.study import run
from trackmesh.sim.studies.manoeuvre.targets import FAMILIES, Commands, Phase, fly, fly_family, in_phases, seen_every
from trackmesh.sim.studies.manoeuvre.variants import GENERIC, MANOEUVRE, TVIMM, variants, without_estimation
from trackmesh.sim.studies.manoeuvre_targets import STEP_S, Leg, Measured, flight, random_legs, three_manoeuvres
from trackmesh.sim.studies.result import StudyResult

CELLS = {cell.name: cell for cell in all_cells()}
EAST = np.array([[200.0, 0.0]])


def commands(family: str, velocity: FloatArray, n: int, seed: int = 1) -> Commands:
    return FAMILIES[family].command(np.random.default_rng(seed), velocity, n)


def accelerations(orders: Commands, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of undisturbed flights: velocities (n, runs, 2) at half steps, and how they change."""
    v = fly(orders, velocity, np.random.default_rng(0), 0.0)[..., 2:]
    return (v[1:] + v[:-1]) / 2.0, np.diff(v, axis=0) / STEP_S


# --- targets ---


def test_a_weave_swings_across_a_straight_course() -> None:
    velocity = np.array([[120.0, 160.0], [0.0, -150.0]])
    _, change = accelerations(commands("weave", velocity, 900), velocity)
    course = velocity / np.linalg.norm(velocity, axis=1)[:, None]
    np.testing.assert_allclose((change * course).sum(axis=-1), 0.0, atol=1e-9)
    across = change[..., 1] * course[:, 0] - change[..., 0] * course[:, 1]
    np.testing.assert_allclose(across.max(axis=0), 20.0, rtol=1e-3)
    np.testing.assert_allclose(across[150:], -across[:-150], atol=1e-9)
    np.testing.assert_allclose(across.std(axis=0), 20.0 / np.sqrt(2.0), rtol=1e-6)


def test_s_turns_swing_across_the_path_itself() -> None:
    orders = commands("s-turns", EAST, 900)
    v, change = accelerations(orders, EAST)
    speed = np.linalg.norm(v, axis=-1)
    np.testing.assert_allclose(speed, 200.0, rtol=1e-4)
    np.testing.assert_allclose((change * v).sum(axis=-1), 0.0, atol=1e-6)
    left = (change[..., 1] * v[..., 0] - change[..., 0] * v[..., 1]) / speed
    assert left.max() == pytest.approx(20.0, rel=1e-3)
    np.testing.assert_allclose(left[150:], -left[:-150], atol=0.01)


def test_jinks_push_into_any_direction() -> None:
    orders = commands("jink", np.tile(EAST, (60, 1)), 6000)
    push = orders.push_mps2.transpose(1, 0, 2)
    begins = np.diff(orders.manoeuvring.T.astype(int), axis=1)
    durations, strength, angle = [], [], []
    for row, at in zip(push, begins, strict=True):
        begin, end = np.flatnonzero(at == 1), np.flatnonzero(at == -1)
        durations += (STEP_S * (end - begin[: len(end)])).tolist()
        each = row[begin + 1]
        strength += np.hypot(*each.T).tolist()
        angle += np.arctan2(each[:, 1], each[:, 0]).tolist()
        # Straight for 10 s at least before each.
        assert np.all(begin[1:][: len(end)] - end[: len(begin) - 1] >= 99)
    assert len(durations) > 300
    for values, (low, high) in ((durations, (5.0, 15.0)), (strength, (2.0, 15.0)), (angle, (-np.pi, np.pi))):
        assert low - 0.11 <= min(values) < low + 0.3
        assert high - 0.3 < max(values) <= high + 0.11
        assert np.mean(values) == pytest.approx((low + high) / 2.0, abs=0.2 * (high - low) / 2.0)
    assert not orders.turn_radps.any()
    assert not orders.along_mps2.any()


def test_singer_forgets_in_twenty_seconds() -> None:
    push = commands("singer", np.tile(EAST, (2000, 1)), 401).push_mps2
    assert push.std() == pytest.approx(5.0, rel=0.02)
    for lag_s, kept in ((0.0, 1.0), (10.0, np.exp(-0.5)), (20.0, np.exp(-1.0)), (40.0, np.exp(-2.0))):
        later = (push[0] * push[round(lag_s / STEP_S)]).mean() / 25.0
        assert later == pytest.approx(kept, abs=0.05)
    assert abs((push[..., 0] * push[..., 1]).mean()) < 1.0


@pytest.mark.parametrize(("family", "density"), [("wna", 25.0), ("cv", 0.04), ("R", 0.04)])
def test_velocities_wander_by_their_density(family: str, density: float) -> None:
    flights = fly_family(family, 2000, 1.0, 10.0, np.random.default_rng(2))
    gained = flights.truth[:, 10, 2:] - flights.truth[:, 0, 2:]
    # Nothing manoeuvres in the first 10 s of R.
    assert gained.var() == pytest.approx(density * 10.0, rel=0.06)
    assert flights.manoeuvring.all() == flights.manoeuvring.any() == (family == "wna")


def test_turns_with_speed_changes_do_both_at_once() -> None:
    orders = commands("both", np.tile(EAST, (60, 1)), 6000)
    turn, along = np.degrees(abs(orders.turn_radps)), abs(orders.along_mps2)
    busy = orders.manoeuvring
    assert np.array_equal(turn > 0, busy)
    assert np.array_equal(along > 0, busy)
    assert 1.0 <= turn[busy].min() < 1.2 < 5.5 < turn.max() <= 6.0
    assert 3.0 <= along[busy].min() < 3.2 < 9.8 < along.max() <= 10.0
    sides = {(bool(a), bool(b)) for a, b in zip(orders.turn_radps[busy] > 0, orders.along_mps2[busy] > 0, strict=True)}
    assert len(sides) == 4


def test_flights_are_those_of_the_legs() -> None:
    """All runs at once as one after the other."""
    rng = np.random.default_rng(3)
    # The last two reach the limits of speed.
    legs = [
        random_legs(rng, 200.0),
        random_legs(rng, 200.0),
        [Leg(60.0, 0.02, -10.0)],
        [Leg(60.0, 0.0, 10.0), Leg(9.0)],
    ]
    velocity = np.array([[100.0, -50.0], [-200.0, 90.0], [0.0, 150.0], [-120.0, -60.0]])
    ours = fly(in_phases([[Phase(*leg) for leg in run] for run in legs], 2000), velocity, rng, 0.0)
    for i, run_legs in enumerate(legs):
        np.testing.assert_allclose(ours[:, i], flight(run_legs, 200.0, velocity[i], rng, 0.0), rtol=1e-9, atol=1e-6)


def test_t0_is_the_flight_with_three_manoeuvres() -> None:
    ours = fly_family("T0", 1, 1.0, 172.0, np.random.default_rng(4)).truth[0]
    theirs = three_manoeuvres(1, 1.0, 20.0, 1).truth[0]
    ours_p, theirs_p = (t[:, 0] + 1j * t[:, 1] for t in (ours, theirs))
    np.testing.assert_allclose(ours_p / ours_p[1], theirs_p / theirs_p[1], atol=1e-6)
    np.testing.assert_allclose(np.hypot(*ours.T[2:]), np.hypot(*theirs.T[2:]), atol=1e-8)


def test_scans_know_what_was_flown_before_them() -> None:
    busy = np.zeros((50, 1), bool)
    busy[10:12], busy[25:41] = True, True
    flights = seen_every(10, np.zeros((51, 1, 4)), busy)
    # Scans after steps 10, 20, 30, 40, 50; the first manoeuvre begins with a scan, the second within an interval.
    assert flights.manoeuvring[:, 0].tolist() == [False, True, True, True, True]
    assert flights.since_onset[:, 0].tolist() == [0, 1, 0, 1, 2]
    assert flights.truth.shape == (1, 6, 4)
    never = seen_every(10, np.zeros((51, 1, 4)), np.ones((50, 1), bool))
    assert never.manoeuvring.all()
    assert (never.since_onset == -1).all()


def test_plots_depend_on_their_own_cell_only() -> None:
    short = [cell._replace(duration_s=40.0) for cell in (CELLS["R1/10"], CELLS["R1/30"])]
    one, again, other = (simulate(cell, 2) for cell in (short[0], short[0], short[1]))
    np.testing.assert_array_equal(one.case.plots, again.case.plots)
    assert abs(one.flights.truth[:, -1] - other.flights.truth[:, -1]).max() > 1.0
    assert (other.case.plots - other.case.truth[:, 1:, :2]).std() == pytest.approx(30.0, rel=0.2)


# --- plots that are missing, radars ---


def test_a_fifth_of_the_plots_is_missing() -> None:
    cell = CELLS["R1/30"]._replace(duration_s=100.0)
    given = simulate(cell, 100)
    found = [with_misses(c, given).detected for c in (cell, cell, CELLS["R1/10"])]
    one, again, other = (mask for mask in found if mask is not None)
    assert one.shape == (100, 100)
    assert set(np.unique(one)) == {0.0, 1.0}
    assert one.mean() == pytest.approx(0.8, abs=0.015)
    # Each by itself: two in a row are missing in one of 25.
    assert ((one[:, 1:] + one[:, :-1]) == 0.0).mean() == pytest.approx(0.04, abs=0.01)
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_without_plots_the_filter_goes_on_and_knows_less() -> None:
    given = simulate(CELLS["R1/30"]._replace(duration_s=60.0), 5)
    detected = np.ones((5, 60))
    detected[:, 30:36] = 0.0
    out = run_filter(make_models((MANOEUVRE, GENERIC)), given.case, plots=given.plots, detected=detected)
    np.testing.assert_allclose(out.mu.sum(axis=-1), 1.0, atol=1e-12)
    eigenvalues = np.linalg.eigvalsh(out.covariance)
    assert np.isfinite(eigenvalues).all()
    assert eigenvalues.min() > 0.0
    spread = out.covariance[:, :, 0, 0] + out.covariance[:, :, 1, 1]
    assert np.all(np.diff(spread[29:36], axis=0) > 0.0)
    assert np.all(spread[36] < spread[35])
    # No plot, no evidence: the weights of the branches stay.
    weight = out.mu[:, :, :5].sum(axis=-1)
    np.testing.assert_allclose(weight[30:36], np.tile(weight[29], (6, 1)), rtol=1e-12)


@pytest.mark.parametrize("azimuth_deg", [0.1, 0.5])
def test_a_radar_measures_as_it_says(azimuth_deg: float) -> None:
    truth = fly_family("R", 150, 2.0, 60.0, np.random.default_rng(5)).truth
    with_rate, without = (
        plots_of_radar(Radar(azimuth_deg, rate), truth, 2.0, np.random.default_rng(6)) for rate in (True, False)
    )
    for name in ("z", "R", "t_s", "site"):
        assert np.array_equal(with_rate[name], without[name])
    assert np.isinf(without["range_rate_variance"]).all()
    np.testing.assert_array_equal(with_rate["t_s"][:, 0], 2.0 * np.arange(1, 31))
    seen = np.swapaxes(truth[:, 1:], 0, 1)
    offset = seen[..., :2] - with_rate["site"]
    distance = np.linalg.norm(offset, axis=-1)
    middle = np.linalg.norm(truth[:, :, :2].mean(axis=1) - with_rate["site"][0], axis=-1)
    assert DISTANCE_M[0] <= middle.min() < 63e3 < 97e3 < middle.max() <= DISTANCE_M[1]
    ee, en, nn = np.moveaxis(with_rate["R"], -1, 0)
    error = with_rate["z"] - seen[..., :2]
    squared = (nn * error[..., 0] ** 2 - 2 * en * error[..., 0] * error[..., 1] + ee * error[..., 1] ** 2) / (
        ee * nn - en**2
    )
    assert squared.mean() == pytest.approx(2.0, abs=0.1)
    along = (error * offset).sum(axis=-1) / distance
    assert along.std() == pytest.approx(50.0, rel=0.05)
    assert np.sqrt((error**2).sum(axis=-1) - along**2).std() < np.radians(azimuth_deg) * 110e3
    off = with_rate["range_rate_mps"] - (offset * seen[..., 2:]).sum(axis=-1) / distance
    assert off.mean() == pytest.approx(0.0, abs=0.12)
    assert off.std() == pytest.approx(2.0, rel=0.05)
    np.testing.assert_array_equal(with_rate["range_rate_variance"], 4.0)


def test_radar_cells_differ_by_the_range_rate_alone() -> None:
    short = [CELLS[f"radar4/0.1{rate}"]._replace(duration_s=40.0) for rate in ("", " range rate")]
    without, with_rate = (simulate(cell, 3) for cell in short)
    np.testing.assert_array_equal(without.plots["z"], with_rate.plots["z"])
    np.testing.assert_array_equal(without.flights.truth, with_rate.flights.truth)


# --- filters ---


def test_the_filters_are_those_of_the_service() -> None:
    served = EngineSettings().system_tracks(1)
    assert isinstance(served, ImmTracks)
    models = as_array(variants("T0", certain=True)["tvimm"].models)
    for name in models.dtype.names or ():
        np.testing.assert_array_equal(models[name], as_array(served.models)[name], err_msg=name)
    assert models.dtype.names
    alone = variants("T0", certain=False)
    assert list(alone) == ["tvimm", "imm", "branch A"]
    assert [len(v.models.kind) for v in alone.values()] == [8, 3, 5]


def test_without_estimation_turns_and_speed_changes_are_known() -> None:
    for before, after in zip(MANOEUVRE.models, without_estimation(MANOEUVRE).models, strict=True):
        assert after.sd == (0.0 if before.kind in (TURN, TANGENTIAL) else before.sd)
        assert after._replace(sd=before.sd) == before
    assert any(model.kind == SINGER and model.sd > 0.0 for model in without_estimation(MANOEUVRE).models)


def test_parts_are_taken_out_where_they_are_asked_for() -> None:
    assert "branch A, nothing estimated" in variants("R4/30", certain=True)
    assert {"imm, lag 1", "branch A, lag 2", "tvimm, lag 1"} <= set(variants("R2/30", certain=True))
    assert variants("R2/30", certain=True)["imm, lag 2"].lag == 2
    whole = variants("R4/10", certain=True)["branch A, whole steps"].models
    assert whole.split_s[0] > 1e9
    assert set(variants("weave1/10", certain=True)) == set(variants("T0", certain=False))


# --- scores ---


def scored(off: FloatArray, busy: list[bool], since: list[int]) -> targets.Flights:
    runs, scans = off.shape[1], off.shape[0]
    spread = (np.tile(np.array(column)[:, None], (1, runs)) for column in (busy, since))
    return targets.Flights(np.zeros((runs, scans + 1, 4)), *spread)


def test_errors_of_hand() -> None:
    """Two runs of five scans; a manoeuvre from the third on."""
    off = np.zeros((5, 2, 4))
    off[:, 0, 0], off[:, 1, 1] = [3.0, 3.0, 6.0, 9.0, 3.0], [3.0, 3.0, 8.0, 7.0, 3.0]
    off[:, :, 2] = 2.0
    flights = scored(off, [False, False, True, True, False], [-1, -1, 0, 1, 2])
    covariance = np.tile(np.diag([9.0, 9.0, 4.0, 4.0]), (5, 2, 1, 1))
    estimates = Estimates(off, covariance, np.tile([0.3, 0.2, 0.5], (5, 2, 1)))
    case = Measured(flights.truth, off.swapaxes(0, 1)[..., :2], 1.0, 3.0)
    two_and_one = make_models(
        (GENERIC._replace(models=GENERIC.models[:2], sojourn_s=(1, 1), jumps=None, start=None),) * 2
    )
    found = score(two_and_one, estimates, Simulated(flights, case, np.zeros((5, 2))))
    assert measured("peak", found).value == pytest.approx(np.sqrt((81 + 49) / 2))
    assert measured("position", found).value == pytest.approx(np.sqrt((27 + 36 + 81 + 27 + 64 + 49) / 10))
    assert measured("velocity", found).value == pytest.approx(2.0)
    assert measured("quiet", found).value == pytest.approx(3.0)
    assert measured("manoeuvre", found).value == pytest.approx(np.sqrt((36 + 81 + 64 + 49) / 4))
    nees = np.array([1, 1, 4, 9, 1, 1, 1, 64 / 9, 49 / 9, 1]) + 1.0
    assert measured("anees", found).value == pytest.approx(nees.mean() / 4)
    assert measured("anees in manoeuvre", found).value == pytest.approx(nees[[2, 3, 7, 8]].mean() / 4)
    assert measured("cov95", found).value == pytest.approx((nees < 9.4877).mean()) == 0.9
    np.testing.assert_allclose(found.weight.total / found.weight.scans, 0.5)
    assert ratio("peak", found, found) == Value(1.0, 0.0)


def test_without_onset_there_is_no_peak() -> None:
    off = np.ones((4, 3, 4))
    flights = scored(off, [True] * 4, [-1] * 4)
    estimates = Estimates(off, np.tile(np.eye(4), (4, 3, 1, 1)), np.full((4, 3, 8), 0.125))
    case = Measured(flights.truth, off.swapaxes(0, 1)[..., :2], 1.0, 3.0)
    found = score(variants("", False)[TVIMM].models, estimates, Simulated(flights, case, np.zeros((4, 3))))
    assert not measured("peak", found).known
    assert not measured("quiet", found).known
    assert measured("manoeuvre", found).value == pytest.approx(np.sqrt(2.0))


def test_the_standard_error_is_that_of_runs_that_differ() -> None:
    rng = np.random.default_rng(7)
    n, off = 80, np.zeros((1, 80, 4))
    off[0, :, 0] = rng.normal(0.0, 10.0, n)
    flights = scored(off, [False], [-1])
    estimates = Estimates(off, np.tile(np.eye(4), (1, n, 1, 1)), np.full((1, n, 8), 0.125))
    case = Measured(flights.truth, off.swapaxes(0, 1)[..., :2], 1.0, 3.0)
    models = variants("", False)[TVIMM].models
    found = score(models, estimates, Simulated(flights, case, np.zeros((1, n))))
    value = measured("position", found)
    squares = off[0, :, 0] ** 2
    assert value.value == pytest.approx(np.sqrt(squares.mean()))
    assert value.std == pytest.approx(squares.std() / np.sqrt(n) / 2.0 / value.value, rel=0.12)
    # A filter that is always twice as far off scatters with it.
    twice = score(models, estimates._replace(mean=2.0 * off), Simulated(flights, case, np.zeros((1, n))))
    assert ratio("position", twice, found).value == pytest.approx(2.0)
    assert ratio("position", twice, found).std == pytest.approx(0.0, abs=1e-12)


def test_one_run_has_no_standard_error() -> None:
    single = Mean(np.ones((1, 1)), np.ones((1, 1)))
    assert single.over(np.ones((3, 1))).tolist() == [[1.0]] * 3
    found = measure((CELLS["T0"]._replace(name="once"),), 1, lambda _: None)
    assert found.value("once", "position").std is None


def test_means_of_ratios_are_geometric() -> None:
    mean = geometric_mean([Value(0.5, 0.05), Value(2.0, 0.1)])
    assert mean.value == pytest.approx(1.0)
    assert mean.std == pytest.approx(np.hypot(0.1, 0.05) / 2.0)


# --- claims, pictures, the whole ---


@pytest.mark.parametrize(
    ("low", "high", "bound", "holds"),
    [(-np.inf, 0.92, "<= 0.92", True), (0.95, np.inf, ">= 0.95", False), (0.85, 0.899, "0.85 to 0.899", False)],
)
def test_bounds_are_kept_or_not(low: float, high: float, bound: str, holds: bool) -> None:
    claim = Judged("a ratio", low, high, "", Value(0.9, 0.01))
    assert claim.bound == bound
    assert claim.holds is holds


def test_manoeuvres_on_the_time_axis() -> None:
    t_s, busy = np.arange(1.0, 8.0), np.array([0, 1, 1, 0, 0, 1, 1], float)
    assert spans(t_s, busy) == [(1.0, 3.0), (5.0, 7.0)]


def shortened() -> tuple[Cell, ...]:
    """All cells, with flights of a few scans."""
    return tuple(c if c.name == "T0" else c._replace(duration_s=max(60.0, 25.0 * c.period_s)) for c in CELLS.values())


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyResult, list[float]]:
    shares: list[float] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "all_cells", shortened)
        found = run(tmp_path_factory.mktemp("study") / "new", runs=3, progress=shares.append)
    return found, shares


def test_there_are_ten_cells_twenty_others_and_new_ones() -> None:
    names = list(CELLS)
    r = ["R1/10", "R1/30", "R1/100", "R2/30", "R4/10", "R4/30", "R4/100", "R10/30", "R10/100"]
    assert names[:10] == ["T0", *r]
    others = [name for name in names if name.startswith(("weave", "jink", "singer", "wna", "cv"))]
    assert len(others) == 20
    assert len(names) == 10 + 20 + 8 + 8


def test_rows_are_labelled_finite_and_json(short: tuple[StudyResult, list[float]], tmp_path: Path) -> None:
    short[0].write_json(tmp_path / "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())
    labels = [(r["table"], r["row"], r["column"]) for r in rows]
    assert len(set(labels)) == len(labels)
    assert {table for table, _, _ in labels} == {*CELLS, *(f"{n} Pd 0.8" for n, c in CELLS.items() if not c.radar)}
    assert {row for _, row, _ in labels} == {"position", "velocity", "peak", "anees"}
    for cell in ("T0", "R1/30", "R10/100 Pd 0.8", "weave4/30", "both2/30", "radar2/0.5 range rate"):
        for row in ("position", "velocity", "anees"):
            assert {c for t, r, c in labels if (t, r) == (cell, row)} >= {"tvimm", "imm", "branch A"}
    assert ("T0", "peak", "tvimm") in labels
    assert ("T0", "position", "branch A, lag 2") in labels
    assert ("R4/10", "anees", "branch A, whole steps") in labels
    assert not any(row == "peak" for table, row, _ in labels if table.startswith(("weave", "singer", "wna", "cv")))
    assert all(r["paper"] is None and r["runs"] == 3 and 0.0 < r["ours"] < 30.0 for r in rows)
    assert all(r["ours"] == 1.0 and r["ours_std"] == 0.0 for r in rows if r["column"] == "imm" and r["row"] != "anees")
    assert all(r["ours_std"] >= 0.0 for r in rows)


def test_everything_claimed_is_judged_and_nothing_hidden(short: tuple[StudyResult, list[float]]) -> None:
    found = short[0]
    assert all(len(row) == len(table.header) for table in found.tables for row in table.rows)
    claims = found.tables[0]
    assert claims.title.startswith("What is claimed")
    assert len(claims.rows) == 39
    missed = [row[0] for row in claims.rows if row[-1] == "NO"]
    # So few scans cannot settle all claims.
    assert missed
    assert found.notes[0].startswith(f"{39 - len(missed)} of 39 claims hold. Missed: ")
    assert all(text in found.notes[0] for text in missed)


def test_pictures_show_something(short: tuple[StudyResult, list[float]]) -> None:
    assert {p.name for p in short[0].pictures} == {
        f"manoeuvre_{n}.png" for n in ("ratios", "onset", "weight", "flight")
    }
    for picture in short[0].pictures:
        pixels = imread(picture)
        assert min(pixels.shape[:2]) > 600
        assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 100


def test_progress_reaches_the_end(short: tuple[StudyResult, list[float]]) -> None:
    assert short[1] == sorted(short[1])
    assert short[1][-1] == 1.0


def test_pictures_that_cannot_be_written_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "all_cells", shortened)
    (tmp_path / "file").write_text("")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        run(tmp_path / "file", runs=1)


def test_the_gain_is_there() -> None:
    """The first claims, with a third of the runs."""
    cells = tuple(cell for name, cell in CELLS.items() if name in ("T0", "wna2/30"))
    found = measure(cells, 20, lambda _: None)
    assert found.value("T0", "position").value <= 0.93
    assert found.value("T0", "velocity").value <= 0.88
    assert found.value("T0", "position", "branch A, nothing estimated", "branch A").value >= 1.04
    assert found.value("T0", "position", "branch A, lag 1", "branch A").value <= 0.78
    assert found.value("wna2/30", "velocity", "branch A").value > 1.08 > found.value("wna2/30", "velocity").value
