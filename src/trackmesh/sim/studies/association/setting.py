"""The experiment of Long, Cai, Li and Qiu (2022), section 4, as the print is read here, and its three tables.

Printed are: 20, 50 and 80 targets anywhere in 100 km by 100 km, half of them with constant velocity (230 to 270 m/s),
half with a constant acceleration (0 to 10 m/s^2, 200 to 300 m/s at first); two sensors that see all of them at the same
times; filters of six states; 100 runs; correct is the share of track points given to the right partner. Not printed are
all standard deviations, the interval and number of scans, alpha, how a decision is made, and how filters start. They
are read so:

* the partner of a track is the nearest one by the statistic, without a threshold. With a threshold the modified method,
  whose covariance is smaller, must accept fewer true pairs than the weighted one; printed is the opposite;
* errors of kilometres: with 500 m of noise and 500 m of interference all three methods are right above 99.6 %;
* both noise models see the same plots, Gaussian noise and interference; the traditional one does not count the latter
  in R and Q. The filter is linear, so a Kalman filter is what the unscented one of the paper would be;
* decisions begin with the fourth scan, when a filter knows a velocity. The sum of (28) begins with the first.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from trackmesh.services.estimation.uncertain import NoiseModel

Method = Literal["weighted", "modified", "sequential"]

METHODS: tuple[Method, ...] = ("weighted", "modified", "sequential")
"""In the order of the paper's tables 1, 2 and 3."""

COUNTS = (20, 50, 80)
PAPER_RUNS = 100

PRINTED: dict[Method, dict[NoiseModel, tuple[float, float, float]]] = {
    "weighted": {"gaussian": (75.00, 74.60, 73.46), "uncertain": (81.05, 76.42, 74.91)},
    "modified": {"gaussian": (86.34, 85.49, 78.30), "uncertain": (87.82, 85.94, 82.80)},
    "sequential": {"gaussian": (93.65, 94.56, 94.66), "uncertain": (96.25, 95.64, 94.79)},
}
"""Correct per cent for each of ``COUNTS``."""

SIDE_M = 100e3
QUIET_MPS, SWIFT_MPS, ACCELERATION_MPS2 = (230.0, 270.0), (200.0, 300.0), (0.0, 10.0)


class Setting(NamedTuple):
    """What the paper leaves open.

    Attributes:
        scans, scan_s: number and interval of scans. first: the first scan with a decision, from 0.
        noise_m, interference_m: standard deviations of measured positions, per axis.
        process_noise_m, process_interference_m: of positions from scan to scan, as the filters suppose it.
        jerk: variance that accelerations gain, (m/s^2)^2 a second, which makes a filter follow a turn.
        velocity_mps, acceleration_mps2: standard deviations with which a filter starts at rest.
        gaussian_interference: draw the interference from a Gaussian of the same sigma instead.
    """

    scans: int = 40
    scan_s: float = 10.0
    first: int = 3
    noise_m: float = 4_000.0
    interference_m: float = 8_000.0
    process_noise_m: float = 300.0
    process_interference_m: float = 600.0
    jerk: float = 25.0
    velocity_mps: float = 300.0
    acceleration_mps2: float = 10.0
    gaussian_interference: bool = False


SETTING = Setting()
