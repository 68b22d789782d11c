"""Where simulated tags really are: one smooth way through given places, followed back and forth with stop and go.

The way is a cubic spline over the chord length; along it s(t) = v (t + (a T / 2 pi) (1 - cos(2 pi t / T))), which has
the mean speed v, swinging by the share a once in T. Near the ends, where it turns back, the distance y from the end
becomes sqrt(y^2 + turn^2), less what it is at the end and scaled to leave the middle where it is.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from trackmesh.protocol.arrays import FloatArray
from trackmesh.sim.scenario import Tags

_STEPS = 20_000
_GOLDEN = 0.6180339887498949


class TagPaths:
    """The ways of all tags of a scenario.

    Tag k (from 0) walks the path in one of the eight attitudes of its square, and begins at another point of it; tag 0
    walks it as it is, from its first place.

    Attributes:
        length_m: of the path.
    """

    def __init__(self, tags: Tags) -> None:
        self._tags = tags
        places = np.array(tags.path_enu_m, float)
        chords = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
        curve = CubicSpline(chords, places)(np.linspace(0.0, chords[-1], _STEPS + 1))
        self._curve = np.asarray(curve, float)
        self._way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self._curve, axis=0).T))])
        self.length_m = float(self._way[-1])
        # Of the square about the way: attitudes of it stay within.
        self._middle = 0.5 * (self._curve.min() + self._curve.max())
        self._last_s = self._time_at_end()

    @property
    def duration_s(self) -> float:
        """How long tag 0 walks from one end to the other."""
        return self._last_s

    def positions(self, t_s: float) -> FloatArray:
        """East and north (n, 2) of all tags at a time."""
        tag = np.arange(self._tags.count)
        return self.place(tag, np.full(len(tag), t_s))

    def place(self, tag: np.ndarray[tuple[int], np.dtype[np.int64]], t_s: FloatArray) -> FloatArray:
        """East and north (k, 2) of tags (k,), each at its time (k,)."""
        way = self._travelled(t_s) + 2.0 * self.length_m * np.mod(tag * _GOLDEN, 1.0)
        to_end = np.abs(np.mod(way, 2.0 * self.length_m) - self.length_m)
        from_start = self.length_m - to_end
        along = np.where(from_start < to_end, self._slowed(from_start), self.length_m - self._slowed(to_end))
        at = np.column_stack([np.interp(along, self._way, self._curve[:, axis]) for axis in range(2)])
        return np.asarray(self._turned(tag, at - self._middle) + self._middle)

    def _travelled(self, t_s: FloatArray) -> FloatArray:
        omega = 2.0 * np.pi / self._tags.stop_and_go_s
        swing = self._tags.stop_and_go / omega * (1.0 - np.cos(omega * t_s))
        return np.asarray(self._tags.speed_mps * (t_s + swing))

    def _slowed(self, way_m: FloatArray) -> FloatArray:
        """How far from an end a tag is that would be ``way_m`` from it without slowing down."""
        turn, half = self._tags.turn_m, 0.5 * self.length_m
        return np.asarray(half * (np.hypot(way_m, turn) - turn) / (np.hypot(half, turn) - turn))

    def _time_at_end(self) -> float:
        t_s = np.linspace(0.0, 2.0 * self.length_m / self._tags.speed_mps, _STEPS + 1)
        return float(np.interp(self.length_m, self._travelled(t_s), t_s))

    @staticmethod
    def _turned(tag: np.ndarray[tuple[int], np.dtype[np.int64]], at: FloatArray) -> FloatArray:
        east, north = at.T.copy()
        east = np.where(tag & 1, -east, east)
        north = np.where(tag & 2, -north, north)
        swapped = (tag & 4) != 0
        return np.column_stack([np.where(swapped, north, east), np.where(swapped, east, north)])
