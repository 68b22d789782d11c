"""The life of tags: heard, located or at several places at once, doubted, started anew, lost.

A tag begins as soon as three readers have heard it within the window, by multilateration; after a while of fewer, as
several hypotheses. A row of doubted ranges makes its place doubtful: it starts anew, if another place explains the
late ranges better. After a long silence it starts anew in any case.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.filtering import begin, filter_instant, group_end
from trackmesh.services.tags.hypotheses import CERTAIN, COUNT, begin_circle, begin_modes, prune, take
from trackmesh.services.tags.mirror import BLURRED, MIRRORED, watch_side
from trackmesh.services.tags.multilateration import MODES, cost_at, multilaterate
from trackmesh.services.tags.records import BIAS, SCALE, Filter, Records, Rules, Work
from trackmesh.services.tags.table import (
    FREE,
    HEARD,
    LATE,
    LOCATED,
    REPAIRS,
    RESTARTS,
    SEVERAL,
    STARTS,
    Tags,
    close_block,
    give_up,
    latest,
    open_block,
    readers_in,
    remember,
    window,
)

FloatArray = npt.NDArray[np.float64]

EVERYWHERE = np.array([-np.inf, -np.inf, np.inf, np.inf])

_READERS_TO_LOCATE = 3
_FEW_READERS_LONGER = 4
_BETTER = 6.0


class Manners(NamedTuple):
    """How tags live.

    Attributes:
        window_s: ranges this far back serve a start. wait_s: a start with fewer than three readers waits so long.
        lost_s: silence after which a tag is lost, and started anew when it is heard again.
        doubts: so many doubted ranges in a row make a place doubtful.
        walk_mps: how fast a tag may have moved within the window.
        area: (4,) west, south, east, north of where tags can be, metres.
    """

    window_s: float = 2.0
    wait_s: float = 1.0
    lost_s: float = 30.0
    doubts: int = 8
    walk_mps: float = 2.0
    area: FloatArray = EVERYWHERE


@kernel
def take_ranges(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, z: Records, w: Work) -> int:
    """Take ranges (n,), sorted by row, time and reader; late ones and repeated ones are left out and counted.

    Returns:
        How many were taken: all, unless there is no free block any more for a tag that may need one.
    """
    first = 0
    while first < len(z) and tags.blocks.top[0] > 0:
        end = group_end(z, first)
        _take_instant(tags, rules, manners, readers, z[first:end], w)
        first = end
    return first


@kernel
def _take_instant(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, z: Records, w: Work) -> None:
    row, t_s = z[0].row, z[0].t_s
    life = tags.life[row]
    if t_s < life.last_s:
        tags.counts[LATE] += len(z)
        return
    if life.state == FREE or t_s - life.last_s > manners.lost_s:
        give_up(tags, row)
        life.state, life.since_s = HEARD, t_s
    fresh = remember(tags, row, z)
    if fresh == 0:
        return
    # What is new stands at the end of the ring; copies in the order of z.
    z = latest(tags, row, fresh)
    life.last_s = t_s
    if life.state == LOCATED:
        filter_instant(rules, tags.filters[row], readers, z, w)
        _look_after(tags, rules, manners, readers, row)
        if life.state == LOCATED:
            _mind_side(tags, rules, manners, readers, row)
    elif life.state == SEVERAL:
        left = take(rules, tags.blocks, life.block, readers, manners.area, z, w)
        _settle(tags, manners, row, left)
    if life.state == HEARD:
        try_start(tags, rules, manners, readers, row, t_s, w)


@kernel
def _for_start(tags: Tags, rules: Rules, manners: Manners, row: int, z: Records, t_s: float) -> Records:
    """Ranges freed of known bias and scale, with all that makes them uncertain at ``t_s``.

    That is noise, what bias and scale may be, and the tag's way since then.
    """
    f, out = tags.filters[row], z.copy()
    bias = scale = 0.0
    if f.x.shape[1] > BIAS and tags.life[row].knows:
        j = np.argmax(f.mu)
        bias, scale = f.x[j, BIAS], f.x[j, SCALE]
    for k in range(len(z)):
        moved = manners.walk_mps * (t_s - z[k].t_s)
        out[k].variance += (z[k].relative * z[k].range_m) ** 2 + moved * moved
        out[k].range_m = (z[k].range_m - bias) / (1.0 + scale)
        if not tags.life[row].knows:
            out[k].variance += rules.bias_variance + rules.scale_variance * z[k].range_m ** 2
    return out


@kernel
def try_start(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, row: int, now_s: float, w: Work) -> None:
    """Start the filter of a row that is ``HEARD``, if that can be done by ``now_s``."""
    life = tags.life[row]
    z = window(tags, row, life.last_s - manners.window_s)
    tags.scratch[0] = tags.filters[row]
    if readers_in(z) >= _READERS_TO_LOCATE:
        modes = np.empty((MODES, 6))
        found = multilaterate(readers, _for_start(tags, rules, manners, row, z, life.last_s), modes)
        while found > 1 and modes[found - 1, 2] - modes[0, 2] > _BETTER:
            found -= 1
        if found > 0:
            tags.counts[STARTS] += 1
            _start_at(tags, rules, manners, row, modes[:found])
            return
    if len(z) and now_s - life.since_s >= manners.wait_s:
        tags.counts[STARTS] += 1
        _start_on_circle(tags, rules, manners, readers, row, z, w)


@kernel
def _start_at(tags: Tags, rules: Rules, manners: Manners, row: int, modes: FloatArray) -> None:
    """Begin at one place, or at two."""
    life = tags.life[row]
    if len(modes) == 1:
        begin(rules, tags.filters[row], life.last_s, modes[0, 0], modes[0, 1], modes[0, 3:6])
        _inherit(rules, tags, row, tags.filters[row])
        life.state, life.knows, life.side = LOCATED, 1, 0
        return
    open_block(tags, row)
    begin_modes(rules, tags.blocks, life.block, life.last_s, modes)
    for k in range(len(modes)):
        _inherit(rules, tags, row, tags.blocks.filters[life.block, k])
    _settle(tags, manners, row, prune(tags.blocks, life.block, manners.area))


@kernel
def _start_on_circle(
    tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, row: int, z: Records, w: Work
) -> None:
    """Begin on the circle of the oldest range, and take the others after it."""
    open_block(tags, row)
    block = tags.life[row].block
    oldest = _for_start(tags, rules, manners, row, z[:1], z[0].t_s)
    begin_circle(rules, tags.blocks, block, readers[z[0].reader], oldest[0])
    for k in range(COUNT):
        _inherit(rules, tags, row, tags.blocks.filters[block, k])
    left, first = prune(tags.blocks, block, manners.area), 1
    while first < len(z):
        end = group_end(z, first)
        left = take(rules, tags.blocks, block, readers, manners.area, z[first:end], w)
        first = end
    _settle(tags, manners, row, left)


@kernel
def _inherit(rules: Rules, tags: Tags, row: int, f: Filter) -> None:
    """Give a filter that begins what the row's last one, in ``tags.scratch``, has learnt of bias and scale.

    With at least a quarter of the prior's variance: what was learnt may have been wrong with the place.
    """
    if f.x.shape[1] == BIAS or not tags.life[row].knows:
        return
    old = tags.scratch[0]
    best = np.argmax(old.mu)
    for j in range(len(f.mu)):
        for a in range(BIAS, f.x.shape[1]):
            f.x[j, a] = old.x[best, a]
            f.P[j, a, a] = min(max(old.P[best, a, a], 0.25 * f.P[j, a, a]), f.P[j, a, a])


@kernel
def _settle(tags: Tags, manners: Manners, row: int, left: int) -> None:
    """A tag at several places: if one of them is left, it is there; if all are doubted, it starts anew."""
    life = tags.life[row]
    weight = tags.blocks.weight[life.block]
    best = np.argmax(weight)
    if left == 1 or weight[best] > CERTAIN:
        tags.filters[row] = tags.blocks.filters[life.block, best]
        close_block(tags, row)
        life.state, life.knows, life.side = LOCATED, 1, 0
        return
    for k in range(COUNT):
        if weight[k] > 0.0 and tags.blocks.filters[life.block, k].doubts < manners.doubts:
            return
    close_block(tags, row)
    _begin_again(tags, row)


@kernel
def _look_after(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, row: int) -> None:
    """A located tag: replace what is no filter any more, and look for a better place after a row of doubts."""
    f = tags.filters[row]
    if not _is_sound(f):
        tags.counts[REPAIRS] += 1
        _begin_again(tags, row)
    elif f.doubts >= manners.doubts and _is_elsewhere(tags, rules, manners, readers, row):
        _begin_again(tags, row)


@kernel
def _mind_side(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, row: int) -> None:
    """A located tag near a line of readers: where it may be on either side of it, follow both."""
    life = tags.life[row]
    found = watch_side(tags, readers, row, life.last_s - manners.window_s)
    if found == MIRRORED:
        _settle(tags, manners, row, prune(tags.blocks, life.block, manners.area))
    elif found == BLURRED:
        z, modes = window(tags, row, life.last_s - manners.window_s), np.empty((MODES, 6))
        count = multilaterate(readers, _for_start(tags, rules, manners, row, z, life.last_s), modes)
        if count == MODES and modes[1, 2] - modes[0, 2] < _BETTER:
            tags.scratch[0] = tags.filters[row]
            life.side = 0
            _start_at(tags, rules, manners, row, modes)


@kernel
def _is_sound(f: Filter) -> bool:
    for j in range(len(f.mu)):
        for a in range(f.x.shape[1]):
            if not (np.isfinite(f.x[j, a]) and 0.0 <= f.P[j, a, a] < np.inf):
                return False
    return True


@kernel
def _is_elsewhere(tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, row: int) -> bool:
    """Whether another place explains the ranges of the window clearly better.

    For fewer than three readers there always is one, so their doubts must last longer.
    """
    f = tags.filters[row]
    late = window(tags, row, f.t_s - manners.window_s)
    if readers_in(late) < _READERS_TO_LOCATE:
        return bool(f.doubts >= _FEW_READERS_LONGER * manners.doubts)
    z, modes, j = _for_start(tags, rules, manners, row, late, f.t_s), np.empty((MODES, 6)), np.argmax(f.mu)
    if multilaterate(readers, z, modes) == 0:
        return False
    return bool(cost_at(readers, z, f.x[j, 0], f.x[j, 1]) - modes[0, 2] > _BETTER)


@kernel
def _begin_again(tags: Tags, row: int) -> None:
    """Locate a row anew."""
    life = tags.life[row]
    life.state, life.since_s = HEARD, life.last_s
    tags.counts[RESTARTS] += 1


@kernel
def end_waiting(
    tags: Tags, rules: Rules, manners: Manners, readers: FloatArray, now_s: float, row: int, w: Work
) -> int:
    """Start what has waited long enough for a third reader, from ``row`` on; the row that comes next.

    That is behind the last one, unless there is no free block any more.
    """
    while row < len(tags.life) and tags.blocks.top[0] > 0:
        if tags.life[row].state == HEARD:
            try_start(tags, rules, manners, readers, row, now_s, w)
        row += 1
    return row
