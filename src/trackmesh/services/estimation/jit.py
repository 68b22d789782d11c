"""The decorators of hot kernels: plain mathematics inside a loop, compiled by numba and cached on disk.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python, for oracles and debugging.
"""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_DEPENDS_ON = {"estimation": ("estimation",), "fusion": ("estimation", "fusion"), "emi": ("emi",)}


def kernel(function: F) -> F:
    """Compile a function with numba, cached on disk and shared by all processes.

    No fast mathematics: with it the last bits of a result depend on what the compiler chose to inline, which is not the
    same in a process that compiled a kernel as in one that loaded it, and equal inputs must give equal bytes.
    """
    return _compiled(function)


def inlined(function: F) -> F:
    """As ``kernel``, and compiled into each of its callers: there its arguments may be constants."""
    return _compiled(function, forceinline=True)


def parallel_kernel(function: F) -> F:
    """As ``kernel``, and the interpreter lock is released."""
    return _compiled(function, nogil=True)


def _compiled(function: F, **options: object) -> F:
    if not os.environ.get("NUMBA_CACHE_DIR"):
        room = Path(function.__code__.co_filename).parent.name
        # numba reads this when it decorates.
        setattr(numba.config, "CACHE_DIR", str(cache_folder(room)))  # noqa: B010 - numba's stubs do not know it
    njit: Any = numba.njit
    return cast("F", njit(cache=True, error_model="numpy", **options)(function))


@functools.cache
def cache_folder(room: str) -> Path:
    """Where the compiled kernels of a room are kept: one folder for each state of the sources they are made from.

    numba looks only at the file of a kernel itself, not at those it calls from other files; a folder named by the
    content of all of them makes a stale kernel impossible. The base is ``$TRACKMESH_CACHE``, else
    ``$XDG_CACHE_HOME/trackmesh``, else ``~/.cache/trackmesh``; where that cannot be written, a folder of this process.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for needed in _DEPENDS_ON.get(room, (room,)):
        for source in sorted((Path(__file__).resolve().parent.parent / needed).glob("*.py")):
            digest.update(source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    folder = Path(os.environ.get("TRACKMESH_CACHE") or Path(base) / "trackmesh") / "numba"
    wanted = folder / f"{room}-{digest.hexdigest()[:16]}"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return wanted
    except OSError:
        # Never a shared name under /tmp: the cache holds code, and others could plant theirs.
        return Path(tempfile.mkdtemp(prefix="trackmesh-numba-"))
