"""The filters and the worlds that are compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.services.tags.records import (
    ADAPT_VARIANCE,
    CORRECTED,
    FORGET,
    LIMITS,
    MEAN_LAG,
    PRINTED_ADAPTATION,
    WITH_COVARIANCE,
    Describe,
)
from trackmesh.services.tags.rssi import INFLATION
from trackmesh.services.tags.settings import TagEngineSettings
from trackmesh.sim.scenario import Rssi
from trackmesh.sim.studies.rfid.bound import bound_given, posterior_bound
from trackmesh.sim.studies.rfid.runs import FIRST_VARIANCE, Outcome, follow
from trackmesh.sim.studies.rfid.worlds import (
    MATCHED_ALPHA,
    MATCHED_VARIANCE,
    Data,
    hall,
    matched,
    reference,
    simulate,
    weighed,
)

FloatArray = npt.NDArray[np.float64]

NEVER = 1e9
SPARSE = 0.05
RSSI_NOISE = 0.15
CORNERS = 0.12

Progress = Callable[[], None]


def describe(**change: Any) -> Describe:
    """A filter that doubts no range: Singer's model with alpha 0.5/s and 2 m/s^2, unless changed."""
    return Describe(**({"doubt_long": NEVER, "doubt_short": NEVER} | change))


def one_sided(c: float, **change: Any) -> Describe:
    """A filter that doubts ranges longer by more than c sigmas."""
    return describe(doubt_long=c, **change)


SERVICE = TagEngineSettings().description()
"""What the tag service does unless it is told otherwise."""

TVIMM = {"motion": "tvimm", "walk_m2ps": SERVICE.walk_m2ps, "velocity_m2ps3": SERVICE.velocity_m2ps3}
SLIDES = {"alpha": 0.05, "acceleration_mps2": 246.0**0.5, "acceleration_most_mps2": 30.0}
"""How the slides begin: alpha 1/20, and (4 - pi) / pi of the square of the largest acceleration, 30 m/s^2."""


class Row(NamedTuple):
    """One filter in one world."""

    name: str
    outcome: Outcome


class World(NamedTuple):
    """One world and the filters in it.

    Attributes:
        bound_m: least RMS error at all ticks, by information averaged over what readers may hear; where it is known.
        given_m: the same for what they did hear.
    """

    name: str
    title: str
    rows: list[Row]
    bound_m: float = 0.0
    given_m: float = 0.0


def clean(runs: int, seed: int) -> Iterator[tuple[str, Describe]]:
    """The filters of the world without corners."""
    yield "ekf", describe(update="ekf")
    yield "ut", describe(update="ut")
    yield "ukf, printed", describe(update="ukf-printed")
    yield "ekf, one-sided 1.5", one_sided(1.5, update="ekf")
    yield "ut, one-sided 1.5", one_sided(1.5)
    yield "ekf, adapted", describe(update="ekf", adapt=CORRECTED)
    yield "ut, adapted", describe(adapt=CORRECTED)
    yield "ekf, tvimm", describe(update="ekf", **TVIMM)
    yield "ut, tvimm", describe(**TVIMM)
    yield "service default", SERVICE
    yield "ekf, slides' adaptation", describe(update="ekf", adapt=PRINTED_ADAPTATION, **SLIDES)
    yield "ukf, slides' adaptation", describe(update="ukf-printed", adapt=PRINTED_ADAPTATION, **SLIDES)


def sparse() -> Iterator[tuple[str, Describe]]:
    """The filters where readers seldom hear."""
    for name, change in (
        ("0.5, 4", {}),
        ("0.05, 10", {"alpha": 0.05, "acceleration_mps2": 10.0**0.5}),
        ("0.05, 246", SLIDES),
    ):
        for update in ("ekf", "ut", "ukf-printed"):
            yield f"{update.replace('ukf-printed', 'ukf, printed')} ({name})", describe(update=update, **change)
    yield "service default", SERVICE


