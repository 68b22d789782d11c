"""Real recordings keep their scores, one set of constants for each kind of sensor."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.recordings import Recording, recordings, track

EVERY = {recording.name: recording for recording in recordings()}

HIGHEST: dict[str, tuple[float, float, float]] = {
    "Autoferry 2": (22.5, 5.05, 0.955),
    "Autoferry 6": (34.5, 8.2, 0.733),
    "Joyride": (68.5, 30.0, 0.991),
}
"""GOSPA and RMSE (m) that are not exceeded, and the coverage that is reached."""


@pytest.mark.parametrize("name", HIGHEST)
def test_scores(name: str) -> None:
    if name not in EVERY:
        pytest.skip(f"the recording {name} is not here")
    gospa_m, rmse_m, coverage = HIGHEST[name]
    found = track(EVERY[name]).summary
    assert found.gospa_m <= gospa_m
    assert found.rmse_m <= rmse_m
    assert found.coverage >= coverage


@pytest.mark.skipif("Autoferry 2" not in EVERY, reason="the Autoferry recordings are not here")
def test_the_score_can_get_worse() -> None:
    """Models of aircraft do not suit boats."""
    assert track(EVERY["Autoferry 2"], {"q_m2ps3": [50.0, 500.0]}).summary.rmse_m > HIGHEST["Autoferry 2"][1]


def test_scenarios_lie_in_one_folder_or_in_one_each(tmp_path: Path) -> None:
    for path in (tmp_path / "scenario3_detections.json", tmp_path / "scenario13" / "scenario13_detections.json"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("[]")
    found: list[Recording] = [one for one in recordings(tmp_path) if one.name != "Joyride"]
    assert [one.name for one in found] == ["Autoferry 3", "Autoferry 13"]
    assert found[1].peer == {"rmse_m": 3.7, "coverage": 0.797}
