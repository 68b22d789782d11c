"""What the kernels work on, as numpy records: the rules of a filter, the filters themselves, ranges, scratch.

The fields of a record have fixed shapes, which are part of the type that numba compiles for: the numbers of models and
of states are constants of the compiled code.

A state is [east_m, north_m, veast, vnorth, aeast, anorth], and where the rules ask for them two more that all readers
share: the bias b in metres and the scale s of measured ranges, z = (1 + s) d + b + noise.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.motion import CONSTANT_VELOCITY, RANDOM_WALK, SINGER

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Records: TypeAlias = npt.NDArray[Any]
"""An array of records with the fields of one of the protocols below."""

EKF, UNSCENTED, PRINTED = range(3)
"""How a range updates: linearised at the mean, by the two-dimensional unscented transform, or as the slides print."""

UPDATES = {"ekf": EKF, "ut": UNSCENTED, "ukf-printed": PRINTED}
UpdateName = Literal["ut", "ekf", "ukf-printed"]
MotionName = Literal["singer", "tvimm"]
KINDS = {"singer": (SINGER,), "tvimm": (RANDOM_WALK, CONSTANT_VELOCITY, SINGER)}

ADAPT_VARIANCE, ADAPT_ALPHA, WITH_COVARIANCE, FORGET, MEAN_LAG, LIMITS = (1 << k for k in range(6))
"""What is adapted, and which of the mends against the slides' form are in it; see ``adaptation``."""

CORRECTED = ADAPT_VARIANCE | WITH_COVARIANCE | FORGET | LIMITS
PRINTED_ADAPTATION = ADAPT_VARIANCE | ADAPT_ALPHA

BIAS, SCALE = 6, 7
"""Places of the shared states of ranges."""


class Describe(NamedTuple):
    """A filter, as it is described.

    Attributes:
        motion: one Singer model, or the interacting random walk, constant velocity and Singer model.
        update: how a range updates.
        alpha: 1/s, how fast the acceleration of the Singer model is forgotten.
        acceleration_mps2: its standard deviation.
        speed_mps: standard deviation of the velocity at the start, per axis.
        walk_m2ps, velocity_m2ps3: noise density of the random walk's position and of the constant velocity.
        sojourn_s: mean time in each model.
        bias_sd_m, scale_sd: of the shared states of ranges at the start; 0: there is none.
        bias_drift, scale_drift: noise density of these, m^2/s and 1/s.
        doubt_long: a range longer than expected by more than so many sigmas is doubted; infinite: none is.
        doubt_short: likewise one that is shorter.
        adapt: flags of what is adapted.
        adapt_window: how many instants the adaptation remembers. adapt_after: before so many it changes nothing.
        acceleration_least_mps2, acceleration_most_mps2: bounds of the adapted standard deviation.
    """

    motion: MotionName = "singer"
    update: UpdateName = "ut"
    alpha: float = 0.5
    acceleration_mps2: float = 2.0
    speed_mps: float = 3.0
    walk_m2ps: float = 1.0
    velocity_m2ps3: float = 1.0
    sojourn_s: float = 5.0
    bias_sd_m: float = 0.0
    scale_sd: float = 0.0
    bias_drift: float = 1e-5
    scale_drift: float = 1e-9
    doubt_long: float = 1.5
    doubt_short: float = 4.0
    adapt: int = 0
    adapt_window: float = 30.0
    adapt_after: int = 8
    acceleration_least_mps2: float = 0.5
    acceleration_most_mps2: float = 30.0


class Rules(Protocol):
    """A described filter for the kernels: standard deviations as variances, names as numbers."""

    kind: IntArray
    update: int
    alpha: float
    variance: float
    speed_variance: float
    walk: float
    velocity: float
    sojourn_s: float
    bias_variance: float
    scale_variance: float
    bias_drift: float
    scale_drift: float
    doubt_long: float
    doubt_short: float
    adapt: int
    adapt_window: float
    adapt_after: int
    variance_least: float
    variance_most: float


def make_rules(d: Describe) -> Records:
    """The rules of a described filter, as an array of one record.

    Raises:
        ValueError: a number is out of its range, or the printed update is asked for more than it can do.
    """
    positive = (d.alpha, d.acceleration_mps2, d.speed_mps, d.walk_m2ps, d.velocity_m2ps3, d.sojourn_s, d.doubt_long,
                d.doubt_short, d.adapt_window)  # fmt: skip
    if not all(number > 0.0 for number in positive):
        raise ValueError("alpha, noises, times and limits of doubt of a filter must be positive")
    if not all(number >= 0.0 for number in (d.bias_sd_m, d.scale_sd, d.bias_drift, d.scale_drift)):
        raise ValueError("bias and scale of ranges must have standard deviations and drifts that are not negative")
    if d.update == "ukf-printed" and (d.motion != "singer" or d.bias_sd_m or d.scale_sd):
        raise ValueError("the printed update knows six states and one model")
    return _record(
        kind=np.array(KINDS[d.motion]),
        update=UPDATES[d.update],
        alpha=float(d.alpha),
        variance=float(d.acceleration_mps2) ** 2,
        speed_variance=float(d.speed_mps) ** 2,
        walk=float(d.walk_m2ps),
        velocity=float(d.velocity_m2ps3),
        sojourn_s=float(d.sojourn_s),
        bias_variance=float(d.bias_sd_m) ** 2,
        scale_variance=float(d.scale_sd) ** 2,
        bias_drift=float(d.bias_drift) if d.bias_sd_m else 0.0,
        scale_drift=float(d.scale_drift) if d.scale_sd else 0.0,
        doubt_long=float(d.doubt_long),
        doubt_short=float(d.doubt_short),
        adapt=int(d.adapt),
        adapt_window=float(d.adapt_window),
        adapt_after=int(d.adapt_after),
        variance_least=float(d.acceleration_least_mps2) ** 2,
        variance_most=float(d.acceleration_most_mps2) ** 2,
    )