def corners() -> Iterator[tuple[str, Describe]]:
    """The filters where some ranges go round a corner."""
    yield "ekf", describe(update="ekf")
    yield "ut", describe()
    yield "ekf, one-sided 1.5", one_sided(1.5, update="ekf")
    yield "ut, one-sided 1.5", one_sided(1.5)
    yield "ut, tvimm", describe(**TVIMM)
    yield "service default", SERVICE


_FIXED: dict[str, Any] = {"acceleration_most_mps2": 30.0}
ABLATION: tuple[tuple[str, int, dict[str, Any]], ...] = (
    ("as in the slides", PRINTED_ADAPTATION, SLIDES),
    ("and P_aa", PRINTED_ADAPTATION | WITH_COVARIANCE, SLIDES),
    ("and forgetting", PRINTED_ADAPTATION | FORGET, SLIDES),
    ("and the mean interval", PRINTED_ADAPTATION | MEAN_LAG, SLIDES),
    ("all three, and limits", PRINTED_ADAPTATION | WITH_COVARIANCE | FORGET | MEAN_LAG | LIMITS, SLIDES),
    ("variance alone, alpha 0.5", CORRECTED, _FIXED),
    ("variance alone, without P_aa", ADAPT_VARIANCE | FORGET | LIMITS, _FIXED),
)
"""The adaptation of the slides, mended one by one: flags, and how the filter begins."""


def clean_data(runs: int, seed: int) -> Data:
    """The world of the scenario: ranges of 2 m, each reader in reach hears one tick in four."""
    tags = hall()
    return simulate(tags, reference(tags, runs), seed)


def sparse_data(runs: int, seed: int, p_detect: float) -> Data:
    """The same with readers that hear less."""
    tags = hall(p_detect=p_detect)
    return simulate(tags, reference(tags, runs), seed)


def corner_data(runs: int, seed: int) -> Data:
    """The same with a share of ranges that go round a corner, 8 m longer in the mean."""
    tags = hall(nlos_share=CORNERS)
    return simulate(tags, reference(tags, runs), seed)


def strength_world(runs: int, seed: int) -> World:
    """Signal strengths, whose noise is a share of the distance: which noise the filter should be told."""
    noise_db = 10.0 * 2.5 * RSSI_NOISE / np.log(10.0)
    tags = hall(rssi=Rssi(exponent=2.5, noise_db=noise_db))
    data = simulate(tags, reference(tags, runs), seed)
    rows = []
    for name, change, sigma_m, relative in (
        ("ekf, 3 m", {"update": "ekf"}, 3.0, 0.0),
        ("ut, 3 m", {}, 3.0, 0.0),
        ("ekf, share of the distance", {"update": "ekf"}, 1e-3, RSSI_NOISE),
        ("ut, share of the distance", {}, 1e-3, RSSI_NOISE),
        ("ut, 1.3 times that", {}, 1e-3, INFLATION * RSSI_NOISE),
    ):
        rows.append(Row(name, follow(describe(**change), weighed(data, sigma_m, relative))))
    return World("C", f"signal strengths, noise {RSSI_NOISE:g} of the distance", rows)


def matched_world(runs: int, seed: int) -> World:
    """Paths of the filter's own model, and the bound that no filter can go below."""
    tags = hall()
    truth = matched(tags, runs, seed)
    data = simulate(tags, truth, seed)
    first = truth[0] + np.sqrt(FIRST_VARIANCE) * np.random.default_rng([seed, 6]).standard_normal(truth[0].shape)
    own = {"alpha": MATCHED_ALPHA, "acceleration_mps2": MATCHED_VARIANCE**0.5, "speed_mps": 1.0}
    rows = [Row(name, follow(describe(update=name, **own), data, first)) for name in ("ekf", "ut")]
    prior = np.array([FIRST_VARIANCE, FIRST_VARIANCE, 1.0, 1.0, MATCHED_VARIANCE, MATCHED_VARIANCE])
    model = (MATCHED_ALPHA, MATCHED_VARIANCE, prior)
    bounds = posterior_bound(tags, truth, *model), bound_given(data, *model)
    return World("E", "paths of the filter's own model", rows, *bounds)
