"""The estimators by name: each turns one scan into a ``Fit``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from trackmesh.services.emi.estimators.fit import Enough, Fit, Task, varpro
from trackmesh.services.emi.estimators.kalman import ekf9
from trackmesh.services.emi.estimators.thesis import initial, kf_ekf_thesis

__all__ = ["ESTIMATORS", "Enough", "Estimator", "EstimatorName", "Fit", "Task"]

EstimatorName = Literal["varpro", "ekf9", "kf-ekf-thesis", "initial"]
Estimator = Callable[[Task], Fit]
ESTIMATORS: dict[EstimatorName, Estimator] = {
    "varpro": varpro,
    "ekf9": ekf9,
    "kf-ekf-thesis": kf_ekf_thesis,
    "initial": initial,
}
