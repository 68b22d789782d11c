"""A router for the tests that run on both kinds of bus."""

from __future__ import annotations

from tests.network.processes import router

__all__ = ["router"]
