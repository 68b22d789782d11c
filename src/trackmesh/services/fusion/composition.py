"""The picture of system tracks and foreign ones together: one estimate of each target, by covariance intersection.

Nobody knows how far two units' errors are the same (a sensor that both hear, a track that went round), so nothing else
is sound. Both estimates are predicted to the time of the picture first; a foreign one by constant velocity.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import COASTING, CONFIRMED, ENDED, UNKNOWN_HEIGHT_M2, TrackFrame
from trackmesh.services.estimation.intersection import intersect
from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.fusion import frames
from trackmesh.services.fusion.foreign import Rows
from trackmesh.services.fusion.inputs import Inputs

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_CLIMB_MPS = 10.0
"""How targets climb, one sigma, while their height is not told again."""

_SILENT_SHARE = 1.0 / 3.0
"""A track not told for this share of ``coast_s`` coasts."""


class Composition:
    """Puts what the inputs know into frames.

    Whatever stands in the picture has a number in the test of pairs, see ``Inputs``; foreign tracks with that number as
    their partner belong to it.
    """

    def __init__(self, inputs: Inputs) -> None:
        self._inputs = inputs

    def fuse(self, numbers: IntArray, x: FloatArray, P: FloatArray, t_s: float) -> tuple[FloatArray, FloatArray]:
        """States (n, 4) and covariances (n, 4, 4) at a time, each together with those of its partners."""
        x, P = x.copy(), P.copy()
        for bank in self._inputs.banks.values():
            which = index_of(bank.rows.partner, numbers)
            have = which >= 0
            if have.any():
                theirs = bank.rows.take(which[have]).at(t_s, self._inputs.rules.q_m2ps3)
                x[have], P[have], _ = intersect(x[have], P[have], *theirs)
        return x, P

    def complete(self, frame: TrackFrame, numbers: IntArray, t_s: float) -> TrackFrame:
        """The frame of what has these numbers, with what the inputs add: a column each, plots, freshness."""
        banks = self._inputs.banks
        status = frame.status.copy()
        updated, first = frame.updated_t_ns.copy(), frame.first_t_ns.copy()
        members = np.full((len(numbers), len(banks)), -1, np.int64)
        height, variance = _heights(frame)
        for k, bank in enumerate(banks.values()):
            which = index_of(bank.rows.partner, numbers)
            have = np.flatnonzero(which >= 0)
            theirs = bank.rows.take(which[have])
            members[have, k] = theirs.ident
            updated[have] = np.maximum(updated[have], theirs.updated_ns)
            first[have] = np.minimum(first[have], theirs.first_ns)
            their_variance = theirs.height_m2 + (_CLIMB_MPS * (t_s - theirs.t_s)) ** 2
            better = their_variance < variance[have]
            height[have[better]], variance[have[better]] = theirs.height_m[better], their_variance[better]
            fresh = have[~self._coasting(theirs, t_s)]
            status[fresh] = np.where(status[fresh] == COASTING, CONFIRMED, status[fresh])
        known = bool((variance < UNKNOWN_HEIGHT_M2).any())
        return frame.model_copy(
            update={
                "status": status,
                "height_m": height if known else None,
                "height_variance_m2": variance if known else None,
                "sensors": [*banks, *frame.sensors],
                "members": np.concatenate([members, frame.members], axis=1),
                "updated_t_ns": updated,
                "first_t_ns": first,
            }
        )

    def alone(self, blank: TrackFrame, t_s: float) -> list[TrackFrame]:
        """The foreign tracks that stand in the picture by themselves, as frames like ``blank``, which has no tracks."""
        out = []
        for unit, bank in self._inputs.banks.items():
            rows = bank.rows.take((bank.rows.link >= 0) & (bank.rows.first_ns <= blank.t_ns))
            if len(rows.ident):
                out.append(self._frame(blank, unit, rows, t_s))
        return out

    def last_words(self, blank: TrackFrame, unit: str, rows: Rows, t_s: float) -> TrackFrame:
        """Foreign tracks that stood in the picture and end."""
        frame = self._frame(blank, unit, rows, t_s)
        return frame.model_copy(update={"status": np.full(len(rows.ident), ENDED, np.uint8)})

    def _frame(self, blank: TrackFrame, unit: str, rows: Rows, t_s: float) -> TrackFrame:
        n = len(rows.ident)
        own_columns = blank.members.shape[1] - len(self._inputs.banks)
        state, covariance = frames.pack_states(*self.fuse(rows.number, *rows.at(t_s, self._inputs.rules.q_m2ps3), t_s))
        bare = blank.model_copy(
            update={
                "track_id": rows.link,
                "epoch": np.zeros(n, "<u4"),
                "status": np.where(self._coasting(rows, t_s), COASTING, CONFIRMED).astype(np.uint8),
                "state": state,
                "covariance": covariance,
                "height_m": rows.height_m,
                "height_variance_m2": rows.height_m2,
                "model_probability": np.zeros((n, len(blank.models))),
                "manoeuvre_fit": None if blank.manoeuvre_fit is None else rows.fit,
                "sensors": blank.sensors[len(self._inputs.banks) :],
                "members": np.full((n, own_columns), -1, np.int64),
                "updated_t_ns": rows.updated_ns,
                "first_t_ns": rows.first_ns,
            }
        )
        frame = self.complete(bare, rows.number, t_s)
        frame.members[:, list(self._inputs.banks).index(unit)] = rows.ident
        return frame

    def _coasting(self, rows: Rows, t_s: float) -> npt.NDArray[np.bool_]:
        return np.asarray(rows.coasting | (t_s - rows.t_s > _SILENT_SHARE * self._inputs.rules.coast_s))


def _heights(frame: TrackFrame) -> tuple[FloatArray, FloatArray]:
    """Heights (n,) and variances (n,) of a frame, to be written."""
    if frame.height_m is None or frame.height_variance_m2 is None:
        n = len(frame.track_id)
        return np.zeros(n), np.full(n, UNKNOWN_HEIGHT_M2)
    return frame.height_m.copy(), frame.height_variance_m2.copy()
