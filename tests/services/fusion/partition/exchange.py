"""Two or more units without filters: targets that fly over borders, tracks that are what was seen of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import BandFrame, UnitArea
from trackmesh.services.fusion.partition.ownership import Depths, Held, Ownership
from trackmesh.services.fusion.partition.pairing import KEPT, NO_KEY, SENT

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

WIDTH_M, HANDOVER_M, CYCLE_S = 8000.0, 1000.0, 2.0
CYCLE_NS = round(CYCLE_S * 1e9)


@dataclass
class Track:
    """What a unit knows of a target: the id it gives it, its plots."""

    ident: int
    first_ns: int
    updated_ns: int = 0
    keys: list[int] = field(default_factory=list)


class Mock:
    """A unit: the ownership, and a track for every target that is near enough."""

    def __init__(self, index: int, number: int) -> None:
        self.index = index
        self.number = number
        self.tracks: dict[int, Track] = {}
        self._next = 0
        self.ownership = Ownership(number, self.fresh, CYCLE_NS)
        self._seq = 0

    def fresh(self, n: int) -> IntArray:
        self._next += n
        return (self.number << 41) | (self._next - n + 1 + np.arange(n))

    def see(self, target: int, depth_m: float, key: int, now_ns: int) -> None:
        if depth_m <= -WIDTH_M:
            self.tracks.pop(target, None)
            return
        track = self.tracks.setdefault(target, Track(0, now_ns))
        track.keys.append(key)
        track.updated_ns = now_ns
        if not track.ident and len(track.keys) >= 4:
            track.ident = int(self.fresh(1)[0])

    def named(self) -> list[int]:
        return sorted(target for target, track in self.tracks.items() if track.ident)

    def held(self) -> Held:
        rows = [self.tracks[target] for target in self.named()]
        keys = [([NO_KEY] * KEPT + row.keys)[-KEPT:] for row in rows]
        return Held(
            np.array([row.ident for row in rows], np.int64), np.array(keys, np.int64).reshape(-1, KEPT),
            np.array([row.first_ns for row in rows], np.int64), np.array([row.updated_ns for row in rows], np.int64),
        )  # fmt: skip

    def cycle(self, depth_m: dict[int, float], alive: list[int]) -> None:
        held = self.held()
        self.ownership.cycle += 1
        self.ownership.known(held.ident)
        at = Depths(np.array([depth_m[t] for t in self.named()]), WIDTH_M, HANDOVER_M)
        self.ownership.pull(held.ident, at, np.array(alive, np.int64))

    def hear(self, told: BandFrame, sender: Mock, now_ns: int) -> None:
        held = self.held()
        self.ownership.known(held.ident)
        ident = self.ownership.hear(held, told, sender.index, sender.number, now_ns)
        for target, new in zip(self.named(), ident.tolist(), strict=True):
            self.tracks[target].ident = new

    def message(self, now_ns: int) -> BandFrame:
        held = self.held()
        self._seq += 1
        return band(held, self.ownership.owned(held.ident), self.ownership.epochs(held.ident), now_ns, self.number)

    def owned(self) -> dict[int, int]:
        """Ids of the targets that it shows."""
        held, named = self.held(), self.named()
        ours = self.ownership.owned(held.ident)
        return {target: int(held.ident[k]) for k, target in enumerate(named) if ours[k]}


def band(held: Held, owner: npt.NDArray[np.bool_], epoch: npt.ArrayLike, t_ns: int, number: int = 2) -> BandFrame:
    """A message of these tracks; where they are does not matter here."""
    n = len(held.ident)
    area = UnitArea(unit_number=number, started_t_ns=0, centre_enu_m=np.zeros(2), width_m=WIDTH_M, state="active")
    return BandFrame(
        unit_id=f"unit-{number}", boot_id="one", seq=0, t_ns=t_ns, area=area, track_id=held.ident,
        owner=owner.astype(np.uint8), epoch=np.asarray(epoch, np.uint32), first_t_ns=held.first_t_ns,
        updated_t_ns=held.updated_t_ns, plot_keys=held.keys[:, KEPT - SENT :],
        state=np.zeros((n, 4), np.float32), covariance=np.zeros((n, 10), np.float32),
    )  # fmt: skip