class Filter(Protocol):
    """The filter of one tag, or of one hypothesis of where it is.

    Attributes:
        x, P, mu: (r, d), (r, d, d), (r,) states, covariances, probabilities of the models.
        t_s: its time.
        alpha, variance: (2,) of the Singer model, east and north; as the rules say until they are adapted.
        r0, r1, last_a: (2,) running moments of the estimated acceleration, and its last value.
        lag_s: mean time between instants. instants: how many there were.
        doubts: how many ranges in a row were doubted. fit: share of the late ranges that were not.
    """

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    t_s: float
    alpha: FloatArray
    variance: FloatArray
    r0: FloatArray
    r1: FloatArray
    last_a: FloatArray
    lag_s: float
    instants: int
    doubts: int
    fit: float


def sizes(rules: Records) -> tuple[int, int]:
    """Numbers r of models and d of states of filters by these rules."""
    one = rules[0]
    return len(one["kind"]), 8 if one["bias_variance"] > 0.0 or one["scale_variance"] > 0.0 else 6


def make_filters(rules: Records, *shape: int) -> Records:
    """Empty filters, an array of this shape."""
    r, d = sizes(rules)
    fields = [("x", "f8", (r, d)), ("P", "f8", (r, d, d)), ("mu", "f8", (r,)), ("t_s", "f8", ())]
    fields += [(name, "f8", (2,)) for name in ("alpha", "variance", "r0", "r1", "last_a")]
    fields += [("lag_s", "f8", ()), ("instants", "i8", ()), ("doubts", "i8", ()), ("fit", "f8", ())]
    return np.zeros(shape, np.dtype((np.record, fields)))


RANGE = np.dtype(
    (
        np.record,
        [
            ("row", "i8"),
            ("reader", "i8"),
            ("t_s", "f8"),
            ("range_m", "f8"),
            ("variance", "f8"),
            ("relative", "f8"),
        ],
    )
)
"""A range: row of the tag, row of the reader, time, metres, variance in m^2, and noise as a share of the distance."""


class Range(Protocol):
    """One record of ``RANGE``."""

    row: int
    reader: int
    t_s: float
    range_m: float
    variance: float
    relative: float


class Work(Protocol):
    """Scratch of the kernels, and what they tell of the last range.

    Attributes:
        step: (2, 3) transition of each axis. block: (6,) noise of an axis. u: (5,) distances at the sigma points.
        h: (4,) predicted distance, its gradient east and north, the variance that the gradient does not explain.
        gain: (d,). x, P: (r, d), (r, d, d) what mixing gives. weight: (r, r). c, log_likelihood: (r,).
        doubt: by how many sigmas the last range was longer than expected, averaged over the models.
        discarded: updates that the printed form has given up.
    """

    step: FloatArray
    block: FloatArray
    u: FloatArray
    h: FloatArray
    gain: FloatArray
    x: FloatArray
    P: FloatArray
    weight: FloatArray
    c: FloatArray
    log_likelihood: FloatArray
    doubt: float
    discarded: int


def joined(first: Records, second: Records) -> Records:
    """Two arrays of records of one kind, one behind the other."""
    # numpy joins records into structures without attributes.
    return np.concatenate([first, second]).view(first.dtype)


def make_work(rules: Records) -> Records:
    """Scratch for filters by these rules, as an array of one; not to be used by two threads at once."""
    r, d = sizes(rules)
    shapes = {"step": (2, 3), "block": (6,), "u": (5,), "h": (4,), "gain": (d,), "x": (r, d), "P": (r, d, d),
              "weight": (r, r), "c": (r,), "log_likelihood": (r,)}  # fmt: skip
    return _record(**{name: np.zeros(shape) for name, shape in shapes.items()}, doubt=0.0, discarded=0)


def _record(**fields: object) -> Records:
    """An array of one record of these fields: compiled functions take that faster than a bare record."""
    values = {name: np.asarray(value) for name, value in fields.items()}
    dtype = np.dtype((np.record, [(name, v.dtype, v.shape) for name, v in values.items()]))
    record = np.zeros(1, dtype)
    for name, value in values.items():
        record[name][0] = value
    return cast("Records", record)
