"""How well a sensor measures: the variance of every column of its plots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import PlotBatch, SensorInfo
from trackmesh.protocol.messages.plots import LARGEST_SIGMA
from trackmesh.services.estimation.uncertain import NoiseModel

FloatArray = npt.NDArray[np.float64]

_PLACED_BY = 2


def measured_names(columns: Sequence[str]) -> list[str]:
    """The column whose sigma each variance is the square of: of geodetic plots they go east, north, up."""
    if columns[0] == "latitude_deg":
        return ["longitude_deg", "latitude_deg", *columns[2:]]
    return list(columns)


class Accuracy:
    """The errors that a sensor tells of, in its plots or of itself.

    Under the noise model ``uncertain`` the interference that it declares is one more error, independent of the noise:
    R = R_noise + R_interference (see ``estimation.uncertain``), also where a batch brings the variances of its noise.
    No angle is worse than half a turn.
    """

    def __init__(self, info: SensorInfo, noise_model: NoiseModel = "gaussian") -> None:
        self._info = info
        self._interference = (info.interference or {}) if noise_model == "uncertain" else {}

    def variances(self, batch: PlotBatch) -> FloatArray:
        """Variances (n, c) of the columns of a batch, those of geodetic ones east, north, up; infinite where unknown.

        Raises:
            RefusedMessage: nothing is known of the first two, which place the plots.
        """
        names = measured_names(batch.columns)
        if batch.variances is None:
            variances = np.empty((len(batch.values), len(names)))
            variances[:] = [self._noise(name, k < _PLACED_BY) for k, name in enumerate(names)]
        else:
            variances = batch.variances
        if not self._interference:
            return variances
        most = [LARGEST_SIGMA.get(name, np.inf) ** 2 for name in names]
        return np.minimum(variances + [self._interference.get(name, 0.0) ** 2 for name in names], most)

    def _noise(self, name: str, needed: bool) -> float:
        if needed and name not in self._info.sigma:
            raise RefusedMessage(
                "no_variance", f"Sensor {self._info.sensor_id} gives neither variances nor sigma of {name}."
            )
        return float(self._info.sigma.get(name, np.inf)) ** 2
