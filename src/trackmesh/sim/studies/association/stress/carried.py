"""What becomes of the errors of local tracks from one association cycle to the next, for cross-covariances.

The recursion P_ab <- (I - K_a H)(F P_ab F^T + Q)(I - K_b H)^T wants a gain and a process noise of each filter. A filter
of several models has neither; taken here are those of the Kalman filter that would have its moment-matched covariances:

    Q = P- - F P F^T        M = P+ (P-)^-1 in place of I - K H

with what is not positive left out. Over a cycle an error e becomes A e + B w + noise of its own, where w is noise that
both filters suffer: P_ab <- A_a P_ab A_b^T + B_a B_b^T. The joint covariance of both errors stays a covariance, and so
does P_a + P_b - P_ab - P_ab^T. Common noise comes in parts, one before each update of a cycle and one after the last;
the parts of two filters are taken as the same noise in turn, which is exact where both radars see a target at once.
"""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.arrays import FloatArray, IntArray

_PARTS = 3


class Carried:
    """Of n tracks: P (n, 4, 4) and its time, A (n, 4, 4) and B (n, 4, 12) since the last cycle."""

    def __init__(self, n: int) -> None:
        self.P = np.tile(np.eye(4), (n, 1, 1))
        self.t_s = np.zeros(n)
        self.A, self.B = np.empty((n, 4, 4)), np.empty((n, 4, 4 * _PARTS))
        self._part = np.empty(n, np.int64)
        self.renew()

    def renew(self) -> None:
        """A new cycle begins."""
        self.A[:], self.B[:], self._part[:] = np.eye(4), 0.0, 0

    def begin(self, rows: IntArray, t_s: FloatArray, P: FloatArray) -> None:
        """Tracks begin with these covariances."""
        self.P[rows], self.t_s[rows] = P, t_s

    def predict(self, rows: IntArray, t_s: FloatArray, P: FloatArray) -> None:
        """Tracks are predicted to ``t_s`` (m,), where their covariances are P (m, 4, 4)."""
        F = moved(t_s - self.t_s[rows])
        noise = P - F @ self.P[rows] @ np.swapaxes(F, 1, 2)
        self.A[rows], B = F @ self.A[rows], F @ self.B[rows]
        part = np.minimum(self._part[rows], _PARTS - 1)
        columns = 4 * part[:, None, None] + np.arange(4)
        # The symmetric root: equal noise of two filters is then one noise, component by component.
        added = np.take_along_axis(B, np.broadcast_to(columns, (len(rows), 4, 4)), axis=2) + positive_root(noise)
        np.put_along_axis(B, np.broadcast_to(columns, (len(rows), 4, 4)), added, axis=2)
        self.B[rows] = B
        self._part[rows] += 1
        self.P[rows], self.t_s[rows] = P, t_s

    def update(self, rows: IntArray, P: FloatArray) -> None:
        """Tracks are updated, which makes their covariances P (m, 4, 4)."""
        M = left_of(self.P[rows], P)
        self.A[rows], self.B[rows], self.P[rows] = M @ self.A[rows], M @ self.B[rows], P


def moved(dt_s: FloatArray) -> FloatArray:
    """Transitions (n, 4, 4) of constant velocity over intervals (n,)."""
    F = np.tile(np.eye(4), (len(dt_s), 1, 1))
    F[:, 0, 2] = F[:, 1, 3] = dt_s
    return F


def positive_root(Q: FloatArray) -> FloatArray:
    """The symmetric root of the positive part of symmetric matrices (n, d, d)."""
    value, vector = np.linalg.eigh(0.5 * (Q + np.swapaxes(Q, 1, 2)))
    return np.asarray((vector * np.sqrt(np.maximum(value, 0.0))[:, None]) @ np.swapaxes(vector, 1, 2))


def left_of(before: FloatArray, after: FloatArray) -> FloatArray:
    """M = P+ (P-)^-1 (n, d, d), where an update may not make an error larger: I - K H of a Kalman filter."""
    L = np.linalg.cholesky(before)
    half = np.linalg.solve(L, after)
    ratio = np.linalg.solve(L, np.swapaxes(half, 1, 2))
    value, vector = np.linalg.eigh(0.5 * (ratio + np.swapaxes(ratio, 1, 2)))
    inner = (vector * np.clip(value, 0.0, 1.0)[:, None]) @ np.swapaxes(vector, 1, 2)
    return np.asarray(L @ np.swapaxes(np.linalg.solve(np.swapaxes(L, 1, 2), inner), 1, 2))
