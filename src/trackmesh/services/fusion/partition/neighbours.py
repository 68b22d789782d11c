"""The other units of the realm: who is alive, what they look after, and what is therefore ours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import BandFrame, Registration, TrackFrame, UnitArea
from trackmesh.services.fusion.partition.areas import NOWHERE, Area, Place, area_of, convex

State = Literal["joining", "active", "standby"]

_MOST_UNITS = 1024


class Ourselves(NamedTuple):
    """Who we are among the others: name, number, when we started, what we look after."""

    unit_id: str
    number: int
    started_t_ns: int
    place: Place


@dataclass
class Neighbour:
    """What is known of another unit.

    Attributes:
        index: its number here, never used twice.
        number, started_t_ns: what it says of itself.
        boot_id, seq: of its last band message.
        place, state: of its area.
        width_m: how far beyond it takes plots.
        alive: whether its liveliness token is there.
        tracks: its last picture. registration: its last estimate of biases.
    """

    index: int
    unit_id: str
    number: int
    started_t_ns: int
    boot_id: str
    seq: int
    place: Place
    state: State
    width_m: float
    alive: bool = False
    tracks: TrackFrame | None = None
    registration: Registration | None = None


class Neighbours:
    """All other units, by name.

    Attributes:
        us: this unit.
        state: of this unit.
        conflict: why this unit must stop, where it must.
    """

    def __init__(self, us: Ourselves, state: State) -> None:
        self.us = us
        self.state: State = state
        self.conflict: str | None = None
        self._known: dict[str, Neighbour] = {}
        self._alive: frozenset[str] = frozenset()
        self._tracks: dict[str, TrackFrame] = {}
        self._registrations: dict[str, Registration] = {}
        self._count = 0
        self._founders: set[int] = set()

    # --- what is heard ---

    def now_alive(self, units: frozenset[str]) -> list[Neighbour]:
        """These units are alive now; those that owned an area and are gone."""
        self._alive = units
        before = {one.unit_id for one in self.owners()}
        for one in self._known.values():
            one.alive = one.unit_id in units
        return [one for one in self._known.values() if one.unit_id in before and not one.alive]

    def hear(self, told: BandFrame) -> tuple[Neighbour, bool]:
        """Take note of a message; its sender, and whether that changes anybody's area.

        Raises:
            RefusedMessage: ``own_band``, ``old_frame``, ``too_many_units``, ``same_number`` or ``wrong_area``.
        """
        if told.unit_id == self.us.unit_id:
            raise RefusedMessage("own_band", "This is a band message of this unit itself.")
        old = self._known.get(told.unit_id)
        if old is not None and old.boot_id == told.boot_id and told.seq <= old.seq:
            raise RefusedMessage("old_frame", f"Band message {told.seq} of {told.unit_id} came after {old.seq}.")
        if old is None and len(self._known) >= _MOST_UNITS:
            raise RefusedMessage("too_many_units", f"There are {_MOST_UNITS} units already.")
        self._check_number(told)
        new = self._new(told, old)
        self._known[told.unit_id] = new
        new.alive = told.unit_id in self._alive
        if self.state == new.state == "joining":
            self._founders.add(new.index)
        changed = old is None or old.alive != new.alive or old.state != new.state or not old.place.same(new.place)
        return new, changed or old is None or old.boot_id != new.boot_id

    def _new(self, told: BandFrame, old: Neighbour | None) -> Neighbour:
        same = old is not None and old.boot_id == told.boot_id
        if not same:
            self._count += 1
        index = old.index if old is not None and same else self._count - 1
        area = told.area
        return Neighbour(
            index, told.unit_id, area.unit_number, area.started_t_ns, told.boot_id, told.seq,
            _place(area), area.state, area.width_m,
        )  # fmt: skip

    def _check_number(self, told: BandFrame) -> None:
        theirs, us = told.area, self.us
        if theirs.unit_number != us.number or told.unit_id not in self._alive:
            return
        both = f"The units {us.unit_id} and {told.unit_id} both have the unit_number {us.number}"
        if (theirs.started_t_ns, told.unit_id) < (us.started_t_ns, us.unit_id):
            self.conflict = f"{both}, and {told.unit_id} had it first: give this unit another."
        raise RefusedMessage("same_number", f"{both}.")

    def hear_tracks(self, frame: TrackFrame) -> None:
        """Keep the last picture of a unit: it is what others go on from should it die."""
        last = self._tracks.get(frame.unit_id)
        again = last is not None and last.boot_id == frame.boot_id and frame.seq <= last.seq
        if frame.unit_id in self._known and not again:
            self._tracks[frame.unit_id] = frame

    def hear_registration(self, told: Registration) -> None:
        """Keep what a unit thinks of its sensors."""
        if told.unit_id in self._known:
            self._registrations[told.unit_id] = told

    def pop_tracks(self, unit_id: str) -> TrackFrame | None:
        """The last picture of a unit, once."""
        return self._tracks.pop(unit_id, None)

    def registrations(self) -> Iterator[Registration]:
        """The last that units told of their sensors."""
        yield from self._registrations.values()

    # --- what follows ---

    def owners(self) -> list[Neighbour]:
        """The other units that own an area now: those alive and active, and those that stand by for nobody alive.

        Units that began together wait for nobody: each counts on the others from the start.
        """
        alive = [one for one in self._known.values() if one.alive]
        active = [one for one in alive if one.state == "active" or one.index in self._founders]
        places = [one.place for one in active]
        if self.state == "active":
            places.append(self.us.place)
        found = list(active)
        for one in sorted(alive, key=lambda one: one.number):
            if one.state == "standby" and not any(one.place.same(place) for place in places):
                found.append(one)
                places.append(one.place)
        return found

    def owning(self) -> bool:
        """Whether this unit owns its area."""
        if self.state != "standby":
            return self.state == "active"
        rivals = [one for one in self._known.values() if one.alive and one.place.same(self.us.place)]
        return not any(one.state == "active" or one.number < self.us.number for one in rivals)

    def area(self) -> Area:
        """What is ours, or will be once we own it."""
        owners = [one.place for one in self.owners() if not one.place.same(self.us.place)]
        return area_of(self.us.place, owners)

    def area_with_joining(self) -> Area | None:
        """What will be ours once those who are joining own areas; None where nobody is, or stands by for us."""
        alive = [one for one in self._known.values() if one.alive]
        joining = [one.place for one in alive if one.state == "joining" and one.index not in self._founders]
        heirs = any(one.state == "standby" for one in alive)
        if heirs or any(place.same(self.us.place) for place in joining):
            return Area(NOWHERE)
        if not joining:
            return None
        owners = [one.place for one in self.owners() if not one.place.same(self.us.place)] + joining
        return area_of(self.us.place, owners)

    def indices(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Numbers (n,) of the units that own areas."""
        return np.array([one.index for one in self.owners()], np.int64)

    def alone(self) -> bool:
        """Whether no other unit owned anything before we began."""
        return not any(one.index not in self._founders for one in self.owners())

    def told_of(self) -> bool:
        """Whether any other unit is alive and has said what it looks after."""
        return any(one.alive for one in self._known.values())


def _place(area: UnitArea) -> Place:
    if area.polygon_enu_m is not None:
        try:
            convex(area.polygon_enu_m)
        except ValueError as error:
            raise RefusedMessage("wrong_area", f"The area of a neighbour cannot be: {error}.") from None
    return Place(area.centre_enu_m, area.polygon_enu_m)
