"""What the numerics of this room share: the compiling decorator, and the array types.

Kernels are compiled without fast mathematics, so that a scan's result is the same bits whatever else is computed, and
release the interpreter lock, so that requests are answered side by side.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from trackmesh.services.estimation.jit import inlined
from trackmesh.services.estimation.jit import parallel_kernel as kernel

__all__ = ["BoolArray", "FloatArray", "IntArray", "inlined", "kernel"]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
