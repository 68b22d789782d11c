"""How the hot loops of this room are compiled: one decorator, typed for the type checker."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt

F = TypeVar("F", bound=Callable[..., object])

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def kernel(function: F) -> F:
    """Compile on first use, keep the machine code on disk, release the GIL; division by zero gives inf or nan.

    No fast mathematics: results are the same bits on every run, whatever else is computed beside them.
    """
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
