"""The hard cases in short: one seed each, a minute or two of the two radars, against fixed bounds with slack.

``python -m benchmarks.fusion_cases`` runs them at full length over several seeds.
"""

from __future__ import annotations

from functools import cache

import pytest
from benchmarks.fusion_cases import Figures, run_case
from benchmarks.peer_cases import CASES
from tests.services.fusion.makers import peers_folder

SEED = 3


@cache
def figures(name: str, duration_s: float) -> Figures:
    return run_case(CASES[name], [SEED], {}, duration_s)[SEED]


@pytest.fixture(autouse=True)
def the_scenario_is_there() -> None:
    peers_folder()


def test_nominal() -> None:
    got = figures("nominal", 120.0)
    assert got["gospa_m"] <= 480 and got["rmse_m"] <= 68
    assert got["kept_pct"] == 100 and got["switches"] == 0
    assert 1.2 < got["nees"] < 2.5
    assert got["pairs_right_pct"] >= 99.9 and got["paired_pct"] >= 98
    assert got["start_missed_pct"] <= 1


@pytest.mark.parametrize("name", ["bias-150", "bias-300"])
def test_a_bias_costs_nothing(name: str) -> None:
    got, nominal = figures(name, 120.0), figures("nominal", 120.0)
    assert got["gospa_m"] <= 1.02 * nominal["gospa_m"]
    assert got["bias_m"] <= 30 and got["bias_deg"] <= 0.06
    assert got["kept_pct"] == 100
    assert got["pairs_right_pct"] >= 99.9


def test_without_registration_the_bias_is_seen() -> None:
    got = figures("bias-unregistered", 100.0)
    assert got["gospa_m"] > 1000 and got["nees"] > 5


def test_a_bias_that_appears_is_learnt() -> None:
    got = figures("bias-step", 200.0)
    assert got["gospa_m"] <= 540
    assert got["bias_m"] <= 30 and got["bias_deg"] <= 0.06


def test_misses_and_clutter() -> None:
    assert figures("pd-70", 120.0)["gospa_m"] <= 680
    assert figures("clutter-200", 100.0)["gospa_m"] <= 500
    both = figures("pd-70-clutter-200", 200.0)
    assert both["gospa_m"] <= 950 and both["missed"] <= 1 and both["false"] <= 3


def test_formations_are_kept_apart() -> None:
    for name in ("formation", "formation-bias"):
        got = figures(name, 100.0)
        assert got["gospa_m"] <= 500 and got["switches"] <= 6, name
        assert got["pairs_right_pct"] >= 97 and got["paired_pct"] >= 90, name


def test_crossing_targets_keep_their_names() -> None:
    got = figures("crossing", 150.0)
    assert got["gospa_m"] <= 500 and got["kept_pct"] >= 92


def test_a_radar_may_die_for_a_while() -> None:
    assert figures("radar-dead", 150.0)["kept_pct"] >= 98


@pytest.mark.parametrize("name", ["unseen-20", "blackout"])
def test_a_gap_of_fifteen_seconds_is_bridged(name: str) -> None:
    assert figures(name, 150.0)["kept_pct"] >= 90


def test_a_thousand_targets_under_a_bias() -> None:
    got = figures("bias-1000", 60.0)
    assert got["missed_pct"] <= 2 and got["start_missed_pct"] <= 20
    assert got["bias_m"] <= 30 and got["bias_deg"] <= 0.06
    assert got["pairs_right_pct"] >= 99.5 and got["paired_pct"] >= 97


def test_a_third_sensor_helps() -> None:
    assert figures("third-sensor", 100.0)["gospa_m"] <= 420


def test_five_targets_are_enough_to_learn_a_bias() -> None:
    got = figures("bias-5", 200.0)
    assert got["rmse_m"] <= 85 and got["false"] <= 0.1


def test_batches_may_overtake_each_other() -> None:
    got = figures("late", 120.0)
    assert got["gospa_m"] <= 520 and got["kept_pct"] >= 98


def test_sectors() -> None:
    got = figures("sectors-32-bias", 200.0)
    assert got["gospa_m"] <= 600 and got["switches"] <= 2 and got["kept_pct"] >= 98
