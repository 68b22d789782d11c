"""The filter bank: what a track's filter is made of, and the models it runs.

A filter has one or more *branches*, each an interacting multiple model filter over models of its own; branches see the
same plots, never feed each other, and are averaged by their predictive evidence. ``imm`` and ``tvimm-dirichlet`` have
one branch, ``tvimm`` has two. Models of different state length live side by side: the first four components are
position and velocity, the rest are the model's own parameters.

Models, states and scratch are numpy records. Their fields have a fixed shape, which is part of the type that numba
compiles for: the numbers of models and of states are constants of the compiled code, and a track is one block of
memory.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.motion import STATES, Model
from trackmesh.services.estimation.transition import generator, modes, stationary, uniformised

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


class Models(Protocol):
    """All branches as one record, for the kernels; r models in all, b branches, the longest state d.

    Attributes:
        kind, states: (r,). numbers: (r, 4) q, mean, sd, time_s.
        first: (b + 1,) first model of each branch, and r.
        jump, rate: (b, 3, width, width), (b,): each branch's chain, uniformised, and its powers; width is that of the
            longest branch.
        has_modes: (b,) whether the chain has the form of the next three.
        mode_rate, mode_left, mode_right: (b, width), (b, width, width) twice: see ``transition.Modes``.
        start: (r,) initial probabilities, summing to one in each branch.
        prior_count: (b,). age_s: (r,), 0 where a model has no memory of its age.
        split_s: (b,).
        share: how much weight the branches exchange at every update.
        memory_s, reference_s: of observed transitions.
        printed: the transition matrix, the probabilities and the output follow the published TV-IMM instead.
        lags: how many plots ago the states reach that are refined.
    """

    kind: IntArray
    states: IntArray
    numbers: FloatArray
    first: IntArray
    jump: FloatArray
    rate: FloatArray
    has_modes: IntArray
    mode_rate: FloatArray
    mode_left: FloatArray
    mode_right: FloatArray
    start: FloatArray
    prior_count: FloatArray
    age_s: FloatArray
    split_s: FloatArray
    share: float
    memory_s: float
    reference_s: float
    printed: int
    lags: int


def make_models(
    branches: tuple[Branch, ...],
    *,
    share: float = 0.02,
    memory_s: float = 80.0,
    reference_s: float = 4.0,
    printed: bool = False,
    lags: int = 0,
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
    if lags < 0 or (printed and lags):
        raise ValueError("lags must not be negative, and the published TV-IMM has none")
    models = [m for branch in branches for m in branch.models]
    chains = [_generator(branch) for branch in branches]
    starts = [np.array(b.start) if b.start else stationary(c) for b, c in zip(branches, chains, strict=True)]
    ages = [b.age_s or (0.0,) * len(b.models) for b in branches]
    width = max(len(b.models) for b in branches)
    uniform = [uniformised(c, width) for c in chains]
    by_modes = [modes(c, width) for c in chains]
    return cast(
        "Models",
        _record(
            kind=np.array([m.kind for m in models]),
            states=np.array([STATES[m.kind] for m in models]),
            numbers=np.array([[m.q, m.mean, m.sd, m.time_s] for m in models], float),
            first=np.cumsum([0, *(len(b.models) for b in branches)]),
            jump=np.array([jump for jump, _ in uniform]),
            rate=np.array([rate for _, rate in uniform]),
            has_modes=np.array([int(one.usable) for one in by_modes]),
            mode_rate=np.array([one.rate for one in by_modes]),
            mode_left=np.array([one.left for one in by_modes]),
            mode_right=np.array([one.right for one in by_modes]),
            start=np.concatenate(starts),
            prior_count=np.array([b.prior_count for b in branches], float),
            age_s=np.concatenate([np.array(a, float) for a in ages]),
            split_s=np.array([b.split_s for b in branches], float),
            share=share,
            memory_s=memory_s,
            reference_s=reference_s,
            printed=int(printed),
            lags=lags,
        ),
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


def _record(**fields: object) -> object:
    """One record of these fields."""
    values = {name: np.asarray(value) for name, value in fields.items()}
    dtype = np.dtype((np.record, [(name, v.dtype, v.shape) for name, v in values.items()]))
    record = np.zeros(1, dtype)
    for name, value in values.items():
        record[name][0] = value
    return record[0]


def as_array(record: object) -> npt.NDArray[Any]:
    """A record of models or scratch as an array of one: compiled functions take that ten times faster than a record."""
    return cast("npt.NDArray[Any]", cast("np.record", record).base)


class State(Protocol):
    """The filter of one track.

    Attributes:
        x, P: (r, d), (r, d, d), of which a model uses its own length.
        mu: (r,) probability within the branch. weight: (b,) of the branches.
        counts: (r, width) observed transitions within the branch. age_s: (r,) time spent in each model.
        t_s: its time.
        y, C, Y: of position and velocity some plots ago, nearest first: (lags, r, 4), their covariance with the present
            state (lags, r, d, 4), their own (lags, r, 4, 4). y_t_s: (lags,) when that was.
    """

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    weight: FloatArray
    counts: FloatArray
    age_s: FloatArray
    t_s: float
    y: FloatArray
    C: FloatArray
    Y: FloatArray
    y_t_s: FloatArray


States: TypeAlias = npt.NDArray[Any]
"""The filters of many tracks: an array of records with the fields of ``State``."""


def make_states(models: Models, n: int) -> States:
    """States of n empty rows."""
    r, width, b, d, lags = _sizes(models)
    fields = [
        ("x", (r, d)),
        ("P", (r, d, d)),
        ("mu", (r,)),
        ("weight", (b,)),
        ("counts", (r, width)),
        ("age_s", (r,)),
        ("t_s", ()),
        ("y", (lags, r, 4)),
        ("C", (lags, r, d, 4)),
        ("Y", (lags, r, 4, 4)),
        ("y_t_s", (lags,)),
    ]
    # A plain array of records, not a recarray: numba recognises its type four times faster.
    return np.zeros(n, np.dtype((np.record, [(name, "f8", shape) for name, shape in fields])))


class Work(Protocol):
    """Scratch of the kernels, and what they count.

    Attributes:
        pi: (r, width) transition matrix of each branch, one below the other. step: (width, width) of one.
        weight: (width, width) share of model a in what comes to model j. power, F, product, block, gain: scratch.
        apart, moment, off: (width, 4), (width, 4, 4), (4,) what mixing needs of each model.
        x, P, y, C, Y: (width, ...) what mixing gives.
        before, c, log_likelihood: (r,).
        repairs: how often a covariance that was none had to be replaced.
    """

    pi: FloatArray
    step: FloatArray
    weight: FloatArray
    power: FloatArray
    F: FloatArray
    product: FloatArray
    block: FloatArray
    gain: FloatArray
    apart: FloatArray
    moment: FloatArray
    off: FloatArray
    x: FloatArray
    P: FloatArray
    y: FloatArray
    C: FloatArray
    Y: FloatArray
    before: FloatArray
    c: FloatArray
    log_likelihood: FloatArray
    repairs: int


def make_work(models: Models) -> Work:
    """Scratch for the filters of these models; not to be used by two threads at once."""
    r, width, _, d, _ = _sizes(models)
    shapes = {
        "pi": (r, width),
        "step": (width, width),
        "weight": (width, width),
        "power": (width, width),
        "F": (6, 6),
        "product": (6, 6),
        "block": (6,),
        "gain": (6, 2),
        "apart": (width, 4),
        "moment": (width, 4, 4),
        "off": (4,),
        "x": (width, d),
        "P": (width, d, d),
        "y": (width, 4),
        "C": (width, d, 4),
        "Y": (width, 4, 4),
        "before": (r,),
        "c": (r,),
        "log_likelihood": (r,),
    }
    return cast("Work", _record(**{name: np.zeros(shape) for name, shape in shapes.items()}, repairs=0))


def _sizes(models: Models) -> tuple[int, int, int, int, int]:
    """Numbers r of models, of the longest branch, b of branches, d of states, of lags."""
    return len(models.kind), models.jump.shape[2], len(models.split_s), int(models.states.max()), int(models.lags)
