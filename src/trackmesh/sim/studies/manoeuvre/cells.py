"""The cells of the study: which targets, seen how often and how well, and what is simulated for each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.plots import Plots
from trackmesh.sim.studies.filtering import plots_of
from trackmesh.sim.studies.manoeuvre.radar import START_SIGMA_M, Radar, plots_of_radar
from trackmesh.sim.studies.manoeuvre.targets import Flights, fly_family
from trackmesh.sim.studies.manoeuvre_targets import Measured

P_DETECT = 0.8
"""The other probability of detection, beside certainty."""

DURATION_S = {1.0: 600.0, 2.0: 800.0, 4.0: 1000.0, 10.0: 1600.0}
"""Of a flight, by the interval of scans."""

IN_FAMILY, OUT_OF_FAMILY, NEW = "turns and speed changes", "other targets", "not tried before"
"""Groups of cells: what the filter is made for, what it has to bear, and what none of its numbers was chosen on."""

OTHERS = ("weave", "jink", "singer", "wna", "cv")
"""Families whose targets neither turn nor change speed along their path."""

OTHER_SAMPLING = ((1.0, 10.0), (2.0, 30.0), (4.0, 30.0), (10.0, 100.0))
"""Interval and standard deviation of the plots of each of them: from a fast, sharp sensor to a slow, blunt one."""

_SEED = 20261122


class Cell(NamedTuple):
    """Targets of one family, a scan every ``period_s`` with ``sigma_m`` per axis, or as the radar measures."""

    name: str
    group: str
    family: str
    period_s: float
    sigma_m: float
    duration_s: float
    radar: Radar | None = None


class Simulated(NamedTuple):
    """What a filter is given in a cell, and the truth: plots (T, runs), detected (runs, T) or None where all are."""

    flights: Flights
    case: Measured
    plots: Plots
    detected: FloatArray | None = None


def all_cells() -> tuple[Cell, ...]:
    """Every cell with certain detection, in the order of the tables."""
    r = ((1, 10), (1, 30), (1, 100), (2, 30), (4, 10), (4, 30), (4, 100), (10, 30), (10, 100))
    known = [Cell("T0", IN_FAMILY, "T0", 1.0, 20.0, 172.0), *(_cell("R", IN_FAMILY, *sampling) for sampling in r)]
    others = [_cell(family, OUT_OF_FAMILY, *sampling) for family in OTHERS for sampling in OTHER_SAMPLING]
    sampling_of_new = ((1, 30), (2, 30), (4, 30), (10, 30))
    new = [_cell(family, NEW, *sampling) for family in ("both", "s-turns") for sampling in sampling_of_new]
    return (*known, *others, *new, *_radar_cells())


def _cell(family: str, group: str, period_s: float, sigma_m: float) -> Cell:
    name = f"{family}{period_s:g}/{sigma_m:g}"
    return Cell(name, group, family, float(period_s), float(sigma_m), DURATION_S[period_s])


def _radar_cells() -> list[Cell]:
    return [
        Cell(f"radar{period_s:g}/{azimuth_deg:g}{rate}", NEW, "R", period_s, START_SIGMA_M, 400.0, radar)
        for period_s in (2.0, 4.0)
        for azimuth_deg in (0.1, 0.5)
        for rate in ("", " range rate")
        for radar in [Radar(azimuth_deg, measures_rate=bool(rate))]
    ]


def simulate(cell: Cell, runs: int) -> Simulated:
    """Runs of a cell with every plot there; they depend on what is flown and how it is measured, nothing else."""
    radar = cell.radar
    # With and without range rate the plots are the same.
    rng = _chance(cell.family, cell.period_s, radar.azimuth_deg if radar else cell.sigma_m, bool(radar))
    flights = fly_family(cell.family, runs, cell.period_s, cell.duration_s, rng)
    if radar is not None:
        plots = plots_of_radar(radar, flights.truth, cell.period_s, rng)
        position = np.swapaxes(plots["z"], 0, 1)
        return Simulated(flights, Measured(flights.truth, position, cell.period_s, cell.sigma_m), plots)
    noise = rng.normal(0.0, cell.sigma_m, (*flights.truth[:, 1:].shape[:2], 2))
    case = Measured(flights.truth, flights.truth[:, 1:, :2] + noise, cell.period_s, cell.sigma_m)
    return Simulated(flights, case, plots_of(case))


def with_misses(cell: Cell, simulated: Simulated) -> Simulated:
    """The same, each plot being there with probability ``P_DETECT``."""
    rng = _chance("misses", cell.name)
    detected = rng.random(simulated.plots.shape[::-1]) < P_DETECT
    return simulated._replace(detected=detected.astype(float))


def _chance(*what: object) -> np.random.Generator:
    """A source of chance for these words alone."""
    return np.random.default_rng([_SEED, *"/".join(map(str, what)).encode()])
