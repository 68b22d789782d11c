"""Which local tracks belong to which system tracks: those that keep taking the same plots."""

from __future__ import annotations

import numpy as np

from trackmesh.services.estimation.lookup import index_of
from trackmesh.services.fusion.layer import Layer

SHARED_NEEDED = 2


def renew(system: Layer, local: Layer, sensor: int) -> None:
    """Write the members of one sensor into the system rows.

    A local track that shared its last two plots with a system track becomes its member. A member leaves when it has
    ended or now shares its plots with another system track; otherwise it is not displaced.
    """
    rows, live = system.rows, local.rows
    system_uid, local_uid = system.life.uid[rows], local.life.uid[live]
    claimed = np.where(local.life.link_n[live] >= SHARED_NEEDED, local.life.link[live], -1)
    member = system.life.member[rows, sensor]

    place = index_of(local_uid, member)
    gone = place < 0
    if len(live):
        claim = claimed[place]
        gone |= (claim >= 0) & (claim != system_uid)
    member = np.where(gone, -1, member)

    target = index_of(system_uid, claimed)
    new = (target >= 0) & (claimed >= 0)
    new[new] = member[target[new]] < 0
    member[target[new]] = local_uid[new]
    system.life.member[rows, sensor] = member
