"""Tags that may have changed sides: readers on one line cannot tell a place from its mirror image.

A located tag keeps its side as long as it stays away from the line, or crosses it at a known speed. Once its way
across, position and velocity, cannot be told from the mirrored one (both lie within 1.5 sigmas of the line), and it
then leaves the line with no other reader in reach, it may have left it on either side: a second hypothesis, mirrored,
is put beside the first. A filter may as well stay on the line and become less and less sure across it, though the
ranges by now say "off the line": then it is told to begin at both of the places that they fit.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.records import Filter
from trackmesh.services.tags.table import RING, Tags, open_block

FloatArray = npt.NDArray[np.float64]

_FLAT = 0.02
_NEAR = 1.5**2
_CLEAR = 3.0**2
_BLURRED = 6.0**2

KNOWN, MIRRORED, BLURRED = range(3)
"""What ``watch_side`` finds."""


@kernel
def watch_side(tags: Tags, readers: FloatArray, row: int, since_s: float) -> int:
    """Look whether a located tag may have changed sides, by the readers heard ``since_s``.

    Returns:
        ``KNOWN``; ``MIRRORED``: its mirror image was put beside it in a block, of which there must be a free one; or
        ``BLURRED``: it stands on the line, and its variance across it is far larger than that of a range.
    """
    life, f = tags.life[row], tags.filters[row]
    line = np.empty(4)
    if not _line_of_readers(tags, readers, row, since_s, line):
        life.side = 0
        return KNOWN
    apart = _across(f, line)
    if apart < _NEAR:
        life.side = 1
        z = tags.rings[row, (life.heard - 1) % RING]
        blurred = _variance_across(f, line) > _BLURRED * (z.variance + (z.relative * z.range_m) ** 2)
        return BLURRED if blurred else KNOWN
    if life.side and apart > _CLEAR:
        life.side = 0
        open_block(tags, row)
        weight = tags.blocks.weight[life.block]
        for k in range(len(weight)):
            weight[k] = 0.5 if k < 2 else 0.0
        tags.blocks.filters[life.block, 0] = f
        tags.blocks.filters[life.block, 1] = f
        _reflect(tags.blocks.filters[life.block, 1], line)
        tags.blocks.told[life.block], tags.blocks.reader[life.block] = 0, -1
        return MIRRORED
    return KNOWN


@kernel
def _line_of_readers(tags: Tags, readers: FloatArray, row: int, since_s: float, line: FloatArray) -> bool:
    """Write the line on which all readers of late stand, a point and its normal, to line (4,); whether there is one."""
    heard = tags.life[row].heard
    first = readers[tags.rings[row, (heard - 1) % RING].reader]
    count, longest = 0, 0.0
    for back in range(1, min(heard, RING) + 1):
        old = tags.rings[row, (heard - back) % RING]
        if old.t_s < since_s:
            break
        count += 1
        de, dn = readers[old.reader, 0] - first[0], readers[old.reader, 1] - first[1]
        length = math.sqrt(de * de + dn * dn)
        if length > longest:
            longest = length
            line[2], line[3] = -dn / length, de / length
    if longest == 0.0:
        return False
    line[0], line[1] = first[0], first[1]
    for back in range(1, count + 1):
        at = readers[tags.rings[row, (heard - back) % RING].reader]
        if abs((at[0] - first[0]) * line[2] + (at[1] - first[1]) * line[3]) > _FLAT * longest:
            return False
    return True


@kernel
def _across(f: Filter, line: FloatArray) -> float:
    """Squared Mahalanobis distance of position and velocity across a line from nought, of the likeliest model."""
    j, e, n = np.argmax(f.mu), line[2], line[3]
    x, P = f.x[j], f.P[j]
    d, v = (x[0] - line[0]) * e + (x[1] - line[1]) * n, x[2] * e + x[3] * n
    dd = _variance_across(f, line)
    vv = e * e * P[2, 2] + 2.0 * e * n * P[2, 3] + n * n * P[3, 3]
    dv = e * e * P[0, 2] + e * n * (P[0, 3] + P[1, 2]) + n * n * P[1, 3]
    return float((vv * d * d - 2.0 * dv * d * v + dd * v * v) / max(dd * vv - dv * dv, 1e-300))


@kernel
def _variance_across(f: Filter, line: FloatArray) -> float:
    P, e, n = f.P[np.argmax(f.mu)], line[2], line[3]
    return float(e * e * P[0, 0] + 2.0 * e * n * P[0, 1] + n * n * P[1, 1])


@kernel
def _reflect(f: Filter, line: FloatArray) -> None:
    """Mirror a filter at a line, in place: p <- p - 2 ((p - q) n) n, likewise velocity, acceleration and covariance."""
    e, n, d = line[2], line[3], f.x.shape[1]
    for j in range(len(f.mu)):
        x, P = f.x[j], f.P[j]
        for a in (0, 2, 4):
            east, north = (line[0], line[1]) if a == 0 else (0.0, 0.0)
            along = 2.0 * ((x[a] - east) * e + (x[a + 1] - north) * n)
            x[a] -= along * e
            x[a + 1] -= along * n
            for c in range(d):
                along = 2.0 * (P[a, c] * e + P[a + 1, c] * n)
                P[a, c] -= along * e
                P[a + 1, c] -= along * n
        for a in (0, 2, 4):
            for c in range(d):
                along = 2.0 * (P[c, a] * e + P[c, a + 1] * n)
                P[c, a] -= along * e
                P[c, a + 1] -= along * n
        for a in range(d):
            for b in range(a):
                P[a, b] = P[b, a]
