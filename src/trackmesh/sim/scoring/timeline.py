"""The truth between its frames."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import TruthFrame


class TruthTimeline:
    """The truth at any time between its first and its last frame.

    Raises:
        TrackmeshError: there is no frame.
    """

    def __init__(self, frames: Iterable[TruthFrame]) -> None:
        self.frames = sorted(frames, key=lambda frame: frame.t_ns)
        if not self.frames:
            raise TrackmeshError("The truth holds no frame, so there is nothing to score against.")
        self._t_ns = [frame.t_ns for frame in self.frames]
        self.first_ns, self.last_ns = self._t_ns[0], self._t_ns[-1]

    def nearest(self, t_ns: int) -> TruthFrame:
        """The frame nearest in time, the earlier of two."""
        i = bisect_left(self._t_ns, t_ns)
        around = self.frames[max(0, i - 1) : i + 1]
        return min(around, key=lambda frame: abs(frame.t_ns - t_ns))

    def at(self, t_ns: int) -> tuple[IntArray, FloatArray] | None:
        """Ids (n,) and states (n, 4) at ``t_ns``, or None outside the truth's time.

        Between two frames: the targets of both; positions by the cubic that has the right positions and
        velocities at either end, velocities linear.
        """
        if not self.first_ns <= t_ns <= self.last_ns:
            return None
        i = bisect_left(self._t_ns, t_ns)
        after = self.frames[i]
        if after.t_ns == t_ns:
            return after.id, after.state[:, :4]
        before = self.frames[i - 1]
        ids, a, b = np.intersect1d(before.id, after.id, return_indices=True)
        step_s = (after.t_ns - before.t_ns) * 1e-9
        part = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)
        return ids, _interpolate(before.state[a, :4], after.state[b, :4], step_s, part)


def _interpolate(before: FloatArray, after: FloatArray, step_s: float, part: float) -> FloatArray:
    u, v = part, 1.0 - part
    position = (
        v * v * (1.0 + 2.0 * u) * before[:, :2]
        + u * u * (1.0 + 2.0 * v) * after[:, :2]
        + step_s * u * v * (v * before[:, 2:] - u * after[:, 2:])
    )
    return np.concatenate([position, v * before[:, 2:] + u * after[:, 2:]], axis=1)
