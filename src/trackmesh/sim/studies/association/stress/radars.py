"""The targets of a case and what the two radars measure of them; every plot is known by its target."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation import uncertain
from trackmesh.services.estimation.convert import polar_to_plane
from trackmesh.services.estimation.plots import Plots, empty_plots
from trackmesh.sim.legs import Legs, turning_legs, unit_vector
from trackmesh.sim.scenario import Targets
from trackmesh.sim.studies.association.stress.cases import (
    BIAS_AZIMUTH_DEG,
    BIAS_RANGE_M,
    P_DETECT,
    SIGMA_AZIMUTH_DEG,
    SIGMA_RANGE_M,
    WARM_UP_S,
    Case,
)
from trackmesh.sim.truth import Truth

BoolArray = npt.NDArray[np.bool_]

SPEED_MPS, QUIET_MPS = (200.0, 300.0), (230.0, 270.0)
TURN_DEGPS, TURN_S, TURNING = (1.0, 4.0), (10.0, 25.0), 0.3
"""Of the targets that turn: rates, durations, share of time."""

PERIODS_S, ASYNCHRONOUS_S = (2.0, 2.0), (2.0, 2.7)
GAP_S, GAPS = 15.0, 0.3

_SITES = ((0.2, 0.3), (0.8, 0.6))
"""As shares of a square of 100 km about the middle of the targets."""

_SITES_SIDE_M = 100e3


class Sensor(NamedTuple):
    """What a radar measures in a case.

    Attributes:
        site_m: (2,).
        period_s: of a turn.
        plots: (turns, targets), times included.
        seen: (turns, targets) whether there is a plot.
    """

    site_m: FloatArray
    period_s: float
    plots: Plots
    seen: BoolArray


def simulate(case: Case, seed: int) -> tuple[Sensor, Sensor]:
    """Both radars over the same targets."""
    rng = np.random.default_rng([seed, *case.name.encode()])
    end_s = WARM_UP_S + case.duration_s
    truth, offset_m = _targets(case, rng, end_s)
    first, second = (_sensor(case, truth, offset_m, k, end_s, rng) for k in range(2))
    return first, second


def _targets(case: Case, rng: np.random.Generator, end_s: float) -> tuple[Truth, FloatArray]:
    """Paths, and what is added to the positions of each target: that is zero but for the followers of formations."""
    formation = case.formation_m > 0.0
    count = case.targets // 2 if formation else case.targets
    described = Targets(
        count=count, area_enu_m=(0.0, 0.0, case.side_m, case.side_m), speed_mps=SPEED_MPS,
        turn_rate_deg_s=TURN_DEGPS, turn_duration_s=TURN_S, manoeuvre_share=TURNING,
    )  # fmt: skip
    quiet = count // 2
    start = rng.uniform(0.0, case.side_m, (quiet, 2))
    straight = Legs(
        np.arange(quiet + 1), np.zeros(quiet), start, rng.uniform(*QUIET_MPS, quiet),
        rng.uniform(0.0, 2.0 * np.pi, quiet), np.zeros(quiet),
    )  # fmt: skip
    legs = Legs.join([turning_legs(described, count - quiet, rng, end_s), straight])
    offset_m = np.zeros((count, 2))
    if formation:
        legs = Legs.join([legs, legs])
        beside = case.formation_m * unit_vector(rng.uniform(0.0, 2.0 * np.pi, count))
        offset_m = np.concatenate([offset_m, beside])
    n = len(offset_m)
    return Truth(np.arange(n), np.zeros(n, np.bool_), np.zeros(n), np.full(n, np.inf), end_s, legs), offset_m


def _sensor(
    case: Case, truth: Truth, offset_m: FloatArray, which: int, end_s: float, rng: np.random.Generator
) -> Sensor:
    period_s = (ASYNCHRONOUS_S if case.asynchronous else PERIODS_S)[which]
    site = case.side_m / 2.0 + _SITES_SIDE_M * (np.array(_SITES[which]) - 0.5)
    n, turns = len(offset_m), int(np.ceil(end_s / period_s)) + 1
    begin_s = period_s * np.arange(turns)[:, None] + np.zeros(n)
    t_s = begin_s
    if case.asynchronous:
        # The beam is at north at the begin of a turn; how far the target moves until it comes is of no importance here.
        azimuth = _polar(truth, offset_m, site, begin_s)[1]
        t_s = begin_s + period_s * np.mod(azimuth / (2.0 * np.pi) + 0.37 * which, 1.0)
    range_m, azimuth = _polar(truth, offset_m, site, t_s)
    sigma = case.scale * np.array([SIGMA_RANGE_M, np.deg2rad(SIGMA_AZIMUTH_DEG)])
    error = sigma * (rng.standard_normal((turns, n, 2)) + uncertain.sample(rng, (turns, n, 2)))
    if case.bias and which == 1:
        error += [BIAS_RANGE_M, np.deg2rad(BIAS_AZIMUTH_DEG)]
    variance = uncertain.assumed_variance(sigma, sigma, "uncertain" if case.told else "gaussian")
    plots = empty_plots((turns, n))
    plots["t_s"] = t_s
    plots["z"], plots["R"] = _placed(range_m + error[..., 0], azimuth + error[..., 1], variance)
    plots["z"] += site
    return Sensor(site, period_s, plots, _seen(case, t_s, rng))


def _polar(truth: Truth, offset_m: FloatArray, site_m: FloatArray, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """True ranges and azimuths (turns, n) at times (turns, n)."""
    rows = np.broadcast_to(np.arange(len(offset_m)), t_s.shape).ravel()
    position = truth.states(rows, t_s.ravel())[:, :2].reshape(*t_s.shape, 2) + offset_m - site_m
    return np.hypot(position[..., 0], position[..., 1]), np.arctan2(position[..., 0], position[..., 1])


def _placed(range_m: FloatArray, azimuth: FloatArray, variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (turns, n, 2) about the radar and covariances (turns, n, 3)."""
    flat = range_m.ravel()
    z, R = polar_to_plane(flat, azimuth.ravel(), None, *(np.full(len(flat), v) for v in variance))
    return z.reshape(*range_m.shape, 2), R.reshape(*range_m.shape, 3)


def _seen(case: Case, t_s: FloatArray, rng: np.random.Generator) -> BoolArray:
    n = t_s.shape[1]
    seen = (rng.random(t_s.shape) < P_DETECT) & (rng.random(n) < case.coverage)
    if case.gaps:
        begin_s = WARM_UP_S + rng.uniform(0.0, case.duration_s - GAP_S, n)
        lost = rng.random(n) < GAPS
        seen &= ~(lost & (t_s >= begin_s) & (t_s < begin_s + GAP_S))
    return np.asarray(seen)
