"""The geometries that clients have sent: a batch may name one by its content instead of sending it again."""

from __future__ import annotations

import threading
from collections import OrderedDict

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import EmiGeometry, EmiScanBatch


class Geometries:
    """The last ``most`` geometries used, by ``EmiGeometry.content_id``. Any thread may ask."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._known: OrderedDict[str, EmiGeometry] = OrderedDict()

    def resolve(self, batch: EmiScanBatch) -> tuple[str, EmiGeometry]:
        """The geometry of a batch and its id; one that comes with it is remembered.

        Raises:
            RefusedMessage: ``unknown_geometry``; ``wrong_length`` if it does not fit the batch; ``invalid`` if the
                batch brings another geometry than the one it names.
        """
        if batch.geometry is None:
            return self._named(batch)
        ident = batch.geometry.content_id()
        if batch.geometry_id not in (None, ident):
            raise RefusedMessage("invalid", f"The geometry is {ident}, not {batch.geometry_id}.")
        with self._lock:
            self._known[ident] = batch.geometry
            self._known.move_to_end(ident)
            while len(self._known) > self._most:
                self._known.popitem(last=False)
        return ident, batch.geometry

    def _named(self, batch: EmiScanBatch) -> tuple[str, EmiGeometry]:
        ident = batch.geometry_id or ""
        with self._lock:
            geometry = self._known.get(ident)
            if geometry is not None:
                self._known.move_to_end(ident)
        if geometry is None:
            raise RefusedMessage("unknown_geometry", f"The geometry {ident} is not known here; send it.")
        if problem := batch.misfit(geometry):
            raise RefusedMessage("wrong_length", f"EmiScanBatch: {problem}.")
        return ident, geometry
