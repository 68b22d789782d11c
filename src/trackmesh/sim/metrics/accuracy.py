"""How large errors are, and whether they are as large as the covariances say.

NEES: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with applications to tracking and navigation", 2001,
section 5.4.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from trackmesh.protocol.arrays import FloatArray


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Normalised estimation error squared e^T P^-1 e (k,) of errors (k, d) with covariances (k, d, d).

    A consistent filter has mean d. A covariance that is singular gives infinity.
    """
    values, vectors = np.linalg.eigh(covariances)
    along = np.einsum("kji,kj->ki", vectors, errors)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(along == 0.0, 0.0, along**2 / np.maximum(values, 0.0))
    return np.asarray(terms.sum(axis=1), np.float64)


def rmse(distance_m: FloatArray) -> float:
    """Root of the mean square; NaN for none."""
    return float(np.sqrt(np.mean(np.square(distance_m)))) if len(distance_m) else float("nan")


def mean(values: npt.ArrayLike) -> float:
    """The mean; NaN for none."""
    every = np.asarray(values, np.float64)
    return float(every.mean()) if every.size else float("nan")


def nees_band(samples: npt.ArrayLike, degrees: int, probability: float = 0.95) -> tuple[FloatArray, FloatArray]:
    """Between which values the mean of so many independent NEES lies with this probability, if all is consistent.

    Their sum is chi-square of ``samples * degrees`` degrees of freedom (Bar-Shalom, Li and Kirubarajan 2001, section
    5.4.2). The errors of different targets at one time are independent, those of one target at successive times are
    not.

    Args:
        samples: numbers of errors, of any shape; where there is none, the band is NaN.
        degrees: of freedom of one error: 2 for a position, 4 with the velocity.
        probability: of a mean within the band, as much below as above it.
    """
    n = np.asarray(samples, np.float64)
    beyond = 0.5 * (1.0 - probability)
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.asarray(2.0 * gammaincinv(0.5 * n * degrees, share) / n) for share in (beyond, 1.0 - beyond))
    return low, high
