"""Frames of other units: what is wrong with them, and what they tell in our plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import COASTING, CONFIRMED, ENDED, UNKNOWN_HEIGHT_M2, Geodetic, TrackFrame
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.fusion.plane import place

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_FAR_M, _FAST_MPS = 1e9, 1e6
_SLACK = 1e-6
"""Covariances travel as float32: so much of each variance is added, or rounding could make them improper."""

_UPPER = np.array([[0, 1, 2, 3], [1, 6, 7, 8], [2, 7, 11, 12], [3, 8, 12, 15]])
"""Places of the covariance of position and velocity in the upper triangle of a 6x6 matrix."""


class Told(NamedTuple):
    """What a frame tells of the n tracks that its sender has confirmed, in our plane, at the frame's time.

    Attributes:
        ident: (n,) ids that the sender gives them.
        x, P: (n, 4), (n, 4, 4).
        updated_ns, first_ns: (n,) their last and first plots.
        coasting: (n,) whether the sender has no recent plot.
        fit: (n,) the sender's ``manoeuvre_fit``, 0 where it tells none.
        height_m, height_m2: (n,) height and its variance, which is that of an unknown one where there is none.
        echo: (n,) whether the sender knows the track from us alone.
        ended: (k,) ids of those that ended.
    """

    ident: IntArray
    x: FloatArray
    P: FloatArray
    updated_ns: IntArray
    first_ns: IntArray
    coasting: BoolArray
    fit: FloatArray
    height_m: FloatArray
    height_m2: FloatArray
    echo: BoolArray
    ended: IntArray


def read(frame: TrackFrame, our_unit: str) -> Told:
    """What a frame tells, in the plane of its sender.

    Raises:
        RefusedMessage: ``not_finite``, ``out_of_bounds``, ``invalid_covariance``, ``duplicate_track`` or
            ``future_update``: something in it cannot be, and all of it is refused.
    """
    keep = (frame.status == CONFIRMED) | (frame.status == COASTING)
    ident, x = frame.track_id[keep], np.ascontiguousarray(frame.state[keep, :4])
    P = np.ascontiguousarray(frame.covariance[keep].astype(np.float64)[:, _UPPER])
    updated_ns = frame.updated_t_ns[keep]
    _check(frame, ident, x, P, updated_ns)
    P[:, range(4), range(4)] *= 1.0 + _SLACK
    height, variance = _heights(frame)
    return Told(
        ident=ident,
        x=x,
        P=P,
        updated_ns=updated_ns,
        first_ns=frame.first_t_ns[keep],
        coasting=frame.status[keep] == COASTING,
        fit=np.zeros(len(ident)) if frame.manoeuvre_fit is None else frame.manoeuvre_fit[keep],
        height_m=height[keep],
        height_m2=variance[keep],
        echo=_only_from(frame, our_unit)[keep],
        ended=frame.track_id[frame.status == ENDED],
    )


def moved(told: Told, frame: TrackFrame, origin: Geodetic | None) -> Told:
    """The same in the plane of ``origin``; a plane without a geographic place is taken to be ours."""
    if origin is None or frame.origin is None or frame.origin == origin:
        return told
    offset_m, turn = place(frame.origin, origin)
    both = np.zeros((4, 4))
    both[:2, :2] = both[2:, 2:] = turn[:, :2]
    x = told.x @ both.T
    x[:, :2] += offset_m
    return told._replace(x=x, P=np.ascontiguousarray(both @ told.P @ both.T))


def _check(frame: TrackFrame, ident: IntArray, x: FloatArray, P: FloatArray, updated_ns: IntArray) -> None:
    unit = frame.unit_id
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise RefusedMessage("not_finite", f"A track of {unit} is not finite.")
    if (np.abs(x[:, :2]) > _FAR_M).any() or (np.abs(x[:, 2:]) > _FAST_MPS).any():
        raise RefusedMessage("out_of_bounds", f"A track of {unit} is farther or faster than anything.")
    wrong = first_improper(P, _SLACK)
    if wrong >= 0:
        raise RefusedMessage("invalid_covariance", f"The covariance of track {ident[wrong]} of {unit} is none.")
    if len(np.unique(ident)) < len(ident):
        raise RefusedMessage("duplicate_track", f"A frame of {unit} tells one track twice.")
    if (updated_ns > frame.t_ns).any():
        raise RefusedMessage("future_update", f"A track of {unit} has a last plot after the time of its frame.")


def _heights(frame: TrackFrame) -> tuple[FloatArray, FloatArray]:
    n = len(frame.track_id)
    if frame.height_m is None or frame.height_variance_m2 is None:
        return np.zeros(n), np.full(n, UNKNOWN_HEIGHT_M2)
    return frame.height_m, np.minimum(frame.height_variance_m2, UNKNOWN_HEIGHT_M2)


def _only_from(frame: TrackFrame, our_unit: str) -> BoolArray:
    """Which tracks have members in the column of our unit and in no other."""
    ours = np.array([name == our_unit for name in frame.sensors], np.bool_)
    have = frame.members >= 0
    return np.asarray(have[:, ours].any(axis=1) & ~have[:, ~ours].any(axis=1))


@kernel
def first_improper(P: FloatArray, slack: float) -> int:
    """Index of the first of (n, 4, 4) symmetric matrices that is no covariance, -1 where all are.

    A covariance is positive definite, with ``slack`` of each variance added to it.
    """
    L = np.empty((4, 4))
    for k in range(len(P)):
        for a in range(4):
            for b in range(a + 1):
                value = P[k, a, b]
                for c in range(b):
                    value -= L[a, c] * L[b, c]
                if a > b:
                    L[a, b] = value / L[b, b]
                    continue
                value += slack * P[k, a, a]
                if not value > 0.0:
                    return k
                L[a, a] = np.sqrt(value)
    return -1
