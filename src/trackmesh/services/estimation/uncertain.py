"""The normal uncertainty distribution of Liu, "Uncertainty Theory" (2004), and what it does to covariances.

Its distribution function is Phi(x) = (1 + exp(pi (mu - x) / (sqrt(3) sigma)))^-1: the logistic distribution, whose
standard deviation is exactly sigma. Long, Cai, Li and Qiu, "A multi-objective track association method based on
uncertainty distribution and its solution" (2022), describe interference by it, beside Gaussian noise. Two slips of the
print:

* equation (4) calls the Gaussian density that of this distribution; the derivative of (5) is another function;
* below (21) the sigma of (18) to (21) is called a variance; with (5) it is the standard deviation.

A filter knows second moments only. To it the distribution says no more than that independent errors add their
variances: R <- R_noise + R_interference, and Q likewise. That is the difference between the two noise models.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
NoiseModel = Literal["gaussian", "uncertain"]

NOISE_MODELS: tuple[NoiseModel, ...] = get_args(NoiseModel)

_SCALE = math.sqrt(3.0) / math.pi


def distribution(x: npt.ArrayLike, mean: npt.ArrayLike = 0.0, sigma: npt.ArrayLike = 1.0) -> FloatArray:
    """Phi(x), equation (5); arguments broadcast, sigma positive."""
    z = (np.asarray(x, float) - mean) / (_SCALE * np.asarray(sigma, float))
    # Without the exponential of a large number.
    small = np.exp(-np.abs(z))
    return np.asarray(np.where(z >= 0.0, 1.0, small) / (1.0 + small))


def quantile(p: npt.ArrayLike, mean: npt.ArrayLike = 0.0, sigma: npt.ArrayLike = 1.0) -> FloatArray:
    """Phi^-1(p) = mu + sigma sqrt(3) / pi ln(p / (1 - p)), for 0 < p < 1; arguments broadcast."""
    p = np.asarray(p, float)
    return np.asarray(mean + _SCALE * np.asarray(sigma, float) * (np.log(p) - np.log1p(-p)))


def sample(rng: np.random.Generator, shape: tuple[int, ...], sigma: npt.ArrayLike = 1.0) -> FloatArray:
    """Independent values of mean zero, by the quantile of uniform numbers; sigma broadcasts against ``shape``."""
    # random() may be 0; 1 - random() is in (0, 1], so neither end alone is safe.
    p = np.clip(rng.random(shape), np.finfo(float).tiny, 1.0 - np.finfo(float).epsneg)
    return quantile(p, 0.0, sigma)


def assumed_variance(noise_sigma: npt.ArrayLike, interference_sigma: npt.ArrayLike, model: NoiseModel) -> FloatArray:
    """Variance that a filter assumes of noise and interference together; the Gaussian model leaves the latter out."""
    noise, interference = np.square(np.asarray(noise_sigma, float)), np.square(np.asarray(interference_sigma, float))
    known, unknown = np.broadcast_arrays(noise, interference)
    return np.asarray(known + unknown if model == "uncertain" else known.copy())
