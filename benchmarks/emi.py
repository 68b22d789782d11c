"""The EMI inversion: scans a second on one core, without codec and network.

python -m benchmarks.emi
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from trackmesh.protocol.messages import EmiTransmitter
from trackmesh.services.emi.convert import to_request
from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.settings import EmiSettings
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

REPEATS = 5
CASES = (
    ("41x41 dipole B=16", 0.1, "dipole", 16),
    ("41x41 loop B=16", 0.1, "loop", 16),
    ("11x11 dipole B=64", 0.4, "dipole", 64),
    ("11x11 loop B=64", 0.4, "loop", 64),
)


def rows() -> Iterator[dict[str, object]]:
    """Rows for ``benchmarks/latest.json``."""
    for name, spacing_m, model, count in CASES:
        speed = scans_per_s(spacing_m, model, count)
        print(f"emi {name}: {np.median(speed):.0f} scans/s (min {speed.min():.0f}, max {speed.max():.0f})")
        yield {
            "bench": "emi", "case": name, "value": float(np.median(speed)), "unit": "scans/s",
            "peer": None, "peer_value": None, "ratio": None,
        }  # fmt: skip


def scans_per_s(spacing_m: float, model: str, count: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Speeds of repeated runs over a batch of spheres and rods at 20 dB."""
    transmitter = EmiTransmitter.model_validate({"model": model, "radius_m": 0.5, "turns": 1.0, "current_a": 20.0})
    geometry = survey_geometry((4.0, 4.0), spacing_m, transmitter=transmitter)
    batch = simulate(geometry, random_targets(count, seed=1), 20.0, seed=1).batch
    request = to_request(batch, EmiSettings().lr_threshold)
    list(invert(*request))
    speed = np.empty(REPEATS)
    for k in range(REPEATS):
        started = time.process_time()
        list(invert(*request))
        speed[k] = count / (time.process_time() - started)
    return speed


if __name__ == "__main__":
    for _ in rows():
        pass
