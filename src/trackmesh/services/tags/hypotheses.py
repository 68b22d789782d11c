"""A tag that may be at several places: a filter for each, weighed by how well it foretells the ranges.

One reader alone says "somewhere on a circle": the circle becomes ``COUNT`` Gaussians side by side. Every range of
another reader makes some of them unlikely; those that overlap are merged, those that are unlikely are dropped. With two
readers, or several on one line, a place and its mirror image remain.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.filtering import begin, filter_instant
from trackmesh.services.tags.records import Filter, Range, Records, Rules, Work, joined, make_filters

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

COUNT = 12
UNLIKELY = 1e-3
CERTAIN = 0.99
_PREFERRED = 2.0
_OUTSIDE = 2.0
_OVERLAP = 1.0
_HALF_SPACING = math.pi / COUNT
_SAGITTA = 0.5 * _HALF_SPACING**2
_THICKNESS = 0.6 * _SAGITTA


class Blocks(NamedTuple):
    """Room for tags with several hypotheses.

    Attributes:
        filters, weight: (m, COUNT), weight 0 where there is none.
        told: (m,) which of them is told. reader: (m,) the only reader heard so far, or -1.
        free: (m,) stack of blocks that nobody uses. top: (1,) how many are in it.
    """

    filters: Records
    weight: FloatArray
    told: IntArray
    reader: IntArray
    free: IntArray
    top: IntArray


def make_blocks(rules: Records, m: int) -> Blocks:
    """Room for m tags."""
    return Blocks(
        make_filters(rules, m, COUNT),
        np.zeros((m, COUNT)),
        np.zeros(m, np.int64),
        np.full(m, -1),
        np.arange(m),
        np.array([m]),
    )


def grown(blocks: Blocks, rules: Records) -> Blocks:
    """The same blocks and as many more, all of which are free."""
    used, free = len(blocks.reader), int(blocks.top[0])
    more = make_blocks(rules, max(used, 16))
    stack = np.concatenate([blocks.free[:free], more.free + used])
    return Blocks(
        joined(blocks.filters, more.filters),
        np.concatenate([blocks.weight, more.weight]),
        np.concatenate([blocks.told, more.told]),
        np.concatenate([blocks.reader, more.reader]),
        np.concatenate([stack, np.zeros(used - free, np.int64)]),
        np.array([len(stack)]),
    )


@kernel
def begin_circle(rules: Rules, blocks: Blocks, block: int, place: FloatArray, z: Range) -> None:
    """Put hypotheses on the circle of one range (a record of ``RANGE``) about a reader's place (3,)."""
    variance = z.variance + (z.relative * z.range_m) ** 2 + rules.bias_variance + rules.scale_variance * z.range_m**2
    radius = math.sqrt(max(z.range_m**2 - place[2] ** 2, 0.0))
    # Gaussians along the tangent reach outside of the circle, so their middles stand a little inside.
    along, across = (_HALF_SPACING * radius) ** 2, variance + (_THICKNESS * radius) ** 2
    along += variance * variance / (variance + radius * radius)
    R = np.empty(3)
    for k in range(COUNT):
        east, north = math.sin(2.0 * _HALF_SPACING * k), math.cos(2.0 * _HALF_SPACING * k)
        R[0] = across * east * east + along * north * north
        R[1] = (across - along) * east * north
        R[2] = across * north * north + along * east * east
        r = radius * (1.0 - 0.5 * _SAGITTA)
        begin(rules, blocks.filters[block, k], z.t_s, place[0] + r * east, place[1] + r * north, R)
        blocks.weight[block, k] = 1.0 / COUNT
    blocks.reader[block] = z.reader


@kernel
def begin_modes(rules: Rules, blocks: Blocks, block: int, t_s: float, modes: FloatArray) -> None:
    """One hypothesis for each place of ``modes`` (k, 6), as ``multilaterate`` writes them."""
    total = 0.0
    for k in range(COUNT):
        blocks.weight[block, k] = math.exp(0.5 * (modes[0, 2] - modes[k, 2])) if k < len(modes) else 0.0
        total += blocks.weight[block, k]
    for k in range(len(modes)):
        begin(rules, blocks.filters[block, k], t_s, modes[k, 0], modes[k, 1], modes[k, 3:6])
        blocks.weight[block, k] /= total
    blocks.reader[block] = -1


