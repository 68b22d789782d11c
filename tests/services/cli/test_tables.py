"""Words of the tables that people read."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.messages import SensorBias
from trackmesh.services.cli.tables import bias_text


def test_a_bias_is_told_with_its_error_and_in_brackets_where_it_is_not_applied() -> None:
    bias = SensorBias(
        sensor_id="north",
        columns=["range_m", "azimuth_rad"],
        bias=np.array([148.3, np.deg2rad(0.391)]),
        covariance=np.diag([81.0, np.deg2rad(0.01) ** 2]),
        locked=True,
        pairs=5,
        jumps=0,
    )
    assert bias_text(bias) == "range 148 ± 9 m, azimuth 0.39 ± 0.01 deg"
    assert bias_text(bias.model_copy(update={"locked": False})) == "(range 148 ± 9 m, azimuth 0.39 ± 0.01 deg)"
