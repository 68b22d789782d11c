"""Where a tag is by ranges alone: robust least squares from several starts, and whether a second place fits as well.

cost(p) = sum_i c^2 ln(1 + (r_i / c)^2), r_i = (z_i - |p - reader_i|) / sigma_i (Cauchy's loss, c = 2.385), minimised by
iteratively reweighted Gauss-Newton steps with Levenberg's damping. Such a loss has many minima; the steps begin at the
crossings of the circles of the nearest readers, of which some are right if two of these ranges are. Readers on one line
see a place and its mirror image alike: then two minima are found.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined, kernel
from trackmesh.services.tags.measurement import distance
from trackmesh.services.tags.records import Records

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MODES = 2
_NEAREST = 4
_STEPS = 20
_C2 = 2.385**2
_SAME = 9.0
_SPREAD = 2.25


@kernel
def multilaterate(readers: FloatArray, z: Records, out: FloatArray) -> int:
    """Write the best places that explain ranges (m,), best first, to out (MODES, 6); how many there are.

    A row is [east_m, north_m, cost, variance ee, en, nn]. The covariance is the inverse of the reweighted normal
    matrix, larger where the ranges contradict each other. Across a line of readers, near the line itself, distances
    change in second order only, by y^2 / 2d; so the standard deviation is held to some sqrt(2 d sigma).

    Args:
        readers: (R, 3) places [east, north, height above the tags].
        z: (m,) records of ``RANGE``, at least three different readers among them; ``relative`` is not looked at.
    """
    near = np.empty(_NEAREST, np.int64)
    count = nearest(z, near)
    found, starts = 0, np.empty((2, 2))
    trial = np.empty(6)
    for a in range(count):
        for b in range(a + 1, count):
            for k in range(crossings(readers, z, near[a], near[b], starts)):
                trial[0], trial[1] = starts[k, 0], starts[k, 1]
                _descend(readers, z, trial)
                found = _keep(out, found, trial)
    return found


@kernel
def nearest(z: Records, near: IntArray) -> int:
    """Write the indices of the shortest ranges, one a reader, to ``near``; how many, the room of ``near`` at most."""
    count = 0
    for k in range(len(near)):
        best = -1
        for i in range(len(z)):
            fresh = True
            for other in range(k):
                fresh = fresh and z[i].reader != z[near[other]].reader
            if fresh and (best < 0 or z[i].range_m < z[best].range_m):
                best = i
        if best < 0:
            break
        near[k] = best
        count += 1
    return count


@kernel
def crossings(readers: FloatArray, z: Records, a: int, b: int, out: FloatArray) -> int:
    """Write where the circles of two ranges cross, or nearly so, to out (2, 2); how many points, 0 to 2."""
    p, q = readers[z[a].reader], readers[z[b].reader]
    de, dn = q[0] - p[0], q[1] - p[1]
    apart = math.hypot(de, dn)
    if apart < 1e-6:
        return 0
    ra = math.sqrt(max(z[a].range_m ** 2 - p[2] ** 2, 0.0))
    rb = math.sqrt(max(z[b].range_m ** 2 - q[2] ** 2, 0.0))
    along = 0.5 * (apart + (ra * ra - rb * rb) / apart)
    # Circles that do not meet: the place between them, and a little off the line, where the gradient is not nought.
    across = math.sqrt(max(ra * ra - along * along, (0.05 * (ra + rb)) ** 2))
    along = min(max(along, -ra), apart + rb)
    ue, un = de / apart, dn / apart
    out[0, 0], out[0, 1] = p[0] + along * ue - across * un, p[1] + along * un + across * ue
    out[1, 0], out[1, 1] = p[0] + along * ue + across * un, p[1] + along * un - across * ue
    return 2


@kernel
def cost_at(readers: FloatArray, z: Records, east: float, north: float) -> float:
    """The robust cost of a place."""
    total = 0.0
    for i in range(len(z)):
        r2 = (z[i].range_m - distance(east, north, readers[z[i].reader])) ** 2 / z[i].variance
        total += _C2 * math.log(1.0 + r2 / _C2)
    return total


@kernel
def _descend(readers: FloatArray, z: Records, place: FloatArray) -> None:
    """From place (6,) go down to a minimum in place; cost and covariance are filled in."""
    damping, normal = 1e-3, np.empty(5)
    place[2] = cost_at(readers, z, place[0], place[1])
    for _ in range(_STEPS):
        _normal_equations(readers, z, place, normal)
        aee, ann = normal[0] * (1.0 + damping), normal[2] * (1.0 + damping)
        determinant = max(aee * ann - normal[1] * normal[1], 1e-300)
        east = place[0] + (ann * normal[3] - normal[1] * normal[4]) / determinant
        north = place[1] + (aee * normal[4] - normal[1] * normal[3]) / determinant
        cost = cost_at(readers, z, east, north)
        if cost < place[2]:
            damping *= 0.2
            place[0], place[1], place[2] = east, north, cost
        else:
            damping *= 8.0
    _normal_equations(readers, z, place, normal)
    contradiction = max(1.0, place[2] / max(len(z) - 2, 1)) / (normal[0] * normal[2] - normal[1] * normal[1])
    place[3], place[4], place[5] = (
        normal[2] * contradiction,
        -normal[1] * contradiction,
        normal[0] * contradiction,
    )


@kernel
def _normal_equations(readers: FloatArray, z: Records, place: FloatArray, out: FloatArray) -> None:
    """Write [A_ee, A_en, A_nn, b_e, b_n] of the reweighted least squares at a place, A with its floor."""
    aee = aen = ann = be = bn = total = mean = 0.0
    for i in range(len(z)):
        at = readers[z[i].reader]
        d = max(distance(place[0], place[1], at), 1e-6)
        ue, un = (place[0] - at[0]) / d, (place[1] - at[1]) / d
        nu = z[i].range_m - d
        weight = 1.0 / (z[i].variance + nu * nu / _C2)
        aee += weight * ue * ue
        aen += weight * ue * un
        ann += weight * un * un
        be += weight * ue * nu
        bn += weight * un * nu
        total += 1.0 / z[i].variance
        mean += d / len(z)
    floor = 1.0 / (_SPREAD * 2.0 * max(mean, 1e-3) / math.sqrt(total) + 1.0 / total)
    out[0], out[1], out[2], out[3], out[4] = aee + floor, aen, ann + floor, be, bn


@inlined
def _keep(out: FloatArray, found: int, trial: FloatArray) -> int:
    """Put a place among the found ones, unless it is one of them; how many there are then."""
    for k in range(found):
        if _apart(out[k], trial) < _SAME:
            if trial[2] < out[k, 2]:
                _put(out, k, trial)
            return _in_order(out, found)
    if found < MODES:
        _put(out, found, trial)
        return _in_order(out, found + 1)
    if trial[2] < out[found - 1, 2]:
        _put(out, found - 1, trial)
    return _in_order(out, found)


@inlined
def _put(out: FloatArray, k: int, trial: FloatArray) -> None:
    for a in range(len(trial)):
        out[k, a] = trial[a]


@inlined
def _in_order(out: FloatArray, found: int) -> int:
    if found == MODES and out[1, 2] < out[0, 2]:
        for a in range(6):
            out[0, a], out[1, a] = out[1, a], out[0, a]
    return found


@inlined
def _apart(a: FloatArray, b: FloatArray) -> float:
    """Squared Mahalanobis distance of two places by the sum of their covariances."""
    de, dn = a[0] - b[0], a[1] - b[1]
    ee, en, nn = a[3] + b[3], a[4] + b[4], a[5] + b[5]
    return float((nn * de * de - 2.0 * en * de * dn + ee * dn * dn) / max(ee * nn - en * en, 1e-300))
