"""The benchmark that other trackers were measured with: two radars, 50 targets, clutter."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tests.services.fusion.makers import POLAR, batch, engine, ids, peers_folder, radar

PEERS = {2: 610.0, 3: 539.0}
"""GOSPA in metres of the best peer (Stone Soup, global nearest neighbour) by seed."""


def peer_module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"peer_{name}", peers_folder() / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look their module up by name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def tracked(scene: Any) -> list[tuple[float, list[int], Any]]:
    """What the scoring wants: (time, ids, positions) after every scan."""
    sensors = [
        radar(
            r.name, r.east, r.north, period_s=r.period_s, p_detect=r.p_detect, max_range_m=r.max_range_m,
            sigma={"range_m": r.sigma_range_m, "azimuth_rad": r.sigma_azimuth_rad},
        )
        for r in scene.radars
    ]  # fmt: skip
    tracker, out = engine(*sensors), []
    for scan in scene.scans:
        values = np.stack([scan.range_m, scan.azimuth_rad], axis=1)
        frame = tracker.plots(batch(scene.radars[scan.radar].name, scan.time_s, values, POLAR))
        assert frame is not None
        assert len(ids(frame)) == len(frame.track_id)
        alive = frame.status != 3
        out.append((scan.time_s, frame.track_id[alive].tolist(), frame.state[alive, :2]))
    return out


@pytest.mark.parametrize("seed", sorted(PEERS))
def test_better_than_the_best_peer_by_a_tenth(seed: int) -> None:
    scenario, score = peer_module("scenario"), peer_module("score")
    scene = scenario.make(seed)
    result = score.score(tracked(scene), scene)
    assert result["gospa_m"] <= 0.9 * PEERS[seed]
    assert result["rmse_m"] <= 73.0
    assert result["id_switches"] <= 6
