"""One decorator for all hot kernels: plain mathematics of one track inside a loop, compiled by numba and cached.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python, for oracles and debugging.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

# All flags but nnan and ninf: those would let the compiler drop the guards against non-finite numbers.
_FASTMATH = {"contract", "reassoc", "nsz", "arcp"}


def kernel(function: F) -> F:
    """Compile a function with numba, cached on disk and shared by all processes."""
    compiled: Any = numba.njit(cache=True, fastmath=_FASTMATH, error_model="numpy")(function)
    return cast("F", compiled)


def cache_folder() -> Path:
    """Where compiled kernels are kept: one folder for each state of the sources.

    numba looks only at the file of a kernel itself, not at those it calls from other files; a folder named by the
    content of all of them makes a stale kernel impossible.
    """
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    digest = hashlib.sha256(numba.__version__.encode())
    for room in ("estimation", "fusion"):
        for source in sorted((Path(__file__).resolve().parent.parent / room).glob("*.py")):
            digest.update(source.read_bytes())
    return base / "trackmesh" / "numba" / digest.hexdigest()[:16]


if not os.environ.get("NUMBA_CACHE_DIR"):
    setattr(numba.config, "CACHE_DIR", str(cache_folder()))  # noqa: B010 - numba's stubs do not know it
