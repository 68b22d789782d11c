"""Compile every kernel, or load it from the cache: the first request shall not wait for that."""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.estimators import ESTIMATORS
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import Coils


def warm_up() -> None:
    """Invert something small in every way there is."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    positions = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    field = 1.0 / (1.0 + ((positions - 2.0) ** 2).sum(1))[None, None, :, None] * np.ones(3)
    field[..., 7, 0] += 5.0
    for is_loop in (True, False):
        list(invert(Coils(positions, 0.5, 1.0, is_loop), field, 0.01, Options(most_targets=2)))
    for name in ESTIMATORS:
        list(invert(Coils(positions, 0.5, 1.0), field, None, Options(estimator=name)))
    list(invert(Coils(positions, 0.5, 1.0), np.zeros_like(field), 1.0, Options()))
