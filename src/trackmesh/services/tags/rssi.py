"""Signal strength to range by the log-distance law, and learning the law from tags whose place is known.

P = P_1 - 10 n log10(d) + X, X ~ N(0, sd^2): P_1 the power at a metre, n the exponent of the loss. A range d_hat =
10^((P_1 - P) / (10 n)) has a noise of s = ln(10) sd / (10 n) of the distance, whatever that is. A wrong exponent is
worse than any noise: one that is a quarter too large costs metres, one that is a fifth too small loses every tag.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

INFLATION = 1.3
"""Noise is log-normal, and readings below the reader's threshold are missing: taken as Gaussian it must be larger."""

_EXPONENT_LEAST, _EXPONENT_MOST = 1.2, 6.0
_REMEMBERED = 2000.0


class PathLossPrior(NamedTuple):
    """What is expected of the law before any tag has taught it.

    Attributes:
        power_1m_dbm, power_sd_db: power at one metre. exponent, exponent_sd: of the loss. noise_db: of one reading.
    """

    power_1m_dbm: float = -45.0
    exponent: float = 2.5
    noise_db: float = 3.0
    power_sd_db: float = 5.0
    exponent_sd: float = 0.5


class PathLoss:
    """The law of one network: Bayesian linear regression of readings at known distances, slowly forgetting."""

    def __init__(self, prior: PathLossPrior) -> None:
        self._prior = prior
        self._information = np.diag([prior.power_sd_db**-2.0, prior.exponent_sd**-2.0])
        self._first = self._information.copy()
        self._vector = self._information @ [prior.power_1m_dbm, prior.exponent]
        self._first_vector = self._vector.copy()
        self.readings = 0

    @property
    def power_1m_dbm(self) -> float:
        """Power at one metre, as far as is known."""
        return float(np.linalg.solve(self._information, self._vector)[0])

    @property
    def exponent(self) -> float:
        """Exponent of the loss, as far as is known, within what is possible."""
        return float(np.clip(np.linalg.solve(self._information, self._vector)[1], _EXPONENT_LEAST, _EXPONENT_MOST))

    @property
    def exponent_sd(self) -> float:
        """Standard deviation of the exponent."""
        return math.sqrt(float(np.linalg.inv(self._information)[1, 1]))

    def learn(self, distance_m: FloatArray, rssi_dbm: FloatArray) -> None:
        """Take readings (k,) at known distances (k,)."""
        if not len(distance_m):
            return
        rows = np.column_stack([np.ones(len(distance_m)), -10.0 * np.log10(np.maximum(distance_m, 0.1))])
        keep = math.exp(-len(rows) / _REMEMBERED)
        weight = self._prior.noise_db**-2.0
        self._information = keep * self._information + (1.0 - keep) * self._first + weight * rows.T @ rows
        self._vector = keep * self._vector + (1.0 - keep) * self._first_vector + weight * rows.T @ rssi_dbm
        self.readings += len(rows)

    def ranges_m(self, rssi_dbm: FloatArray) -> FloatArray:
        """Ranges of readings (k,)."""
        power, exponent = self.power_1m_dbm, self.exponent
        return np.asarray(10.0 ** np.clip((power - rssi_dbm) / (10.0 * exponent), -3.0, 6.0))

    @property
    def relative_noise(self) -> float:
        """Standard deviation of a range as a share of the distance, with ``INFLATION``."""
        return INFLATION * math.log(10.0) * self._prior.noise_db / (10.0 * self.exponent)
