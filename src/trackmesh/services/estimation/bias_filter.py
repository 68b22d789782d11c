"""One Kalman filter over the biases of several sensors, fed with pairs of their tracks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation import bias
from trackmesh.services.estimation.bias import COMPONENTS, Geometry, Tracks

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_ITERATIONS = 5
_ENOUGH = 0.01
_DIRECTIONS = np.arange(8) * np.pi / 4.0
_RING = np.stack([np.sin(_DIRECTIONS), np.cos(_DIRECTIONS)], axis=1)


class Pairs(NamedTuple):
    """Tracks of two sensors that are of the same targets, row by row; i, j are the sensors."""

    i: int
    j: int
    of_i: Tracks
    of_j: Tracks

    @property
    def R(self) -> FloatArray:
        """Covariances (n, 2, 2) of the differences of positions."""
        return np.asarray(self.of_i.P[:, :2, :2] + self.of_j.P[:, :2, :2])


class Seen(NamedTuple):
    """Pairs as the present biases leave them: what is left of the differences (n, 2), and H (n, 2, 6)."""

    pairs: Pairs
    left: FloatArray
    H: FloatArray


class BiasFilter:
    """The joint state of all sensors, three components each (see ``bias``).

    Attributes:
        geometries: of the sensors.
        prior, walk: (3 s,) one sigma before any data, and per square root of a second; zero prior: no such bias.
        beta, P: (3 s,) and (3 s, 3 s), mean and covariance.
    """

    def __init__(self) -> None:
        self.geometries: list[Geometry] = []
        self.prior = np.zeros(0)
        self.walk = np.zeros(0)
        self.beta = np.zeros(0)
        self.P = np.zeros((0, 0))

    def add(self, geometry: Geometry, prior: FloatArray, walk: FloatArray) -> None:
        """One more sensor, independent of the others as yet; prior, walk (3,)."""
        self.geometries.append(geometry)
        self.prior, self.walk = np.concatenate([self.prior, prior]), np.concatenate([self.walk, walk])
        self.beta, self.P = np.pad(self.beta, (0, COMPONENTS)), np.pad(self.P, (0, COMPONENTS))
        self._forget(len(self.geometries) - 1)

    def replace(self, k: int, geometry: Geometry, prior: FloatArray, walk: FloatArray) -> None:
        """Sensor k is another one from now; what was learnt of it is forgotten."""
        self.geometries[k] = geometry
        self.prior[block(k)], self.walk[block(k)] = prior, walk
        self._forget(k)

    def suppose(self, k: int, beta: FloatArray, P: FloatArray) -> None:
        """What sensor k is wrong by, (3,) and (3, 3), as others know it; zero where there is no prior."""
        self._forget(k)
        free = self.prior[block(k)] > 0.0
        self.beta[block(k)] = np.where(free, beta, 0.0)
        self.P[block(k), block(k)] = np.where(free[:, None] & free, P, 0.0)

    def _forget(self, k: int) -> None:
        self.beta[block(k)] = 0.0
        self.P[block(k)] = self.P[:, block(k)] = 0.0
        self.P[block(k), block(k)] = np.diag(self.prior[block(k)] ** 2)

    # --- what is known ---

    def bias(self, k: int) -> FloatArray:
        """The biases (3,) of a sensor."""
        return self.beta[block(k)]

    def covariance(self, k: int) -> FloatArray:
        """Their covariance (3, 3)."""
        return self.P[block(k), block(k)]

    def shift(self, k: int, at: FloatArray) -> FloatArray:
        """J beta (n, 2) of measured positions (n, 2), or states (n, 4)."""
        return bias.shift(self.geometries[k], at, self.bias(k))

    def shift_covariance(self, k: int, at: FloatArray) -> FloatArray:
        """Covariances (n, 2, 2) of the shift."""
        return bias.spread_through(self._jacobian(k, at), self.covariance(k))

    def difference_covariance(self, i: int, at_i: FloatArray, j: int, at_j: FloatArray) -> FloatArray:
        """Covariances (n, 2, 2) of the difference of the shifts of two sensors."""
        H = np.concatenate([self._jacobian(i, at_i), -self._jacobian(j, at_j)], axis=2)
        return bias.spread_through(H, self._part(i, j))

    def spread(self, k: int, range_m: float) -> float:
        """Length of the 1-sigma error of a sensor's shift at a range."""
        return bias.spread(self.covariance(k), self.geometries[k].polar, range_m)

    def difference_spread(self, i: int, j: int, range_m: float) -> float:
        """Largest length of the 1-sigma error of the difference of two shifts, all round both sites."""
        at = np.concatenate([self.geometries[k].site_m + range_m * _RING for k in (i, j)])
        return float(np.sqrt(np.trace(self.difference_covariance(i, at, j, at), axis1=1, axis2=2).max()))

    def seen(self, pairs: Pairs) -> Seen:
        """Pairs under the present biases."""
        return Seen(pairs, *bias.residuals(pairs.of_i, self.bias(pairs.i), pairs.of_j, self.bias(pairs.j)))

    def distances(self, seen: Seen) -> FloatArray:
        """Squared Mahalanobis distances D (n,) of pairs, for the present covariance."""
        return bias.distances(seen.left, seen.H, self._part(seen.pairs.i, seen.pairs.j), seen.pairs.R)

    # --- what changes it ---

    def drift(self, dt_s: float) -> None:
        """Let time pass."""
        self.beta, self.P = bias.drift(self.beta, self.P, self.prior, self.walk, dt_s)

    def open(self, variance: FloatArray) -> None:
        """Add variances (3 s,); biases that are not estimated stay so."""
        self.P = self.P + np.diag(np.where(self.prior > 0.0, variance, 0.0))

    def learn(self, seen: Sequence[Seen], weights: Sequence[FloatArray]) -> None:
        """One update by pairs of any sensors, as the present biases leave them, each row of noise R / weight.

        Iterated (Gauss and Newton), since J is taken where the positions are once they are corrected.
        """
        prior_beta, prior_P = self.beta, self.P
        for _ in range(_ITERATIONS):
            before = self.beta
            precision, vector = np.zeros_like(prior_P), np.zeros_like(prior_beta)
            for one, weight in zip(seen, weights, strict=True):
                both = _both(one.pairs.i, one.pairs.j)
                more = bias.information(one.left + one.H @ before[both], one.H, one.pairs.R, weight)
                precision[np.ix_(both, both)] += more[0]
                vector[both] += more[1]
            self.beta, self.P = bias.learn(prior_beta, prior_P, precision, vector)
            if ((self.beta - before) ** 2 <= _ENOUGH**2 * np.diag(self.P)).all():
                return
            seen = [self.seen(one.pairs) for one in seen]

    def _jacobian(self, k: int, at: FloatArray) -> FloatArray:
        true = bias.corrected(self.geometries[k], at, self.bias(k))
        return bias.jacobian(self.geometries[k], np.concatenate([true, at[:, 2:]], axis=1))

    def _part(self, i: int, j: int) -> FloatArray:
        both = _both(i, j)
        return np.asarray(self.P[np.ix_(both, both)])


def block(k: int) -> slice:
    """The components of sensor k in the joint state."""
    return slice(COMPONENTS * k, COMPONENTS * (k + 1))


def _both(i: int, j: int) -> IntArray:
    return np.concatenate([np.arange(COMPONENTS) + COMPONENTS * k for k in (i, j)])
