"""What the tests of tags share: readers, filters, ranges, dense reference formulas."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import settings
from hypothesis import strategies as st

from trackmesh.services.tags import singer
from trackmesh.services.tags.filtering import begin
from trackmesh.services.tags.records import RANGE, Describe, Records, make_filters, make_rules, make_work

FloatArray = npt.NDArray[np.float64]

LAW = settings(deadline=None, max_examples=60)
"""Kernels may have to be compiled in the first example, hence no deadline."""

NEVER = 1e9
PLAIN: dict[str, Any] = {"doubt_long": NEVER, "doubt_short": NEVER}
"""No range is doubted."""

SQUARE = np.array([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [40.0, 40.0, 0.0], [0.0, 40.0, 0.0]])
"""Four readers."""

LINE = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [45.0, 0.0, 0.0]])
"""Three readers along a wall."""

seeds = st.integers(0, 2**32 - 1)


class One:
    """One filter by its own rules, with scratch."""

    def __init__(self, **description: Any) -> None:
        self.rules = make_rules(Describe(**description))
        self.work = make_work(self.rules)
        self.filters = make_filters(self.rules, 1)

    @property
    def f(self) -> Any:
        return self.filters[0]

    def begin(self, east: float = 0.0, north: float = 0.0, sigma: float = 3.0, t_s: float = 0.0) -> One:
        begin(self.rules[0], self.f, t_s, east, north, np.array([sigma**2, 0.0, sigma**2]))
        return self

    def set(self, x: FloatArray, P: FloatArray) -> One:
        """State and covariance of all models."""
        self.f.x[:], self.f.P[:] = x, P
        return self


def ranges(*rows: tuple[float, ...], sigma: float = 1.0, row: int = 0) -> Records:
    """Ranges of (time, reader, metres), all of one tag and with one noise."""
    out = np.zeros(len(rows), RANGE)
    out["row"], out["variance"] = row, sigma**2
    for k, (t_s, reader, metres) in enumerate(rows):
        out[k]["t_s"], out[k]["reader"], out[k]["range_m"] = t_s, int(reader), metres
    return out


def distances(place: Any, readers: FloatArray) -> FloatArray:
    """Distances of a place (2,) or places (n, 2) from all readers."""
    level = np.asarray(place, float)[..., None, :] - readers[:, :2]
    return np.asarray(np.sqrt((level**2).sum(-1) + readers[:, 2] ** 2))


def covariance(rng: np.random.Generator, d: int, scale: float = 1.0) -> FloatArray:
    """A random covariance, correlated."""
    A = rng.normal(size=(d, d))
    return np.asarray(scale * (A @ A.T / d + 0.05 * np.eye(d)))


def dense_singer(alpha: float, variance: float, dt_s: float, d: int = 6) -> tuple[FloatArray, FloatArray]:
    """F and Q of the whole state (d, d), from the elements of one axis."""
    step, block = np.empty(3), np.empty(6)
    singer.transition(alpha, dt_s, step)
    singer.noise(alpha, variance, dt_s, block)
    A = np.array([[1.0, dt_s, step[0]], [0.0, 1.0, step[1]], [0.0, 0.0, step[2]]])
    Q = np.zeros((3, 3))
    Q[np.triu_indices(3)] = block
    Q = Q + np.triu(Q, 1).T
    F, noise = np.eye(d), np.zeros((d, d))
    F[:6, :6], noise[:6, :6] = np.kron(A, np.eye(2)), np.kron(Q, np.eye(2))
    return F, noise