@kernel
def take(rules: Rules, blocks: Blocks, block: int, readers: FloatArray, area: FloatArray, z: Records, w: Work) -> int:
    """Take the ranges (m,) of one instant; how many hypotheses are left.

    As long as one reader alone is heard its last range says all there is to know: the circle is made anew.
    """
    if np.all(z["reader"] == blocks.reader[block]):
        last = z[len(z) - 1]
        begin_circle(rules, blocks, block, readers[last.reader], last)
        return prune(blocks, block, area)
    blocks.reader[block] = -1
    weight = blocks.weight[block]
    top = -np.inf
    for k in range(COUNT):
        if weight[k] > 0.0:
            weight[k] = math.log(weight[k]) + filter_instant(rules, blocks.filters[block, k], readers, z, w)
            top = max(top, weight[k])
        else:
            weight[k] = -np.inf
    for k in range(COUNT):
        weight[k] = math.exp(weight[k] - top) if np.isfinite(top) else 1.0 / COUNT
    return prune(blocks, block, area)


@kernel
def prune(blocks: Blocks, block: int, area: FloatArray) -> int:
    """Drop hypotheses that are unlikely or outside of the area, merge those that overlap; how many are left.

    Args:
        area: (4,) west, south, east, north of where tags can be. If all are outside, all stay.
    """
    weight, filters = blocks.weight[block], blocks.filters[block]
    inside = False
    for k in range(COUNT):
        inside = inside or (weight[k] > 0.0 and not _is_outside(filters[k], area))
    top = 0.0
    for k in range(COUNT):
        if inside and weight[k] > 0.0 and _is_outside(filters[k], area):
            weight[k] = 0.0
        top = max(top, weight[k])
    total = 0.0
    for k in range(COUNT):
        if weight[k] < UNLIKELY * top:
            weight[k] = 0.0
        total += weight[k]
    for k in range(COUNT):
        weight[k] /= total
    left = _merge(blocks, block)
    best = np.argmax(weight)
    # Equal weights waver; what is told should not.
    if weight[best] > _PREFERRED * weight[blocks.told[block]]:
        blocks.told[block] = best
    return left


@kernel
def _is_outside(f: Filter, area: FloatArray) -> bool:
    """Whether the position of the likeliest model is outside by more than two sigmas."""
    j = np.argmax(f.mu)
    for axis in range(2):
        margin = _OUTSIDE * math.sqrt(f.P[j, axis, axis])
        if f.x[j, axis] < area[axis] - margin or f.x[j, axis] > area[2 + axis] + margin:
            return True
    return False


@kernel
def _merge(blocks: Blocks, block: int) -> int:
    """Merge hypotheses whose middles overlap, the next one into the one before; how many are left."""
    weight, filters = blocks.weight[block], blocks.filters[block]
    count = 0
    for a in range(COUNT):
        if weight[a] == 0.0:
            continue
        for b in range(a + 1, COUNT):
            if weight[b] > 0.0 and _overlap(filters[a], filters[b]):
                _join(filters[a], filters[b], weight[a], weight[b])
                weight[a] += weight[b]
                weight[b] = 0.0
        count += 1
    return count


@kernel
def _overlap(f: Filter, g: Filter) -> bool:
    """Whether the positions of two filters, of their likeliest models, are less than a sigma apart."""
    i, j = np.argmax(f.mu), np.argmax(g.mu)
    de, dn = f.x[i, 0] - g.x[j, 0], f.x[i, 1] - g.x[j, 1]
    ee, en = f.P[i, 0, 0] + g.P[j, 0, 0], f.P[i, 0, 1] + g.P[j, 0, 1]
    nn = f.P[i, 1, 1] + g.P[j, 1, 1]
    determinant = ee * nn - en * en
    return bool(nn * de * de - 2.0 * en * de * dn + ee * dn * dn < _OVERLAP * determinant)


@kernel
def _join(f: Filter, g: Filter, weight_f: float, weight_g: float) -> None:
    """Make f the moment-matched mixture of f and g, model by model."""
    r, d = f.x.shape
    a, b = weight_f / (weight_f + weight_g), weight_g / (weight_f + weight_g)
    for j in range(r):
        for c in range(d):
            for e in range(c, d):
                spread = a * b * (f.x[j, c] - g.x[j, c]) * (f.x[j, e] - g.x[j, e])
                f.P[j, c, e] = f.P[j, e, c] = a * f.P[j, c, e] + b * g.P[j, c, e] + spread
        for c in range(d):
            f.x[j, c] = a * f.x[j, c] + b * g.x[j, c]
        f.mu[j] = a * f.mu[j] + b * g.mu[j]
    f.doubts = min(f.doubts, g.doubts)
    f.fit = a * f.fit + b * g.fit
