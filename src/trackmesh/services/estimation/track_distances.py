"""Statistics of whether two tracks of two sensors are of one target: weighted, modified and sequential.

With t = x_a - x_b, the difference of two estimates at one time:

* weighted (Singer and Kanyuck 1971): T = t^T C^-1 t with C = P_a + P_b, as if the errors were independent;
* modified (Bar-Shalom 1981): C = P_a + P_b - P_ab - P_ab^T, since both filters suffer the same process noise, with
  P_ab <- (I - K_a H)(F P_ab F^T + Q)(I - K_b H)^T from P_ab = 0;
* sequential (Long, Cai, Li and Qiu 2022, eq. 28): lambda(k) = lambda(k-1) + T(k) of the weighted C.

The pair is accepted where the statistic is at most the upper quantile of chi-square at the level alpha, with n degrees
of freedom (n states) a look. What the print of the last paper leaves open or has wrong:

* (22) names the whole history t^k and one difference t(k) alike;
* (24) is (23) without its conditions on the past: it supposes differences of different times to be independent. They
  are differences of filtered states and are not: lambda has the mean n k of chi-square, but a far larger variance;
* (27) has a constant c that depends on the covariances, hence on the pair and on k, once H1 is not constant;
* "compare lambda with the significance level alpha" cannot be meant: small lambda speak for H0, alpha is a probability.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from trackmesh.services.estimation.jit import kernel

FloatArray = npt.NDArray[np.float64]


def weighted_covariance(Pa: FloatArray, Pb: FloatArray) -> FloatArray:
    """C = P_a + P_b (..., n, n), eq. (25)."""
    return np.asarray(Pa + Pb)


def modified_covariance(Pa: FloatArray, Pb: FloatArray, Pab: FloatArray) -> FloatArray:
    """C = P_a + P_b - P_ab - P_ab^T (..., n, n), never above that of ``weighted_covariance`` where errors agree."""
    return np.asarray(Pa + Pb - Pab - np.swapaxes(Pab, -1, -2))


def cross_covariance(
    Pab: FloatArray, F: FloatArray, Q: FloatArray, kept_a: FloatArray, kept_b: FloatArray
) -> FloatArray:
    """One cycle of P_ab <- (I - K_a H)(F P_ab F^T + Q)(I - K_b H)^T (Bar-Shalom 1981).

    Args:
        Pab: (..., n, n) E[(x_a - x)(x_b - x)^T] after the last update, zero at first.
        F, Q: (..., n, n) transition and process noise, the same for both filters: there is one target.
        kept_a, kept_b: (..., n, n) I - K H of each update; the identity for a filter that has had no plot.
    """
    predicted = F @ Pab @ np.swapaxes(F, -1, -2) + Q
    return np.asarray(kept_a @ predicted @ np.swapaxes(kept_b, -1, -2))


def all_distances(xa: FloatArray, xb: FloatArray, C: FloatArray) -> FloatArray:
    """T of every track of one sensor with every track of the other, where all pairs have the same C.

    Args:
        xa, xb: (..., na, n), (..., nb, n).
        C: (n, n) positive definite.

    Returns:
        (..., na, nb).

    Raises:
        numpy.linalg.LinAlgError: C is not positive definite.
    """
    L = np.linalg.cholesky(C)
    middle = xa.mean(axis=-2, keepdims=True)
    a, b = (np.linalg.solve(L, (x - middle)[..., None])[..., 0] for x in (xa, xb))
    # |a - b|^2 of all pairs as one product; differences from the middle keep it from cancelling.
    squares = (a * a).sum(axis=-1)[..., :, None] + (b * b).sum(axis=-1)[..., None, :]
    return np.asarray(np.maximum(squares - 2.0 * a @ np.swapaxes(b, -1, -2), 0.0))


@kernel
def squared_distances(t: FloatArray, C: FloatArray) -> FloatArray:
    """t^T C^-1 t of pairs, by Cholesky: t (k, n), C (k, n, n) of which the lower triangle is used.

    A pair whose C is not positive definite, or that holds no number, gets an infinite distance.
    """
    k, n = t.shape
    distance = np.zeros(k)
    L, y = np.empty((n, n)), np.empty(n)
    for p in range(k):
        for a in range(n):
            y[a] = t[p, a]
            for b in range(a + 1):
                value = C[p, a, b]
                for c in range(b):
                    value -= L[a, c] * L[b, c]
                if a > b:
                    L[a, b] = value / L[b, b]
                    y[a] -= L[a, b] * y[b]
                elif value > 0.0:
                    L[a, a] = np.sqrt(value)
                else:
                    distance[p] = np.inf
                    L[a, a] = 1.0
            y[a] /= L[a, a]
            distance[p] += y[a] * y[a]
        if not distance[p] >= 0.0:
            distance[p] = np.inf
    return distance


def sequential_statistic(before: FloatArray, distance: FloatArray) -> FloatArray:
    """lambda(k) = lambda(k - 1) + T(k), eq. (28); zero before the first look."""
    return np.asarray(before + distance)


def acceptance_limit(looks: npt.ArrayLike, states: int, alpha: float) -> FloatArray:
    """Largest lambda (or, of one look, T) of an accepted pair: quantile of chi-square of ``looks * states``.

    Args:
        looks: (...) how many distances were added, at least 1.
        states: length of the states.
        alpha: share of true pairs that is rejected if the distances are independent, 0 < alpha < 1.
    """
    return np.asarray(chdtri(states * np.asarray(looks, float), alpha))
