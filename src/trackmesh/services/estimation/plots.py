"""Plots as the filters take them: positions in the plane with their covariance; range rates and heights where known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class Plot(Protocol):
    """One plot.

    Attributes:
        z: (2,) [east_m, north_m]. R: (3,) its covariance [ee, en, nn] in m^2.
        t_s: when. sensor: index of who measured it.
        range_rate_mps: growth of the slant range; range_rate_variance: its variance, infinite where it is unknown.
        site: (2,) where the sensor stood in the plane. site_velocity: (2,) how it moved itself.
        level: cosine of the elevation under which it sees the plot.
        height_m: of the target; height_variance_m2: its variance, infinite where it is unknown.
        key: names the plot where several units hear the same ones, else 0.
    """

    z: FloatArray
    R: FloatArray
    t_s: float
    sensor: int
    range_rate_mps: float
    range_rate_variance: float
    site: FloatArray
    site_velocity: FloatArray
    level: float
    height_m: float
    height_variance_m2: float
    key: int


Plots: TypeAlias = npt.NDArray[Any]
"""Many plots: an array of records with the fields of ``Plot``."""

Move: TypeAlias = Callable[[Plots], FloatArray]
"""Where plots (m,) belong instead: positions (m, 2)."""

# Tracks remember many plots: what few sensors measure is kept in half the bytes.
_PLOT = np.dtype(
    (
        np.record,
        [
            ("z", "f8", (2,)),
            ("R", "f8", (3,)),
            ("t_s", "f8"),
            ("sensor", "i8"),
            ("range_rate_mps", "f8"),
            ("range_rate_variance", "f8"),
            ("site", "f8", (2,)),
            ("site_velocity", "f4", (2,)),
            ("level", "f8"),
            ("height_m", "f4"),
            ("height_variance_m2", "f4"),
            ("key", "i8"),
        ],
    )
)


def make_plots(z: npt.ArrayLike, R: npt.ArrayLike, t_s: npt.ArrayLike, sensor: int = 0) -> Plots:
    """Plots without range rate or height.

    Args:
        z: (m, 2). R: (m, 3). t_s: (m,), or one time for all.
        sensor: who measured them.
    """
    position = np.asarray(z, float).reshape(-1, 2)
    plots = empty_plots((len(position),))
    plots["z"], plots["R"], plots["t_s"], plots["sensor"] = position, R, t_s, sensor
    return plots


def empty_plots(shape: tuple[int, ...]) -> Plots:
    """Plots of which nothing is known."""
    plots = np.zeros(shape, _PLOT)
    plots["range_rate_variance"] = plots["height_variance_m2"] = np.inf
    plots["level"] = 1.0
    return plots
