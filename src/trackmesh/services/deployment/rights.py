"""Who may do what: the rights of each role, as keys of the realm. This is the one place where they are written down."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from trackmesh.protocol.keys import Keys


@dataclass(frozen=True)
class Rights:
    """What somebody may do; key expressions, nothing else is allowed.

    Attributes:
        says: publishes there.
        lives: declares there that it is alive.
        answers: questions to these keys.
        hears: what is published there.
        asks: questions to these keys.
        watches: who is alive.
    """

    says: Sequence[str] = ()
    lives: Sequence[str] = ()
    answers: Sequence[str] = ()
    hears: Sequence[str] = ()
    asks: Sequence[str] = ()
    watches: Sequence[str] = ()


RightsOf = Callable[[Keys, Sequence[str]], Rights]

_SIMULATED = ("sim-radar", "sim-tags")
ALL = "*"


def _sensor(keys: Keys, ids: Sequence[str]) -> Rights:
    kinds = [(kind, ident) for kind in _SIMULATED for ident in ids]
    return Rights(
        says=[one(ident) for ident in ids for one in (keys.plots, keys.ranges, keys.sensor)]
        + [keys.status(kind, ident) for kind, ident in kinds],
        lives=[keys.live("sensor", ident) for ident in ids] + [keys.live(kind, ident) for kind, ident in kinds],
        answers=[keys.sensor(ident) for ident in ids],
    )


def _service(kind: str, keys: Keys, name: str) -> tuple[list[str], list[str]]:
    return [keys.status(kind, name)], [keys.live(kind, name)]


def _fusion(keys: Keys, ids: Sequence[str]) -> Rights:
    (name,) = ids
    says, lives = _service("fusion", keys, name)
    pictures = (keys.tracks, keys.refined, keys.registration, keys.band)
    return Rights(
        says=[one(name) for one in pictures] + says,
        lives=lives,
        answers=[keys.service("tracks", name)],
        hears=[one(ALL) for one in (keys.plots, keys.sensor, *pictures)] + [keys.status("fusion", ALL)],
        asks=[keys.sensor(ALL), keys.service("tracks", ALL)],
        watches=[keys.live(ALL, ALL)],
    )


def _emi(keys: Keys, ids: Sequence[str]) -> Rights:
    (name,) = ids
    says, lives = _service("emi", keys, name)
    return Rights(says, lives, answers=[keys.service("emi", name)], watches=[keys.asking(ALL)])


def _tags(keys: Keys, ids: Sequence[str]) -> Rights:
    (name,) = ids
    says, lives = _service("tags", keys, name)
    return Rights(
        says=[keys.tags(name), *says],
        lives=lives,
        hears=[keys.ranges(ALL), keys.sensor(ALL)],
        asks=[keys.sensor(ALL)],
        watches=[keys.live("sensor", ALL)],
    )


def _archive(keys: Keys, ids: Sequence[str]) -> Rights:
    (name,) = ids
    says, lives = _service("archive", keys, name)
    return Rights(
        says,
        lives,
        answers=[keys.service("history", name)],
        hears=[keys.everything()],
        asks=[keys.sensor(ALL), keys.service("tracks", ALL)],
        watches=[keys.live(ALL, ALL)],
    )


def _viewer(keys: Keys, _ids: Sequence[str]) -> Rights:
    pictures = (keys.tracks, keys.refined, keys.tags, keys.registration, keys.sensor, keys.truth)
    return Rights(
        # Who asks for scans to be inverted says that it waits.
        lives=[keys.asking(ALL)],
        hears=[one(ALL) for one in pictures] + [keys.status(ALL, ALL)],
        asks=[keys.sensor(ALL), keys.service(ALL, ALL)],
        watches=[keys.live(ALL, ALL)],
    )


def _gateway(keys: Keys, ids: Sequence[str]) -> Rights:
    (name,) = ids
    says, lives = _service("gateway", keys, name)
    seen = _viewer(keys, ids)
    return Rights(says, [*lives, *seen.lives], hears=seen.hears, asks=seen.asks, watches=seen.watches)


def _router(keys: Keys, _ids: Sequence[str]) -> Rights:
    # Another router speaks for all behind it, and has checked them itself.
    everything = [keys.everything()]
    return Rights(everything, everything, everything, everything, everything, everything)


RIGHTS: dict[str, RightsOf] = {
    "sensor": _sensor,
    "fusion": _fusion,
    "emi": _emi,
    "tags": _tags,
    "archive": _archive,
    "gateway": _gateway,
    "viewer": _viewer,
    "router": _router,
}
