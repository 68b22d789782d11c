"""What is told of tags at a time: the kernel that predicts them, and the message."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import kernel
from trackmesh.services.tags.hypotheses import COUNT
from trackmesh.services.tags.prediction import moments, predict
from trackmesh.services.tags.records import BIAS, SCALE, Filter, Rules, Work
from trackmesh.services.tags.table import RING, SEVERAL, Tags

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_UPPER = np.triu_indices(6)
_FLOAT32_MOST = float(np.finfo(np.float32).max)
_STATE_MOST = 1e12


class Told(NamedTuple):
    """What is told of n tags.

    Attributes:
        x, P: (n, d), (n, d, d) at the time asked for.
        certainty, quality: (n,). other: (n, 2). used: (n, RING) rows of readers, each once, then -1.
    """

    x: FloatArray
    P: FloatArray
    certainty: FloatArray
    quality: FloatArray
    other: FloatArray
    used: IntArray


def make_told(n: int, d: int) -> Told:
    """Room for n tags of d states."""
    return Told(
        np.zeros((n, d)),
        np.zeros((n, d, d)),
        np.ones(n),
        np.ones(n),
        np.zeros((n, 2)),
        np.full((n, RING), -1),
    )


@kernel
def tell(tags: Tags, rules: Rules, rows: IntArray, t_s: float, heard_s: float, w: Work, out: Told) -> None:
    """Write where the tags of these rows, located or at several places, are at ``t_s``; none is changed."""
    for k in range(len(rows)):
        life = tags.life[rows[k]]
        if life.state == SEVERAL:
            _tell_several(tags, rules, life.block, t_s, w, out, k)
        else:
            tags.scratch[0] = tags.filters[rows[k]]
            _tell_one(rules, tags.scratch[0], t_s, w, out.x[k], out.P[k])
            out.quality[k] = tags.scratch[0].fit
            out.other[k, 0], out.other[k, 1] = out.x[k, 0], out.x[k, 1]
        _tell_used(tags, rows[k], life.last_s - heard_s, out.used[k])


@kernel
def _tell_one(rules: Rules, f: Filter, t_s: float, w: Work, x: FloatArray, P: FloatArray) -> None:
    predict(rules, f, t_s, w)
    moments(f.x, f.P, f.mu, x, P)


@kernel
def _tell_several(tags: Tags, rules: Rules, block: int, t_s: float, w: Work, out: Told, k: int) -> None:
    """One of two places and the other beside it; of more than two all together."""
    weight, d = tags.blocks.weight[block], out.x.shape[1]
    x, P = np.zeros((COUNT, d)), np.zeros((COUNT, d, d))
    for h in range(COUNT):
        if weight[h] > 0.0:
            tags.scratch[0] = tags.blocks.filters[block, h]
            _tell_one(rules, tags.scratch[0], t_s, w, x[h], P[h])
    best = tags.blocks.told[block]
    out.certainty[k], out.quality[k] = weight[best], tags.blocks.filters[block, best].fit
    if np.sum(weight > 0.0) == 2:
        second = 0
        while second == best or weight[second] == 0.0:
            second += 1
        for a in range(d):
            out.x[k, a] = x[best, a]
            for b in range(d):
                out.P[k, a, b] = P[best, a, b]
        out.other[k, 0], out.other[k, 1] = x[second, 0], x[second, 1]
    else:
        moments(x, P, weight, out.x[k], out.P[k])
        out.other[k, 0], out.other[k, 1] = out.x[k, 0], out.x[k, 1]


@kernel
def _tell_used(tags: Tags, row: int, since_s: float, out: IntArray) -> None:
    count, heard = 0, tags.life[row].heard
    for back in range(1, min(heard, RING) + 1):
        old = tags.rings[row, (heard - back) % RING]
        if old.t_s < since_s:
            break
        fresh = True
        for other in range(count):
            fresh = fresh and out[other] != old.reader
        if fresh:
            out[count] = old.reader
            count += 1


def pack(told: Told) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """States (n, 6) and upper triangles of the covariances (n, 21) for a frame; what is too large saturates."""
    covariance = told.P[:, _UPPER[0], _UPPER[1]]
    state = np.clip(told.x[:, :6], -_STATE_MOST, _STATE_MOST)
    return state, np.clip(covariance, -_FLOAT32_MOST, _FLOAT32_MOST).astype("<f4")


def shared(told: Told) -> tuple[FloatArray | None, FloatArray | None]:
    """Bias (n,) in metres and scale (n,) of ranges, where they are estimated."""
    if told.x.shape[1] == BIAS:
        return None, None
    return np.ascontiguousarray(told.x[:, BIAS]), np.ascontiguousarray(told.x[:, SCALE])
