"""What a frame shows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray
from trackmesh.protocol.messages import COASTING, CONFIRMED, TrackFrame

_FIRST_FOUR = np.array([[0, 1, 2, 3], [1, 6, 7, 8], [2, 7, 11, 12], [3, 8, 12, 15]])
"""Where a frame's row of covariance, the upper triangle of a 6 x 6 matrix, has position and velocity."""


class Picture(NamedTuple):
    """The confirmed and coasting tracks (n,) of a frame.

    Attributes:
        track_id: (n,).
        position_m, velocity_mps: (n, 2).
        covariance_m2: (n, 2, 2) of the position. state_covariance: (n, 4, 4) of position and velocity.
        coasting: (n,) whether the track is without plots.
    """

    track_id: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    covariance_m2: FloatArray
    state_covariance: FloatArray
    coasting: npt.NDArray[np.bool_]


def picture(frame: TrackFrame) -> Picture:
    """The confirmed and coasting tracks of a frame."""
    shown = np.flatnonzero((frame.status == CONFIRMED) | (frame.status == COASTING))
    state, covariance = frame.state[shown], frame.covariance[shown].astype(np.float64)[:, _FIRST_FOUR]
    coasting = np.asarray(frame.status[shown] == COASTING)
    return Picture(frame.track_id[shown], state[:, :2], state[:, 2:4], covariance[:, :2, :2], covariance, coasting)
