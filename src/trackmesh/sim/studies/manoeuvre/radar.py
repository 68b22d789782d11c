"""A radar far from the targets: ranges and azimuths, and range rates where it measures them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.estimation.convert import polar_to_plane
from trackmesh.services.estimation.plots import Plots, empty_plots

DISTANCE_M = (60e3, 100e3)
"""Of the radar from the middle of a flight."""

RANGE_SIGMA_M, RANGE_RATE_SIGMA_MPS = 50.0, 2.0

START_SIGMA_M = 100.0
"""Position error with which the filters are started."""


class Radar(NamedTuple):
    """Standard deviation of the azimuth, and whether range rates are measured."""

    azimuth_deg: float
    measures_rate: bool = False


def plots_of_radar(radar: Radar, truth: FloatArray, period_s: float, rng: np.random.Generator) -> Plots:
    """Plots (T, runs) of flights (runs, T + 1, 4), each seen by a radar of its own in any direction."""
    distance, bearing = rng.uniform(*DISTANCE_M, len(truth)), rng.uniform(0.0, 2.0 * np.pi, len(truth))
    middle = truth[:, :, :2].mean(axis=1)
    site = middle + distance[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    seen = np.swapaxes(truth[:, 1:], 0, 1)
    offset = seen[..., :2] - site
    range_m = np.hypot(offset[..., 0], offset[..., 1])
    rate_mps = (offset * seen[..., 2:]).sum(axis=-1) / range_m
    noise = rng.normal(size=(3, *range_m.shape))
    sigma_rad = np.deg2rad(radar.azimuth_deg)
    azimuth_rad = np.arctan2(offset[..., 0], offset[..., 1]) + sigma_rad * noise[1]
    plots = empty_plots(range_m.shape)
    plots["t_s"] = period_s * np.arange(1, len(plots) + 1)[:, None]
    plots["site"] = site
    for k, plot in enumerate(plots):
        variances = np.full(len(site), RANGE_SIGMA_M**2), np.full(len(site), sigma_rad**2)
        z, R = polar_to_plane(range_m[k] + RANGE_SIGMA_M * noise[0, k], azimuth_rad[k], None, *variances)
        plot["z"], plot["R"] = site + z, R
    if radar.measures_rate:
        plots["range_rate_mps"] = rate_mps + RANGE_RATE_SIGMA_MPS * noise[2]
        plots["range_rate_variance"] = RANGE_RATE_SIGMA_MPS**2
    return plots
