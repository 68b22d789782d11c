"""What a unit tells its neighbours: its share of the realm, and its tracks near the border."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import BandFrame, Geodetic, UnitArea
from trackmesh.services.fusion.partition.areas import Place
from trackmesh.services.fusion.partition.neighbours import State
from trackmesh.services.fusion.partition.ownership import Held
from trackmesh.services.fusion.partition.pairing import KEPT, SENT
from trackmesh.services.fusion.picture import Unit

FloatArray = npt.NDArray[np.float64]

_UPPER = np.triu_indices(4)


class Share(NamedTuple):
    """What a unit takes part with.

    Attributes:
        place: the area it looks after.
        width_m, handover_m: of the band, and how deep inside a track is taken over.
        confirm_s: how long a new track takes to be confirmed.
        standby: it waits for the unit of the same area to die.
        started_t_ns: of two units of one number the younger must stop.
    """

    place: Place
    width_m: float
    handover_m: float
    confirm_s: float
    standby: bool = False
    started_t_ns: int = 0


class Sender(NamedTuple):
    """Who speaks."""

    unit: Unit
    origin: Geodetic | None
    share: Share
    state: State

    def message(
        self,
        seq: int,
        t_ns: int,
        held: Held,
        owner: npt.NDArray[np.bool_],
        epoch: npt.NDArray[np.uint32],
        x: FloatArray,
        P: FloatArray,
    ) -> BandFrame:
        """Tracks with their states (n, 4) and covariances (n, 4, 4) at a time."""
        return BandFrame.model_construct(
            schema_version=1,
            unit_id=self.unit.unit_id,
            boot_id=self.unit.boot_id,
            seq=seq,
            t_ns=t_ns,
            area=self._area(),
            track_id=held.ident.copy(),
            owner=owner.astype(np.uint8),
            epoch=epoch,
            first_t_ns=held.first_t_ns,
            updated_t_ns=held.updated_t_ns,
            plot_keys=np.ascontiguousarray(held.keys[:, KEPT - SENT :]),
            state=x.astype(np.float32),
            covariance=np.ascontiguousarray(P[:, _UPPER[0], _UPPER[1]].astype(np.float32)),
        )

    def _area(self) -> UnitArea:
        place = self.share.place
        return UnitArea(
            unit_number=self.unit.number,
            started_t_ns=self.share.started_t_ns,
            origin=self.origin,
            centre_enu_m=place.centre_m,
            polygon_enu_m=place.polygon_m,
            width_m=self.share.width_m,
            state=self.state,
        )
