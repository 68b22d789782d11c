"""From a batch to ranges that the kernels can take: what cannot be used is left out and counted, reading by reading.

A message that is wrong is refused whole, before; here a reading is wrong and spoils no other: of a reader that is not
known, below nought by more than its noise, farther than the reader could ever hear, of one tag too many.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import RangeBatch
from trackmesh.services.tags.readers import Readers
from trackmesh.services.tags.records import RANGE, Records
from trackmesh.services.tags.roll import Roll
from trackmesh.services.tags.rssi import INFLATION, PathLoss
from trackmesh.services.tags.settings import TagEngineSettings

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_NOISE = 5.0
_REACH = 2.0
_TYPICAL = 2.0 / 3.0


class Inputs:
    """Turns batches into records of ``RANGE``.

    Attributes:
        losses: by network, the law of its signal strengths.
    """

    def __init__(self, settings: TagEngineSettings, readers: Readers, counters: Counter[str]) -> None:
        self._settings = settings
        self._readers = readers
        self._counters = counters
        self.losses: dict[str, PathLoss] = {}

    def ranges(self, batch: RangeBatch, t_s: FloatArray, roll: Roll) -> Records:
        """The usable ranges of a batch (k,) at times (n,) of the engine."""
        reader = self._readers.rows(batch.readers)[batch.reader]
        good = self._known(reader)
        reader = np.maximum(reader, 0)
        z, variance, relative = self._measured(batch, reader, good)
        good &= self._plausible(z, np.sqrt(variance + (relative * z) ** 2), reader, good)
        row = self._rows(batch, good, roll)
        good &= row >= 0
        out = np.zeros(int(good.sum()), RANGE)
        for name, values in (("row", row), ("reader", reader), ("t_s", t_s), ("variance", variance)):
            out[name] = values[good]
        out["range_m"] = np.maximum(z[good], 0.0)
        out["relative"] = relative
        self._counters["ranges"] += len(out)
        return out

    def _known(self, reader: IntArray) -> BoolArray:
        known = np.asarray(reader >= 0)
        self._counters["unknown_reader"] += int(len(known) - known.sum())
        return known if self._readers.names else np.zeros(len(known), bool)

    def _measured(self, batch: RangeBatch, reader: IntArray, good: BoolArray) -> tuple[FloatArray, FloatArray, float]:
        """Ranges (n,), their constant variance (n,), and their noise as a share of the distance."""
        if not good.any():
            return np.zeros(len(reader)), np.ones(len(reader)), 0.0
        if batch.range_m is not None:
            variance = batch.variance_m2 if batch.variance_m2 is not None else self._readers.variance[reader]
            self._set_apart_references(batch, good)
            return np.asarray(batch.range_m), variance, 0.0
        assert batch.rssi_dbm is not None
        law = self._law(batch.network_id)
        reference = self._set_apart_references(batch, good)
        self._teach(law, batch, reader, reference)
        z, noise = law.ranges_m(batch.rssi_dbm), law.relative_noise
        if self._settings.update == "ekf":
            # Linearised at a mean that may be wrong, noise that depends on the distance misleads.
            sigma = noise / INFLATION * _TYPICAL * self._readers.reach_m[reader]
            return z, sigma * sigma, 0.0
        return z, np.full(len(z), 1e-6), noise

    def _law(self, network_id: str) -> PathLoss:
        return self.losses.setdefault(network_id, PathLoss(self._settings.path_loss()))

    def _set_apart_references(self, batch: RangeBatch, good: BoolArray) -> BoolArray:
        """Which readings are of reference tags and known readers; they are taken out of ``good``."""
        if not self._settings.references:
            return np.zeros(len(good), bool)
        known = np.array([name in self._settings.references for name in batch.tags], bool)[batch.tag] & good
        good &= ~known
        self._counters["reference_readings"] += int(known.sum())
        return known

    def _teach(self, law: PathLoss, batch: RangeBatch, reader: IntArray, wanted: BoolArray) -> None:
        if not wanted.any():
            return
        assert batch.rssi_dbm is not None
        places = self._settings.references
        at = np.array([places.get(name, [0.0, 0.0]) for name in batch.tags])[batch.tag[wanted]]
        place = self._readers.place[reader[wanted]]
        distance = np.sqrt(((at - place[:, :2]) ** 2).sum(axis=1) + place[:, 2] ** 2)
        law.learn(distance, batch.rssi_dbm[wanted])

    def _plausible(self, z: FloatArray, sigma: FloatArray, reader: IntArray, good: BoolArray) -> BoolArray:
        if not good.any():
            return good
        negative = good & (z < -_NOISE * sigma)
        absurd = good & (z > _REACH * self._readers.reach_m[reader] + _NOISE * sigma)
        self._counters["negative_ranges"] += int(negative.sum())
        self._counters["absurd_ranges"] += int(absurd.sum())
        return np.asarray(~negative & ~absurd)

    def _rows(self, batch: RangeBatch, good: BoolArray, roll: Roll) -> IntArray:
        """Row of the tag of each reading; tags of which nothing can be used get none."""
        tag = batch.tag.astype(np.int64)
        wanted = np.unique(tag[good])
        row = np.full(max(len(batch.tags), 1), -1, np.int64)
        row[wanted] = roll.rows([batch.tags[k] for k in wanted.tolist()])
        found = row[tag] if len(tag) else np.empty(0, np.int64)
        self._counters["too_many_tags"] += int((good & (found < 0)).sum())
        return found
