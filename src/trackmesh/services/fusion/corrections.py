"""What is wrong with the sensors, as the engine and the service use it: plots corrected, estimates told and kept."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.files import RegistrationRecord
from trackmesh.protocol.messages import Registration, SensorBias, SensorInfo
from trackmesh.services.estimation.plots import Plots
from trackmesh.services.fusion import registration
from trackmesh.services.fusion.biases import Estimate, Kind, RegistrationRules


class Corrections:
    """The registration of a unit; without rules there is none, and nothing is ever corrected.

    Attributes:
        biases: the filter over the biases, or None.
    """

    def __init__(self, rules: RegistrationRules | None, right_clocks: Collection[str] = ()) -> None:
        self.biases = registration.Registration(rules) if rules else None
        self._ids: list[str] = []
        self._right_clocks = frozenset(right_clocks)

    def announce(self, index: int, info: SensorInfo, site_m: npt.NDArray[np.float64]) -> None:
        """Take note of a sensor, by its index in the engine, or of its new place."""
        if index == len(self._ids):
            self._ids.append(info.sensor_id)
        if self.biases is not None:
            kind: Kind = "polar" if info.kind == "radar" else "position"
            prior = self.biases.rules.prior(kind)
            if info.sensor_id in self._right_clocks:
                prior[2] = 0.0
            self.biases.announce(info.sensor_id, kind, site_m, prior)

    def correct(self, plots: Plots) -> Plots:
        """Plots of one or more sensors, each corrected by what is applied to its sensor."""
        if self.biases is None or not any(self.biases.locked(sensor_id) for sensor_id in self._ids):
            return plots
        out = plots
        for index in np.unique(plots["sensor"]).tolist():
            out = self.correct_of(index, out, out["sensor"] == index)
        return out

    def correct_of(self, index: int, plots: Plots, which: npt.NDArray[np.bool_] | slice = slice(None)) -> Plots:
        """As ``correct``, where it is known which plots are of sensor ``index``; by default all."""
        if self.biases is None or not self.biases.locked(self._ids[index]):
            return plots
        out = plots.copy()
        # From where each was measured: a sensor that moves has moved on since.
        out["z"][which] -= self.biases.shift(self._ids[index], plots["z"][which], site_m=plots["site"][which])
        out["t_s"][which] += self.biases.time_offset_s(self._ids[index])
        return out

    def message(self, unit_id: str, boot_id: str, seq: int, t_ns: int) -> Registration:
        """The present estimates."""
        found = self.biases.messages() if self.biases is not None else []
        return Registration(
            unit_id=unit_id, boot_id=boot_id, seq=seq, t_ns=t_ns, sensors=[_message(one) for one in found]
        )

    def record(self, t_ns: int) -> RegistrationRecord | None:
        """All that the next start should know, as of a time."""
        if self.biases is None:
            return None
        snapshot = self.biases.snapshot()
        state = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in snapshot.items()}
        return RegistrationRecord(t_ns=t_ns, state=state)

    def restore(self, record: RegistrationRecord, now_ns: int) -> RegistrationRecord | None:
        """Go on from what an earlier run knew, before the first sensor; what is left of that now.

        Raises:
            TrackmeshError: the record is none of this version.
        """
        if self.biases is None:
            return None
        try:
            self.biases.restore(record.state, max(0.0, (now_ns - record.t_ns) / 1e9))
        except ValueError as error:
            raise TrackmeshError(f"The registration of the last run cannot be used: {error}.") from None
        return self.record(now_ns)


def _message(estimate: Estimate) -> SensorBias:
    return SensorBias(
        sensor_id=estimate.sensor_id,
        columns=estimate.columns,
        bias=estimate.bias,
        covariance=estimate.covariance,
        locked=estimate.locked,
        pairs=estimate.pairs,
        jumps=estimate.jumps,
        notes=estimate.notes,
        time_offset_s=estimate.time_offset_s,
        time_offset_sigma_s=float(np.sqrt(estimate.time_offset_variance_s2)),
    )
