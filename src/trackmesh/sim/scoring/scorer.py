"""Frames scored one by one as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from trackmesh.protocol.messages import TrackFrame, TruthFrame
from trackmesh.sim.metrics import Followers
from trackmesh.sim.scoring.frames import Compared, FrameScore, ScoreRules, compare, frame_score
from trackmesh.sim.scoring.picture import picture
from trackmesh.sim.scoring.summary import ScoreSummary, summarise
from trackmesh.sim.scoring.timeline import TruthTimeline

Progress = Callable[[int], None]


class Scorer:
    """Scores frames one by one as they come, and sums them up.

    ``warmup_s`` counts from the truth's first frame; frames before its end tell who followed whom, and no more. A
    change of assignment costs ``switch_m`` (default: half the cut-off), and a track farther than ``gate_m`` (default:
    the cut-off) from every target is spurious.

    Attributes:
        scores, compared: every frame that has a truth, the warm-up among them, and what it was made of.
        rules: how frames are scored.
    """

    def __init__(
        self,
        truth: TruthTimeline,
        c_m: float = 1000.0,
        warmup_s: float = 40.0,
        switch_m: float | None = None,
        gate_m: float | None = None,
    ) -> None:
        self.rules = ScoreRules(c_m, 0.5 * c_m if switch_m is None else switch_m, c_m if gate_m is None else gate_m)
        self.scores: list[FrameScore] = []
        self.compared: list[Compared] = []
        self._truth = truth
        self._warm_ns = truth.first_ns + round(warmup_s * 1e9)
        self._without_truth = 0
        self._shown: set[int] = set()
        self._followers = Followers()

    def add(self, frame: TrackFrame) -> FrameScore | None:
        """Score one frame; None where there is no truth."""
        truth = self._truth.at(frame.t_ns)
        if truth is None:
            self._without_truth += 1
            return None
        shown, scored = picture(frame), frame.t_ns >= self._warm_ns
        found = compare(*truth, shown, self.rules)
        changed = self._followers.step(found.present, found.target_id, found.track_id)
        score = frame_score(frame.t_ns, scored, found, changed, self.rules)
        self.scores.append(score)
        self.compared.append(found)
        if scored:
            self._shown.update(shown.track_id.tolist())
        return score

    def summary(self) -> ScoreSummary:
        """What the frames so far come to."""
        return summarise(self.scores, self.compared, self.rules, self._without_truth, len(self._shown))


def score_run(
    frames: Iterable[TrackFrame],
    truth: Iterable[TruthFrame],
    c_m: float = 1000.0,
    warmup_s: float = 40.0,
    progress: Progress | None = None,
    *,
    switch_m: float | None = None,
    gate_m: float | None = None,
) -> Scorer:
    """Score frames against the truth interpolated to their times; the scorer has their scores and sums them up.

    ``progress`` is called with the number of frames done.

    Raises:
        TrackmeshError: the truth is empty.
    """
    scorer = Scorer(TruthTimeline(truth), c_m, warmup_s, switch_m, gate_m)
    for done, frame in enumerate(frames, 1):
        scorer.add(frame)
        if progress is not None:
            progress(done)
    return scorer


def score_tracks(
    frames: Iterable[TrackFrame],
    truth: Iterable[TruthFrame],
    c_m: float = 1000.0,
    warmup_s: float = 40.0,
    progress: Progress | None = None,
) -> ScoreSummary:
    """What ``score_run`` comes to; see ``ScoreSummary`` for what is computed.

    Raises:
        TrackmeshError: the truth is empty.
    """
    return score_run(frames, truth, c_m, warmup_s, progress).summary()
