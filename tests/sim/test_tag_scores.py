"""Scores of located tags, against the arithmetic by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import LOCATED, LOST, TagFrame, TruthFrame
from trackmesh.sim.tag_scores import TagTruth, score_tags

S = 1_000_000_000
T0 = 1_700_000_000 * S


def truth() -> TagTruth:
    """Tag 1 goes east at 2 m/s, tag 7 stands."""
    return TagTruth(
        TruthFrame(
            scenario_id="s",
            t_ns=T0 + k * S,
            id=np.array([1, 7]),
            state=np.array([[2.0 * k, 0.0, 2.0, 0.0], [5.0, 5.0, 0.0, 0.0]]),
        )
        for k in range(5)
    )


def frame(t_s: float, tags: dict[str, tuple[float, float]], status: int = LOCATED, variance: float = 1.0) -> TagFrame:
    n = len(tags)
    state, covariance = np.zeros((n, 6)), np.zeros((n, 21), np.float32)
    state[:, :2] = np.array(list(tags.values())).reshape(-1, 2)
    covariance[:, [0, 6]] = variance
    return TagFrame(
        unit_id="main",
        boot_id="b",
        seq=0,
        t_ns=T0 + round(t_s * S),
        tag_id=list(tags),
        status=np.full(n, status, np.uint8),
        state=state,
        covariance=covariance,
        quality=np.ones(n),
        certainty=np.ones(n),
        other=state[:, :2],
        readers=[],
        used=np.empty((0, 2), np.uint32),
        updated_t_ns=np.full(n, T0),
    )


def test_errors_are_those_at_the_time_of_the_frame() -> None:
    frames = [frame(0.5, {"tag-1": (1.0, 3.0), "tag-7": (5.0, 5.0)}, variance=4.0), frame(2.25, {"tag-1": (8.5, 0.0)})]
    one, seven = score_tags(frames, truth())
    assert (one.tag, one.frames, one.located) == ("tag-1", 2, 1.0)
    # 3 m off at 0.5 s, 4 m at 2.25 s.
    assert one.rms_m == pytest.approx(math.sqrt((9 + 16) / 2)) and one.worst_m == pytest.approx(4.0)
    assert one.median_m == pytest.approx(3.5)
    assert one.nees == pytest.approx((9 / 4 + 16) / 2 / 2)
    assert seven.rms_m == 0.0


def test_only_where_a_tag_is_located_its_error_counts() -> None:
    frames = [frame(0.0, {"tag-7": (5.0, 6.0)}), frame(1.0, {"tag-7": (500.0, 5.0)}, LOST)]
    (score,) = score_tags(frames, truth())
    assert score.located == 0.5 and score.rms_m == 1.0
    (never,) = score_tags(frames[1:], truth())
    assert never.located == 0.0 and math.isnan(never.rms_m)


def test_what_the_truth_does_not_know_is_left_out() -> None:
    known = truth()
    assert known.at("tag-9", T0) is None and known.at("forklift", T0) is None
    assert known.at("tag-1", T0 + 5 * S) is None and known.at("tag-1", T0 - 1) is None
    with pytest.raises(TrackmeshError, match="named after its target"):
        score_tags([frame(0.0, {"forklift": (0.0, 0.0)})], known)
    with pytest.raises(TrackmeshError):
        score_tags([], TagTruth([]))
