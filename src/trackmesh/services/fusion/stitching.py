"""Identity through gaps: a track that starts where one that was lost would be now goes on under its number.

A confirmed track without plots leaves the picture after ``coast_s``, but is told to have ended only when no new track
has taken over its number for ``stitch_s`` after its last plot. A new track may take the number of one whose last plot
is older than its own first one, ended or still coasting, when their states fit: with the old one predicted to now as
constant velocity with noise q, D = d^T (P + P')^-1 d is below the 0.999 quantile of chi-square with 4 degrees of
freedom. Among several the best fit counts, one to one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import TrackFrame
from trackmesh.services.estimation import assignment
from trackmesh.services.estimation.pairs import state_distances
from trackmesh.services.fusion import frames
from trackmesh.services.fusion.layer import Layer

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_GATE = 18.47


class Lost(NamedTuple):
    """Tracks that have had no plot for long, at their last plots: x (n, 4), P (n, 4, 4), t_s (n,), number (n,).

    ``first_s`` (n,) is when each began; ``words`` its last frame, which is told when it ends for good.
    """

    x: FloatArray
    P: FloatArray
    t_s: FloatArray
    number: IntArray
    first_s: FloatArray
    words: list[TrackFrame]


class Stitching:
    """The lost tracks of a unit.

    Args:
        system: the layer of system tracks.
        stitch_s: how long after its last plot a lost track can be taken over; 0: never.
        q_m2ps3: acceleration noise over the gap.

    Attributes:
        ours: which numbers (n,) may be taken over; those of tracks that another unit goes on with may not.
    """

    def __init__(self, system: Layer, stitch_s: float, q_m2ps3: float) -> None:
        self._system = system
        self._stitch_s = stitch_s
        self._q_m2ps3 = q_m2ps3
        self._lost = Lost(np.empty((0, 4)), np.empty((0, 4, 4)), np.empty(0), np.empty(0, np.int64), np.empty(0), [])
        self.ours: Callable[[IntArray], npt.NDArray[np.bool_]] = lambda number: np.ones(len(number), np.bool_)

    def __len__(self) -> int:
        return len(self._lost.words)

    @property
    def numbers(self) -> IntArray:
        """Public numbers (n,) of the lost tracks."""
        return self._lost.number

    def forget(self, numbers: IntArray) -> None:
        """Give up lost tracks of these numbers without a word: another unit goes on with them."""
        if len(self):
            self._keep(~np.isin(self._lost.number, numbers))

    def lose(self, rows: IntArray, words: TrackFrame) -> None:
        """Rows left the picture; ``words`` is what has to be told should they not come back."""
        ours = self.ours(self._system.life.link[rows])
        rows, words = rows[ours], frames.take(words, ours)
        if not len(rows):
            return
        x, P, t_s = self._last_states(rows)
        known, old = self._system.life, self._lost
        one_each = np.eye(len(rows), dtype=np.bool_)
        self._lost = Lost(
            np.concatenate([old.x, x]),
            np.concatenate([old.P, P]),
            np.concatenate([old.t_s, t_s]),
            np.concatenate([old.number, known.link[rows]]),
            np.concatenate([old.first_s, known.first_s[rows]]),
            old.words + [frames.take(words, one) for one in one_each],
        )

    def gone(self, now_s: float) -> list[TrackFrame]:
        """Last words of those that can be taken over no more."""
        over = now_s - self._lost.t_s >= self._stitch_s
        if not over.any():
            return []
        told = [words for words, ends in zip(self._lost.words, over.tolist(), strict=True) if ends]
        self._keep(~over)
        return told

    def take_over(self, new: IntArray, now_s: float) -> tuple[IntArray, IntArray, IntArray]:
        """Which of the newly confirmed rows go on for lost tracks.

        Returns:
            rows of ``new`` that do; the numbers they take; rows still coasting whose numbers these were, which the
            caller has to drop silently. ``first_s`` of the new rows is set.
        """
        nothing = np.empty(0, np.int64)
        if self._stitch_s <= 0.0 or not len(new):
            return nothing, nothing, nothing
        coasting = self._coasting(new)
        if not len(coasting) and not len(self):
            return nothing, nothing, nothing
        life = self._system.life
        x, P, t_s = self._last_states(coasting)
        x, P = np.concatenate([self._lost.x, x]), np.concatenate([self._lost.P, P])
        t_s = np.concatenate([self._lost.t_s, t_s])
        number = np.concatenate([self._lost.number, life.link[coasting]])
        first_s = np.concatenate([self._lost.first_s, life.first_s[coasting]])
        old, which = self._fitting(_ahead(x, P, now_s - t_s, self._q_m2ps3), t_s, new, now_s)
        life.first_s[new[which]] = first_s[old]
        lost = len(self)
        self._keep(~np.isin(np.arange(lost), old))
        return new[which], number[old], coasting[old[old >= lost] - lost]

    def kept(self) -> dict[str, npt.NDArray[Any]]:
        """What is to be known after a restart."""
        words = "\n".join(one.model_dump_json() for one in self._lost.words)
        arrays = {name: getattr(self._lost, name) for name in Lost._fields[:5]}
        return arrays | {"words": np.frombuffer(words.encode(), np.uint8)}

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on with what ``kept`` gave."""
        lines = arrays["words"].tobytes().decode().splitlines()
        words = [TrackFrame.model_validate_json(line) for line in lines]
        a = arrays
        self._lost = Lost(a["x"], a["P"], a["t_s"], a["number"], a["first_s"], words)

    def _coasting(self, new: IntArray) -> IntArray:
        """Confirmed rows without a plot since the earliest of the new ones began."""
        life = self._system.life
        rows = self._system.rows
        rows = rows[life.confirmed[rows] & (life.last_s[rows] < life.first_s[new].max())]
        rows = rows[~np.isin(rows, new)]
        return np.asarray(rows[self.ours(life.link[rows])])

    def _fitting(
        self, old: tuple[FloatArray, FloatArray], old_t_s: FloatArray, new: IntArray, now_s: float
    ) -> tuple[IntArray, IntArray]:
        """Best pairs of an old track, by index, and a new one, by index in ``new``."""
        x, P = old
        new_x, new_P, _ = self._system.predict(new, np.maximum(self._system.filters.t_s[new], now_s))
        i, j = (grid.ravel() for grid in np.meshgrid(np.arange(len(x)), np.arange(len(new)), indexing="ij"))
        before = old_t_s[i] < self._system.life.first_s[new[j]]
        i, j = i[before], j[before]
        distance, _ = state_distances(x, P, new_x, new_P, i, j, np.zeros((len(i), 2, 2)))
        fits = distance < _GATE
        i, j, score = i[fits], j[fits], _GATE - distance[fits] + 1e-6
        chosen = assignment.assign(i, j, score, len(x), len(new))
        which = np.flatnonzero(chosen >= 0)
        return chosen[which], which

    def _last_states(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        t_s = self._system.filters.t_s[rows]
        x, P, _ = self._system.predict(rows, t_s)
        return x, P, t_s

    def _keep(self, keep: npt.NDArray[np.bool_]) -> None:
        words = [one for one, stays in zip(self._lost.words, keep.tolist(), strict=True) if stays]
        old = self._lost
        self._lost = Lost(old.x[keep], old.P[keep], old.t_s[keep], old.number[keep], old.first_s[keep], words)


def _ahead(x: FloatArray, P: FloatArray, dt_s: FloatArray, q: float) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) after dt_s (n,), constant velocity."""
    n = len(x)
    F = np.tile(np.eye(4), (n, 1, 1))
    F[:, 0, 2] = F[:, 1, 3] = dt_s
    Q = np.zeros((n, 4, 4))
    for a in range(2):
        Q[:, a, a] = q * dt_s**3 / 3.0
        Q[:, a, a + 2] = Q[:, a + 2, a] = q * dt_s**2 / 2.0
        Q[:, a + 2, a + 2] = q * dt_s
    return (F @ x[:, :, None])[:, :, 0], F @ P @ np.swapaxes(F, 1, 2) + Q
