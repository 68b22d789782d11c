"""``trackmesh compile``: the numerics compiled before anybody waits for them."""

from __future__ import annotations

import time
from collections.abc import Callable

from trackmesh.services.cli.options import say, told


@told
def compile_() -> None:
    """Compile the numerics. Into the cache, for images and before a first start."""
    for name, work in (("fusion", _fusion), ("tags", _tags), ("emi", _emi)):
        say(f"{name}: {_seconds(work):.1f} s")


def _fusion() -> None:
    from trackmesh.services.fusion.partition import warm_up as partition
    from trackmesh.services.fusion.settings import EngineSettings
    from trackmesh.services.fusion.warm_up import warm_up

    warm_up(EngineSettings(), inputs=True)
    partition.warm_up(EngineSettings())


def _tags() -> None:
    from trackmesh.services.tags.settings import TagEngineSettings
    from trackmesh.services.tags.warm_up import warm_up

    warm_up(TagEngineSettings())


def _emi() -> None:
    from trackmesh.services.emi.service.warm_up import warm_up

    warm_up()


def _seconds(work: Callable[[], None]) -> float:
    started_s = time.monotonic()
    work()
    return time.monotonic() - started_s
