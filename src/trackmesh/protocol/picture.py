"""One picture of the frames of several units."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray, IntArray, UInt8Array, UInt32Array
from trackmesh.protocol.merging import ahead
from trackmesh.protocol.messages import COASTING, ENDED, TrackFrame

_ROW = np.dtype(
    [
        ("track_id", "<i8"),
        ("epoch", "<u4"),
        ("status", "|u1"),
        ("unit", "<i4"),
        ("t_ns", "<i8"),
        ("updated_t_ns", "<i8"),
        ("first_t_ns", "<i8"),
        ("heard_s", "<f8"),
        ("state", "<f8", (6,)),
        ("covariance", "<f4", (21,)),
        ("height_m", "<f8"),
    ]
)
_UPPER = np.triu_indices(6)

Rows = npt.NDArray[np.void]


@dataclass(frozen=True)
class Picture:
    """The tracks of all units at one moment, ordered by ``track_id``.

    Shapes: ``state`` (n, 6) and ``covariance`` (n, 6, 6) as in ``TrackFrame``, both at ``t_ns`` (n,), the time of the
    frame that told them; ``height_m`` (n,) is NaN where unknown. ``stale`` marks tracks of which nothing was heard for
    a while.
    """

    track_id: IntArray
    epoch: UInt32Array
    status: UInt8Array
    unit_id: list[str]
    t_ns: IntArray
    updated_t_ns: IntArray
    first_t_ns: IntArray
    state: FloatArray
    covariance: FloatArray
    height_m: FloatArray
    stale: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.track_id)


class TrackPicture:
    """Merges frames into one picture.

    Of one track told by two units the higher epoch counts, with equal epochs the later time; status 3 ends a track;
    silence makes it stale, and longer silence forgets it. A track that is missing from a frame has not ended, but it is
    left out once its unit has told others for ``missing_s``. A frame that comes after a later one of the same unit is
    left out.

    Whoever follows the liveliness of units says so by ``note_alive``: until its neighbours go on with them, the tracks
    of a dead unit are predicted by their velocities and marked coasting, for the lease and ``missing_s``.

    Args:
        stale_after_s: silence that makes a track stale.
        forget_after_s: silence after which a track is left out, and an ended one forgotten.
        missing_s: two cycles of units that share a realm.
        lease_s: after which a dead host is noticed.
        clock: seconds that only grow; silence is measured by it, not by the times in the frames.
    """

    def __init__(
        self,
        stale_after_s: float = 15.0,
        forget_after_s: float = 60.0,
        missing_s: float = 4.0,
        lease_s: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stale_after_s = stale_after_s
        self.forget_after_s = forget_after_s
        self.missing_s = missing_s
        self.bridge_s = lease_s + missing_s
        self._clock = clock
        self._newest_ns: dict[int, int] = {}
        self._dead: set[int] = set()
        self._rows: Rows = np.empty(0, _ROW)
        self._units: list[str] = []
        self._last: dict[str, tuple[str, int]] = {}

    def update(self, frame: TrackFrame) -> None:
        """Take in a frame."""
        boot_id, seq = self._last.get(frame.unit_id, ("", -1))
        if boot_id == frame.boot_id and frame.seq <= seq:
            return
        self._last[frame.unit_id] = (frame.boot_id, frame.seq)
        new = self._rows_of(frame)
        self._newest_ns[self._unit(frame.unit_id)] = frame.t_ns
        # Two units that could not hear each other may both have told a track: the end by one is not the end of it.
        over = (self._rows["status"] == ENDED) & (self._rows["t_ns"] < frame.t_ns - round(self.missing_s * 1e9))
        both = np.concatenate([self._rows[~over], new])
        # The last of each id in this order is the one that counts.
        both = both[np.lexsort((both["heard_s"], both["t_ns"], both["epoch"], both["track_id"]))]
        ids = both["track_id"]
        last_of_id = np.append(ids[1:] != ids[:-1], True) if len(ids) else np.empty(0, bool)
        self._rows = both[last_of_id & (both["heard_s"] >= self._clock() - self.forget_after_s)]

    def note_alive(self, unit_id: str, alive: bool) -> None:
        """Take note of a unit that came or went."""
        (self._dead.discard if alive else self._dead.add)(self._unit(unit_id))

    def picture(self) -> Picture:
        """The picture now, without ended tracks."""
        now_s = self._clock()
        rows = self._rows
        rows = rows[(rows["status"] != ENDED) & (rows["heard_s"] >= now_s - self.forget_after_s)]
        rows = self._bridged(rows[~self._missing(rows)], now_s)
        covariance = np.zeros((len(rows), 6, 6))
        covariance[:, _UPPER[0], _UPPER[1]] = rows["covariance"]
        covariance[:, _UPPER[1], _UPPER[0]] = rows["covariance"]
        return Picture(
            track_id=rows["track_id"].copy(),
            epoch=rows["epoch"].copy(),
            status=rows["status"].copy(),
            unit_id=[self._units[i] for i in rows["unit"].tolist()],
            t_ns=rows["t_ns"].copy(),
            updated_t_ns=rows["updated_t_ns"].copy(),
            first_t_ns=rows["first_t_ns"].copy(),
            state=rows["state"].copy(),
            covariance=covariance,
            height_m=rows["height_m"].copy(),
            stale=rows["heard_s"] < now_s - self.stale_after_s,
        )

    def _missing(self, rows: Rows) -> npt.NDArray[np.bool_]:
        newest = np.array([self._newest_ns.get(unit, 0) for unit in range(len(self._units))], np.int64)
        return np.asarray(newest[rows["unit"]] - rows["t_ns"] > round(self.missing_s * 1e9))

    def _bridged(self, rows: Rows, now_s: float) -> Rows:
        """Rows of dead units, which nobody else tells as yet, where they should be by now."""
        dead = np.isin(rows["unit"], list(self._dead))
        rows = rows[~dead | (now_s - rows["heard_s"] <= self.bridge_s)].copy()
        dead = np.isin(rows["unit"], list(self._dead))
        dt_s = (now_s - rows["heard_s"])[dead]
        rows["state"][dead], rows["covariance"][dead] = ahead(rows["state"][dead], rows["covariance"][dead], dt_s)
        rows["t_ns"][dead] += np.rint(dt_s * 1e9).astype(np.int64)
        rows["status"][dead] = COASTING
        return rows

    def _unit(self, unit_id: str) -> int:
        if unit_id not in self._units:
            self._units.append(unit_id)
        return self._units.index(unit_id)

    def _rows_of(self, frame: TrackFrame) -> Rows:
        rows = np.empty(len(frame.track_id), _ROW)
        for name in ("track_id", "epoch", "status", "updated_t_ns", "first_t_ns", "state", "covariance"):
            rows[name] = getattr(frame, name)
        rows["unit"] = self._unit(frame.unit_id)
        rows["t_ns"] = frame.t_ns
        rows["heard_s"] = self._clock()
        rows["height_m"] = np.nan
        known = frame.height_known()
        if frame.height_m is not None:
            rows["height_m"][known] = frame.height_m[known]
        return rows
