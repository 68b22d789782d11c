"""Recorded or live pictures scored against the truth.

A frame is scored as it stands: the confirmed and coasting tracks it holds, at its own time. Two methods exist,
since two are in use: ``score_tracks`` (simulated truth, all targets known, GOSPA cut-off of a kilometre) and
``score_nearest`` (recordings in which only some of what is seen has a truth).
"""

from trackmesh.sim.scoring.frames import Compared, FrameScore, ScoreRules
from trackmesh.sim.scoring.nearest import NearestSummary, score_nearest
from trackmesh.sim.scoring.picture import Picture, picture
from trackmesh.sim.scoring.scorer import Scorer, score_run, score_tracks
from trackmesh.sim.scoring.series import write_series
from trackmesh.sim.scoring.summary import ScoreSummary, pairs_of, presence
from trackmesh.sim.scoring.timeline import TruthTimeline

__all__ = [
    "Compared",
    "FrameScore",
    "NearestSummary",
    "Picture",
    "ScoreRules",
    "ScoreSummary",
    "Scorer",
    "TruthTimeline",
    "pairs_of",
    "picture",
    "presence",
    "score_nearest",
    "score_run",
    "score_tracks",
    "write_series",
]
