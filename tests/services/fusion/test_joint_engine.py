"""Joint association in the engine: close targets in clutter, and who may choose it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from pydantic import ValidationError
from tests.services.fusion.makers import (
    EAST,
    FAR_APART,
    NORTH,
    START_NS,
    Fleet,
    drive,
    engine,
    fleet,
    in_time_order,
    ns,
    scans,
    seen,
)

from trackmesh.protocol.codec import encode
from trackmesh.protocol.messages import PlotBatch, SensorInfo, TrackFrame
from trackmesh.services.fusion.engine import FusionEngine
from trackmesh.services.fusion.settings import EngineSettings

CROSSING = fleet((-6e3, 30e3, 120.0, 25.0), (-6e3, 32.5e3, 120.0, -25.0))
"""Two targets that meet after 50 s and are within 200 m of each other for 8 s."""

ABREAST = fleet((-6e3, 30e3, 120.0, 0.0), (-6e3, 30.3e3, 120.0, 0.0))
"""Two targets 300 m beside each other, all the time."""

UNTIL_S = 100.0


def in_clutter(info: SensorInfo, targets: Fleet, seed: int, offset_s: float) -> Iterator[PlotBatch]:
    """Looks that miss one plot of ten, with false plots around the targets."""
    rng = np.random.default_rng(seed)
    for seq, t in enumerate(np.arange(offset_s, UNTIL_S, info.period_s).tolist()):
        place = targets.at(t)
        true = place[rng.random(len(place)) < 0.9]
        false = place.mean(axis=0) + rng.uniform(-2e3, 2e3, (rng.poisson(4.0), 2))
        noise = np.concatenate((rng.standard_normal(true.shape), np.zeros(false.shape)))
        yield seen(info, t, np.concatenate((true, false)), noise, seq=seq)


def looks(targets: Fleet, seed: int) -> list[PlotBatch]:
    return in_time_order(in_clutter(NORTH, targets, seed, 0.0), in_clutter(EAST, targets, seed + 100, 0.7))


def tracked(batches: list[PlotBatch], plot_assignment: str) -> tuple[FusionEngine, list[TrackFrame]]:
    tracker = engine(NORTH, EAST, registration=False, plot_assignment=plot_assignment)
    return tracker, drive(tracker, batches)


def followers(frame: TrackFrame, targets: Fleet) -> list[int]:
    """Ids of the tracks nearest to each target."""
    place = targets.at((frame.t_ns - START_NS) * 1e-9)
    distance = np.linalg.norm(frame.state[:, None, :2] - place, axis=2)
    return [int(frame.track_id[k]) for k in distance.argmin(axis=0)]


def identities_kept(targets: Fleet, plot_assignment: str) -> int:
    """Of 24 targets, two a seed, how many have at the end the track of their own that they had after 40 s."""
    kept = 0
    for seed in range(12):
        _, frames = tracked(looks(targets, seed), plot_assignment)
        early = next(frame for frame in frames if frame.t_ns >= ns(40.0))
        then, now = followers(early, targets), followers(frames[-1], targets)
        kept += sum(a == b and then.count(a) == 1 for a, b in zip(then, now, strict=True))
    return kept


@pytest.mark.parametrize("targets", [CROSSING, ABREAST], ids=["crossing", "abreast"])
def test_close_targets_in_clutter_keep_their_tracks(targets: Fleet) -> None:
    joint, nearest = identities_kept(targets, "joint"), identities_kept(targets, "nearest")
    assert joint >= 20, (joint, nearest)
    assert joint > nearest


def test_the_same_plots_give_the_same_frames() -> None:
    batches = looks(ABREAST, 3)
    batches[20], batches[21] = batches[21], batches[20]
    _, once = tracked(batches, "joint")
    _, again = tracked(batches, "joint")
    assert [encode(f) for f in once] == [encode(f) for f in again]


def test_the_status_tells_how_often() -> None:
    joint, frames = tracked(looks(ABREAST, 3), "joint")
    nearest, others = tracked(looks(ABREAST, 3), "nearest")
    assert joint.figures()["joint_clusters"] > 10
    assert joint.figures()["joint_too_large"] == 0
    assert "joint_clusters" not in nearest.figures()
    assert frames != others


def test_targets_far_apart_are_tracked_as_ever() -> None:
    """Bit for bit, where no track shares a plot and none has two to choose from."""
    batches = in_time_order(scans(NORTH, FAR_APART, 60.0), scans(EAST, FAR_APART, 60.0, offset_s=0.7, seed=2))
    frames = [drive(engine(NORTH, EAST, plot_assignment=name), batches) for name in ("joint", "nearest")]
    assert [encode(f) for f in frames[0]] == [encode(f) for f in frames[1]]


def test_alpha_beta_takes_plots_one_to_one_only() -> None:
    with pytest.raises(ValidationError, match="alpha-beta takes plots one to one"):
        EngineSettings(filter="alpha-beta", plot_assignment="joint")
    EngineSettings(local_filter="alpha-beta", plot_assignment="joint")
