"""The estimators of Liu Zhiyang, EMI detection by filter tracking (2018), sections 4.2 and 4.3, to compare with.

They know no background, no outliers and no bounds. Misprints of signs and transposes are set right; the method is as
printed, with the innovation and gain of ``recursive``.
"""

from __future__ import annotations

from math import pi

import numpy as np

from trackmesh.services.emi.design import N_TENSOR, SCALE, response_rows
from trackmesh.services.emi.estimators.appraisal import appraise
from trackmesh.services.emi.estimators.fit import Fit, Task
from trackmesh.services.emi.estimators.start import by_point, cell_area, towards
from trackmesh.services.emi.fields import green_tensor
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.recursive import separate_filters
from trackmesh.services.emi.sensor import Sensor
from trackmesh.services.emi.varpro import Bounds

P0, Q = 10.0, 1e-8
"""P(0) = 10 I, R = I and Q = 1e-8 I (section 5.2.2)."""


def initial(task: Task) -> Fit:
    """First moment, half-power area, least squares."""
    return appraise(task, *initial_state(task))


def kf_ekf_thesis(task: Task) -> Fit:
    """Table 4-1: one pass of the separate filters from the initial state."""
    return appraise(task, *filtered_state(task))


def filtered_state(task: Task, samples: int | None = None) -> tuple[FloatArray, FloatArray]:
    """Position (3,) and tensors (C, 6) after so many samples; None: after all."""
    sensor, y, w = task.sensor, task.y, task.w.copy()
    if samples is not None:
        w[:, samples:] = 0.0
    r, tensor = initial_state(task)
    # The thesis leaves out all constants: h = G(d) M G(d) z, in m^-3 with M in m^3.
    unit = SCALE * sensor.moment_am2 / (4.0 * pi)
    bare = sensor._replace(moment_am2=4.0 * pi / SCALE)
    return separate_filters(bare, y / unit, (w > 0.0).astype(np.float64), r, tensor, P0, Q)


def initial_state(task: Task) -> tuple[FloatArray, FloatArray]:
    """Position (3,) by equations 4-7 to 4-9 on |B|, tensors (C, 6) by equation 4-16."""
    sensor, y, w = task.sensor, task.y, task.w
    size = np.sqrt(by_point(sensor, y**2))
    middle = size @ sensor.point_m[:, :2] / size.sum()
    area = float((size > 0.5 * size.max()).sum()) * cell_area(sensor.point_m[:, :2])
    bounds: Bounds = task.ground.bounds
    r = np.array([*middle, bounds.surface_m + towards(bounds) * 2.0 * np.sqrt(area / pi)])
    return r, _least_squares(sensor, y, w, r)


def _least_squares(sensor: Sensor, y: FloatArray, w: FloatArray, r: FloatArray) -> FloatArray:
    """Tensors (C, 6) by unweighted least squares on T = G^-1 B, where three components make a vector."""
    rows = response_rows(sensor, r[None])
    data = np.moveaxis(y, 0, -1).copy()
    for j, (first, after) in enumerate(zip(sensor.first[:-1], sensor.first[1:], strict=True)):
        if after - first == 3:
            basis = np.linalg.inv(green_tensor(sensor.rx_m[:, j] - r) @ sensor.direction[:, first:after].mT).mT
            rows[:, first:after], data[:, first:after] = basis @ rows[:, first:after], basis @ data[:, first:after]
    present = (w > 0.0).all(0).ravel()
    A, b = rows.reshape(-1, N_TENSOR)[present], data.reshape(-1, len(y))[present]
    scale = np.linalg.norm(A, axis=0)
    return np.asarray((np.linalg.lstsq(A / scale, b)[0] / scale[:, None]).T)
