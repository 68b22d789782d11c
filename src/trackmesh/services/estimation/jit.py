"""The decorators of hot kernels: plain mathematics inside a loop, compiled by numba and cached on disk.

With NUMBA_DISABLE_JIT=1 the same functions run as plain Python, for oracles and debugging.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_ROOMS_WITH_KERNELS = ("estimation", "fusion", "emi")

# All flags but nnan and ninf: those would let the compiler drop the guards against non-finite numbers.
_FASTMATH = {"contract", "reassoc", "nsz", "arcp"}


def kernel(function: F) -> F:
    """Compile a function with numba, cached on disk and shared by all processes."""
    compiled: Any = numba.njit(cache=True, fastmath=_FASTMATH, error_model="numpy")(function)
    return cast("F", compiled)


def exact_kernel(function: F) -> F:
    """As ``kernel``, but the arithmetic is done exactly as written, and the interpreter lock is released."""
    compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return cast("F", compiled)


def cache_folder() -> Path:
    """Where compiled kernels are kept: one folder for each state of the sources.

    numba looks only at the file of a kernel itself, not at those it calls from other files; a folder named by the
    content of all of them makes a stale kernel impossible. The base is ``$TRACKMESH_CACHE``, else
    ``$XDG_CACHE_HOME/trackmesh``, else ``~/.cache/trackmesh``; where that cannot be written, a folder of this process.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for room in _ROOMS_WITH_KERNELS:
        for source in sorted((Path(__file__).resolve().parent.parent / room).glob("*.py")):
            digest.update(source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    wanted = Path(os.environ.get("TRACKMESH_CACHE") or Path(base) / "trackmesh") / "numba" / digest.hexdigest()[:16]
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=wanted):
            return wanted
    except OSError:
        # Never a shared name under /tmp: the cache holds code, and others could plant theirs.
        return Path(tempfile.mkdtemp(prefix="trackmesh-numba-"))


if not os.environ.get("NUMBA_CACHE_DIR"):
    setattr(numba.config, "CACHE_DIR", str(cache_folder()))  # noqa: B010 - numba's stubs do not know it
