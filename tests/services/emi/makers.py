"""What the tests of the EMI room share: coils, bodies, scans with noise."""

from __future__ import annotations

import numpy as np

from trackmesh.protocol.messages import EmiGeometry, EmiTransmitter
from trackmesh.services.emi.diagnosis.results import ScanResult
from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.fields import primary_field, secondary_field
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, world_tensor
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import Coils
from trackmesh.services.emi.service.convert import to_coils
from trackmesh.services.emi.varpro import Bounds, Ground, Prior
from trackmesh.sim.emi import (
    Buried,
    bury,
    channel_field_nt,
    grid_positions,
    principal_polarizability,
    survey_geometry,
)

MOMENT = 20.0 * np.pi * 0.25
TENSOR = world_tensor([-0.098, -0.098, -0.044], rotation(0.0, np.pi / 4, np.pi / 4)).real
ATTITUDES = [(0, 0), (30, 0), (45, 45), (90, 0), (0, 90), (75, -30)]
DIPOLE = EmiTransmitter(model="dipole", radius_m=0.5, current_a=20.0)
FINE = survey_geometry((4.0, 4.0), 0.1)
COARSE = survey_geometry((4.0, 4.0), 0.2)
NO_PRIOR = Prior(np.zeros(3), np.zeros((3, 3)))


def coils(is_loop: bool = True, n: int = 21, spacing_m: float = 0.2) -> Coils:
    side = (n - 1) * spacing_m
    return Coils(grid_positions((side, side), spacing_m), 0.5, MOMENT, is_loop)


def field_t(c: Coils, r: FloatArray, tensor: FloatArray) -> FloatArray:
    """(1, W, K) in T of one target, for a sensor with one receiver at a point and no attitude."""
    place, (receiver,) = np.asarray(r, np.float64), c.receivers
    h, _ = primary_field(
        place - c.positions_m - c.tx_offset_m, c.tx_axis, c.moment_am2, c.radius_m if c.is_loop else 0.0
    )
    b = secondary_field(c.positions_m + receiver.offset_m - place, h @ tensor)
    return np.asarray((b @ receiver.directions.T)[None])


def ground(half_m: float = 4.0, *, sigma_known: bool = False, prior: Prior = NO_PRIOR) -> Ground:
    return Ground(
        Bounds(np.array([-half_m, -half_m, -11.0]), np.array([half_m, half_m, -0.05]), 0.0), prior, sigma_known
    )


def rod(place: tuple[float, float, float] = (0.1, -0.2, -1.0), pitch: float = 45.0, roll: float = 45.0) -> Buried:
    across, along = principal_polarizability("cylinder")
    return bury("cylinder", (across, across, along), np.array(place), np.deg2rad(pitch), np.deg2rad(roll))


def ball(place: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> Buried:
    value, _ = principal_polarizability("sphere")
    return bury("sphere", (value, value, value), np.array(place), 0.0, 0.0)


def together(geometry: EmiGeometry, *bodies: Buried) -> FloatArray:
    """Field (1, 1, W, K) in nT of bodies in one scan, without noise."""
    return np.asarray(np.sum([channel_field_nt(geometry, b.position_m[0], b.tensor_m3)[None] for b in bodies], axis=0))


def noise(field_nt: FloatArray, snr_db: float) -> float:
    """Sigma that gives a field its signal-to-noise ratio."""
    return float(np.sqrt((field_nt**2).mean())) * 10 ** (-snr_db / 20)


def noisy(field_nt: FloatArray, snr_db: float, n: int = 1, seed: int = 1) -> tuple[FloatArray, float]:
    """``n`` draws of one clean scan (1, C, W, K), and their sigma."""
    sigma = noise(field_nt, snr_db)
    return field_nt + sigma * np.random.default_rng(seed).normal(size=(n, *field_nt.shape[1:])), sigma


def solve(
    geometry: EmiGeometry | Coils,
    field_nt: FloatArray,
    sigma_nt: FloatArray | float | None,
    options: Options | None = None,
) -> list[ScanResult]:
    sigma_t = None if sigma_nt is None else 1e-9 * np.asarray(sigma_nt)
    sensor = geometry if isinstance(geometry, Coils) else to_coils(geometry)
    return list(invert(sensor, 1e-9 * field_nt, sigma_t, options or Options()))


def error_m(result: ScanResult, truth: Buried, target: int = 0) -> float:
    return float(np.linalg.norm(result.targets[target].position_m - truth.position_m[0]))


def same(a: ScanResult, b: ScanResult) -> bool:
    """Bit for bit, but for the index."""
    return equal(a._replace(scan_index=0), b._replace(scan_index=0))


def equal(a: object, b: object) -> bool:
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(np.asarray(a), np.asarray(b))
    return a == b
