"""One target more: where it may be, and whether the data want it."""

from __future__ import annotations

from math import log

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.estimators.residuals import Residuals
from trackmesh.services.emi.estimators.start import by_point, towards
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Ground, Local, depth_of
from trackmesh.services.emi.windows import fine_search, over_all, rough_search

SPLIT = 0.4
"""How far the halves of a split target start from it, in depths."""
TINY = 1e-300


def one_more(sensor: Sensor, y: FloatArray, w: FloatArray, ground: Ground, best: Local, rest: Residuals) -> Local:
    """The best fit of one target more than ``best`` has, whose residuals are ``rest``."""
    tried = [rough_search(sensor, y, w, ground, start) for start in starts_with_another(sensor, ground, best, rest)]
    found = min(tried, key=lambda local: over_all(sensor, y, w, ground, local)[0])
    done = sum(local.iterations for local in tried) - found.iterations
    fine = fine_search(sensor, y, w, ground, found)
    return fine._replace(iterations=fine.iterations + done)


def starts_with_another(sensor: Sensor, ground: Ground, best: Local, rest: Residuals) -> list[FloatArray]:
    """Starts (T + 1, 3): a target under the peak of the residuals, at two depths; the nearest one split, two ways."""
    bounds, place = ground.bounds, sensor.point_m[residual_peak(sensor, rest)]
    along = place[:2] - best.r_m[:, :2]
    nearest = int(np.argmin((along**2).sum(1)))
    depth = depth_of(best.r_m[nearest], bounds)
    starts = [
        np.vstack([best.r_m, [*place[:2], bounds.surface_m + towards(bounds) * depth * share]]) for share in (1.0, 0.5)
    ]
    east, north = along[nearest] / max(float(np.hypot(*along[nearest])), 1e-9)
    for direction in ((east, north, 0.0), (-north, east, 0.0)):
        shift = SPLIT * depth * np.array(direction)
        split = np.vstack([best.r_m, best.r_m[nearest] + shift])
        split[nearest] -= shift
        starts.append(split)
    return [np.minimum(np.maximum(start, bounds.lower_m), bounds.upper_m) for start in starts]


def residual_peak(sensor: Sensor, rest: Residuals) -> int:
    """The point about which the residuals are largest, its neighbours taken together with it."""
    power = by_point(sensor, rest.e**2)
    return int(np.argmax(power + power[sensor.near].sum(1)))


def information_criteria(
    sensor: Sensor, y: FloatArray, w: FloatArray, ground: Ground, found: Local
) -> tuple[float, float]:
    """Bayesian information criterion without a target, and with those of ``found`` (G. Schwarz, 1978).

    rss / sigma^2 + k ln n, or n ln(rss / n) + k ln n with unknown noise, for k = T (3 + 6 C) parameters beside the
    background's.
    """
    numbers = int((w > 0.0).sum())
    cost, total = over_all(sensor, y, w, ground, found)
    penalty = len(found.r_m) * (3 + N_TENSOR * len(y)) * log(numbers)
    if ground.sigma_known:
        return total, cost + penalty
    return numbers * log(max(total, TINY) / numbers), numbers * log(max(cost, TINY) / numbers) + penalty
