"""The filter bank: what a track's filter is made of, and the models it runs.

A filter has one or more *branches*, each an interacting multiple model filter over models of its own; branches see the
same plots, never feed each other, and are averaged by their predictive evidence. ``imm`` and ``tvimm-dirichlet`` have
one branch, ``tvimm`` has two. Models of different state length live side by side: the first four components are
position and velocity, the rest are the model's own parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.motion import STATES, Model
from trackmesh.services.estimation.transition import generator, stationary

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

NEVER_SPLIT = 1e300


class Branch(NamedTuple):
    """One branch, as it is described.

    Attributes:
        models: its motion models.
        sojourn_s: mean time in each.
        jumps: J of the chain, or None.
        start: initial model probabilities, or None for the stationary ones.
        prior_count: weight of Pi(dt) against the track's own observed transitions; infinite for a fixed matrix.
        age_s: (per model) time constant after which it is left more readily; None for a chain without memory.
        split_s: intervals longer than this are filtered as two halves.
    """

    models: tuple[Model, ...]
    sojourn_s: tuple[float, ...]
    jumps: FloatArray | None = None
    start: tuple[float, ...] | None = None
    prior_count: float = np.inf
    age_s: tuple[float, ...] | None = None
    split_s: float = NEVER_SPLIT


class Models(NamedTuple):
    """All branches as arrays, for the kernels; r models in all, b branches, the longest state d.

    Attributes:
        kind, states: (r,). numbers: (r, 4) q, mean, sd, time_s.
        first: (b + 1,) first model of each branch, and r.
        generator: (r, width) G of each branch's chain, one below the other; width is that of the longest branch.
        start: (r,) initial probabilities, summing to one in each branch.
        prior_count: (b,). age_s: (r,), 0 where a model has no memory of its age.
        split_s: (b,).
        share: how much weight the branches exchange at every update.
        memory_s, reference_s: of observed transitions.
        printed: the transition matrix, the probabilities and the output follow the published TV-IMM instead.
    """

    kind: IntArray
    states: IntArray
    numbers: FloatArray
    first: IntArray
    generator: FloatArray
    start: FloatArray
    prior_count: FloatArray
    age_s: FloatArray
    split_s: FloatArray
    share: float
    memory_s: float
    reference_s: float
    printed: bool


def make_models(
    branches: tuple[Branch, ...],
    *,
    share: float = 0.02,
    memory_s: float = 80.0,
    reference_s: float = 4.0,
    printed: bool = False,
) -> Models:
    """Models of the given branches.

    Raises:
        ValueError: a branch is not consistent, or a number is out of its range.
    """
    if not (memory_s > 0 and reference_s > 0):
        raise ValueError("memory_s and reference_s must be positive")
    if not 0.0 <= share <= 1.0:
        raise ValueError("share must be from 0 to 1")
    if not branches or (printed and len(branches) > 1):
        raise ValueError("a filter needs a branch, and the published TV-IMM has no more than one")
    models = [m for branch in branches for m in branch.models]
    chains = [_generator(branch) for branch in branches]
    starts = [np.array(b.start) if b.start else stationary(c) for b, c in zip(branches, chains, strict=True)]
    ages = [b.age_s or (0.0,) * len(b.models) for b in branches]
    width = max(len(b.models) for b in branches)
    return Models(
        kind=np.array([m.kind for m in models]),
        states=np.array([STATES[m.kind] for m in models]),
        numbers=np.array([[m.q, m.mean, m.sd, m.time_s] for m in models], float),
        first=np.cumsum([0, *(len(b.models) for b in branches)]),
        generator=_padded(chains, width),
        start=np.concatenate(starts),
        prior_count=np.array([b.prior_count for b in branches], float),
        age_s=np.concatenate([np.array(a, float) for a in ages]),
        split_s=np.array([b.split_s for b in branches], float),
        share=share,
        memory_s=memory_s,
        reference_s=reference_s,
        printed=printed,
    )


def _generator(branch: Branch) -> FloatArray:
    if len(branch.models) != len(branch.sojourn_s):
        raise ValueError("a branch needs one sojourn time a model")
    if not branch.prior_count > 0:
        raise ValueError("prior_count must be positive")
    if not all(m.q > 0 and m.time_s > 0 and m.sd >= 0 for m in branch.models):
        raise ValueError("q and time_s of a model must be positive, and sd not negative")
    if branch.start and (len(branch.start) != len(branch.models) or abs(sum(branch.start) - 1.0) > 1e-9):
        raise ValueError("start must be one probability a model, with sum one")
    if branch.age_s and (len(branch.age_s) != len(branch.models) or min(branch.age_s) < 0):
        raise ValueError("age_s must be one time a model, not negative")
    return generator(np.array(branch.sojourn_s), branch.jumps)


def _padded(blocks: list[FloatArray], width: int) -> FloatArray:
    """Square blocks one below the other, (r, width)."""
    return np.concatenate([np.pad(b, ((0, 0), (0, width - b.shape[1]))) for b in blocks])


class State(NamedTuple):
    """The filters of n rows at the time of each.

    Attributes:
        x, P: (n, r, d), (n, r, d, d), of which a model uses its own length.
        mu: (n, r) probability within the branch. weight: (n, b) of the branches.
        counts: (n, r, width) observed transitions within the branch. age_s: (n, r) time spent in each model.
        t_s: (n,).
    """

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    weight: FloatArray
    counts: FloatArray
    age_s: FloatArray
    t_s: FloatArray


def make_state(models: Models, n: int) -> State:
    """State of n empty rows."""
    r, width, b, d = len(models.kind), models.generator.shape[1], len(models.split_s), int(models.states.max())
    return State(
        x=np.zeros((n, r, d)),
        P=np.zeros((n, r, d, d)),
        mu=np.zeros((n, r)),
        weight=np.zeros((n, b)),
        counts=np.zeros((n, r, width)),
        age_s=np.zeros((n, r)),
        t_s=np.zeros(n),
    )


class Work(NamedTuple):
    """Scratch of the kernels for one track."""

    pi: FloatArray
    x: FloatArray
    P: FloatArray
    before: FloatArray
    c: FloatArray
    log_likelihood: FloatArray
    motion: FloatArray
    gain: FloatArray
