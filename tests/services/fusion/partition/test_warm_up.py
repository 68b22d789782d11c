"""Nothing is left to be compiled when a neighbour dies."""

from __future__ import annotations

from trackmesh.services.estimation import assignment, tracks
from trackmesh.services.fusion.partition.warm_up import warm_up
from trackmesh.services.fusion.settings import EngineSettings


def test_the_kernels_of_a_takeover_are_ready() -> None:
    warm_up(EngineSettings())
    for kernel in (tracks.begin_at, assignment.assign):
        # Without compilation a kernel is a plain function.
        assert getattr(kernel, "signatures", True)
