"""Rows of tags: their filters, their state, the ring of late ranges of each, and blocks for those at several places."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.hypotheses import Blocks, make_blocks
from trackmesh.services.tags.records import RANGE, Records, joined, make_filters

IntArray = npt.NDArray[np.int64]

FREE, HEARD, SEVERAL, LOCATED = range(4)
"""States of a row: nobody's; heard, not enough to say where; at one of several places; at one place."""

RING = 16
"""How many late ranges of a tag are kept."""

STARTS, RESTARTS, LATE, DUPLICATES, REPAIRS, SPLITS = range(6)
"""What the kernels count."""

COUNTED = ("starts", "restarts", "late_ranges", "duplicate_ranges", "repairs", "several_places")


class Tags(NamedTuple):
    """Many tags, a row each.

    Attributes:
        filters: (n,) of located tags. life: (n,) records of ``LIFE``. rings: (n, RING) late ranges.
        blocks: of tags at several places. scratch: (1,) a filter.
        counts: what happened, by ``COUNTED``.
    """

    filters: Records
    life: Records
    rings: Records
    blocks: Blocks
    scratch: Records
    counts: IntArray


LIFE = np.dtype(
    (
        np.record,
        [(name, "i8") for name in ("state", "block", "heard", "knows", "side")] + [("since_s", "f8"), ("last_s", "f8")],
    )
)
"""State, block (-1: none), how many ranges were heard, whether the row's filter, used or not, holds bias and scale that
are worth keeping, whether its side of a line of readers is in doubt; waiting since, time of the last range."""


def make_tags(rules: Records, n: int, blocks: int) -> Tags:
    """Room for n tags, of which so many may be at several places."""
    return Tags(
        make_filters(rules, n),
        np.array([(FREE, -1, 0, 0, 0, 0.0, -np.inf)] * n, LIFE),
        np.zeros((n, RING), RANGE),
        make_blocks(rules, blocks),
        make_filters(rules, 1),
        np.zeros(len(COUNTED), np.int64),
    )


def grown(tags: Tags, rules: Records, n: int) -> Tags:
    """The same tags in n rows."""
    more = make_tags(rules, n - len(tags.life), 0)
    return tags._replace(
        filters=joined(tags.filters, more.filters),
        life=joined(tags.life, more.life),
        rings=joined(tags.rings, more.rings),
    )


def rows_in(tags: Tags, *states: int) -> IntArray:
    """Rows in any of these states."""
    return np.flatnonzero(np.isin(tags.life["state"], states))


@kernel
def forget(tags: Tags, row: int) -> None:
    """Make a row nobody's."""
    give_up(tags, row)
    tags.life[row].state, tags.life[row].knows, tags.life[row].last_s = FREE, 0, -np.inf


@kernel
def give_up(tags: Tags, row: int) -> None:
    """Forget the place of a tag and its late ranges; what it has shown of bias and scale stays."""
    life = tags.life[row]
    if life.block >= 0:
        close_block(tags, row)
    life.heard = 0


@kernel
def open_block(tags: Tags, row: int) -> None:
    """Give a row a free block."""
    tags.blocks.top[0] -= 1
    tags.life[row].block = tags.blocks.free[tags.blocks.top[0]]
    tags.life[row].state = SEVERAL
    tags.counts[SPLITS] += 1


@kernel
def close_block(tags: Tags, row: int) -> None:
    """Take the block of a row back."""
    tags.blocks.free[tags.blocks.top[0]] = tags.life[row].block
    tags.blocks.top[0] += 1
    tags.life[row].block = -1


@kernel
def remember(tags: Tags, row: int, z: Records) -> int:
    """Put ranges of one instant into the ring, leaving out those of readers that have told theirs; how many are new."""
    life, fresh = tags.life[row], 0
    for k in range(len(z)):
        known = False
        for back in range(1, min(life.heard, RING) + 1):
            old = tags.rings[row, (life.heard - back) % RING]
            if old.t_s < z[k].t_s:
                break
            known = known or old.reader == z[k].reader
        if known:
            tags.counts[DUPLICATES] += 1
            continue
        tags.rings[row, life.heard % RING] = z[k]
        life.heard += 1
        fresh += 1
    return min(fresh, RING)


@kernel
def latest(tags: Tags, row: int, count: int) -> Records:
    """The last ranges of a tag, oldest first."""
    out = np.empty(count, RANGE)
    for k in range(count):
        out[k] = tags.rings[row, (tags.life[row].heard - count + k) % RING]
    return out


@kernel
def window(tags: Tags, row: int, since_s: float) -> Records:
    """The ranges of a tag that are not older."""
    count = 0
    while count < min(tags.life[row].heard, RING):
        if tags.rings[row, (tags.life[row].heard - count - 1) % RING].t_s < since_s:
            break
        count += 1
    return latest(tags, row, count)


@kernel
def readers_in(z: Records) -> int:
    """How many different readers are among ranges."""
    count = 0
    for k in range(len(z)):
        fresh = True
        for other in range(k):
            fresh = fresh and z[other].reader != z[k].reader
        count += fresh
    return count
