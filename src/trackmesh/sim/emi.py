"""Simulated EMI scans: a coil carried over buried spheres and cylinders, with the truth beside the scans.

The same arguments and seed give the same bytes. Fields are those of ``services.emi.fields``: a static primary field,
targets that answer as dipoles, in-phase parts only.
"""

from __future__ import annotations

from math import pi, radians
from typing import Literal, NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.messages import EmiGeometry, EmiOptions, EmiReceiver, EmiScanBatch, EmiTransmitter
from trackmesh.services.emi.fields import primary_field, secondary_field, to_elements
from trackmesh.services.emi.polarizability import cylinder, rotation, sphere, world_tensor
from trackmesh.sim.scenario import Emi

OMEGA_RAD_S = 1000.0
CONDUCTIVITY_S_M = 5.17e7
"""Of copper."""
LOOP = EmiTransmitter(model="loop", radius_m=0.5, current_a=20.0)
Kind = Literal["sphere", "cylinder"]


class Buried(NamedTuple):
    """Targets, one a scan.

    Attributes:
        position_m: (B, 3), z up.
        tensor_m3: (B, 3, 3) polarizability in the world's axes.
        axis: (B, 3) unit vector of the body's third axis.
        kinds: what they are.
    """

    position_m: FloatArray
    tensor_m3: FloatArray
    axis: FloatArray
    kinds: tuple[str, ...]

    @property
    def elements_m3(self) -> FloatArray:
        """Elements xx, yy, zz, xy, xz, yz of the tensors, (B, 6)."""
        return to_elements(self.tensor_m3)


class SimulatedScans(NamedTuple):
    """A batch to invert, what is buried, and the noise (B,) in the field's unit."""

    batch: EmiScanBatch
    truth: Buried
    sigma: FloatArray


def grid_positions(size_m: tuple[float, float], spacing_m: float, height_m: float = 0.0) -> FloatArray:
    """Positions (W, 3) of a scan of ``size_m`` about the origin, line by line, both ends included."""
    x, y = (spacing_m * (np.arange(n := round(size / spacing_m) + 1) - (n - 1) / 2) for size in size_m)
    lines_y, along_x = np.meshgrid(y, x, indexing="ij")
    return np.column_stack([along_x.ravel(), lines_y.ravel(), np.full(along_x.size, height_m)])


def principal_polarizability(kind: Kind, radius_m: float = 0.2, length_m: float = 0.8) -> tuple[float, float]:
    """In-phase polarizability (m^3) of a copper body, across and along its axis."""
    if kind == "sphere":
        value = sphere(radius_m, OMEGA_RAD_S, CONDUCTIVITY_S_M).real
        return value, value
    across, along = cylinder(radius_m, length_m, OMEGA_RAD_S, CONDUCTIVITY_S_M)
    return across.real, along.real


def bury(
    kind: str, principal_m3: tuple[float, float, float], position_m: FloatArray, pitch_rad: float, roll_rad: float
) -> Buried:
    """One body with given principal polarizabilities and attitude."""
    axes = rotation(0.0, pitch_rad, roll_rad)
    tensor = world_tensor(principal_m3, axes).real
    return Buried(np.asarray(position_m, np.float64)[None], tensor[None], axes[None, :, 2], (kind,))


def join(parts: list[Buried]) -> Buried:
    """All of them, in order."""
    return Buried(
        np.concatenate([part.position_m for part in parts]),
        np.concatenate([part.tensor_m3 for part in parts]),
        np.concatenate([part.axis for part in parts]),
        tuple(kind for part in parts for kind in part.kinds),
    )


def random_targets(
    n: int, seed: int, *, depth_m: tuple[float, float] = (0.6, 1.2), spread_m: float = 1.0, surface_m: float = 0.0
) -> Buried:
    """Copper spheres and cylinders in turn, anywhere within ``spread_m`` of the middle, in any attitude."""
    rng = np.random.default_rng([seed, 1])
    parts = []
    for i in range(n):
        kind: Kind = "cylinder" if i % 2 else "sphere"
        across, along = principal_polarizability(kind)
        size = rng.uniform(0.3, 1.0)
        place = np.array([*rng.uniform(-spread_m, spread_m, 2), surface_m - rng.uniform(*depth_m)])
        pitch, roll = np.arcsin(rng.uniform(-1.0, 1.0)), rng.uniform(-pi / 2, pi / 2)
        parts.append(bury(kind, (size * across, size * across, size * along), place, pitch, roll))
    return join(parts)


def clean_field_nt(geometry: EmiGeometry, truth: Buried) -> FloatArray:
    """Secondary field (B, 1, W, 3) in nT without noise."""
    tx, positions = geometry.transmitter, geometry.positions_m
    moment = tx.turns * tx.current_a * pi * tx.radius_m**2
    radius = tx.radius_m if tx.model == "loop" else 0.0
    field = np.empty((len(truth.position_m), 1, len(positions), 3))
    for b, (place, tensor) in enumerate(zip(truth.position_m, truth.tensor_m3, strict=True)):
        axis = np.array(tx.axis) if geometry.axes is None else geometry.axes
        h, _ = primary_field(place - positions - tx.offset_m, axis, moment, radius)
        field[b, 0] = 1e9 * secondary_field(positions + geometry.receiver.offset_m - place, h @ tensor)
    return field if geometry.receiver.components == "xyz" else field[..., 2:]


def simulate(
    geometry: EmiGeometry,
    truth: Buried,
    snr_db: float | None,
    seed: int,
    *,
    batch_id: str = "sim",
    options: EmiOptions | None = None,
) -> SimulatedScans:
    """One scan a target, with white noise.

    Args:
        geometry: of all scans.
        truth: one target a scan.
        snr_db: mean power of the field over samples and components, by the variance of the noise; None for no noise.
        seed: of the noise.
        batch_id: name of the batch.
        options: of the inversion.

    The batch tells sigma where it is the same for all scans (one target, or many alike), else leaves it open.
    """
    field = clean_field_nt(geometry, truth)
    sigma = np.zeros(len(field))
    if snr_db is not None:
        sigma = np.sqrt((field**2).mean((1, 2, 3))) * 10 ** (-snr_db / 20)
        rng = np.random.default_rng([seed, 2])
        field = field + sigma[:, None, None, None] * rng.standard_normal(field.shape)
    common = bool(sigma[0] > 0.0 and (sigma == sigma[0]).all())
    batch = EmiScanBatch(
        batch_id=batch_id,
        geometry=geometry,
        field=field,
        field_unit="nT",
        sigma=float(sigma[0]) if common else None,
        options=options or EmiOptions(),
    )
    return SimulatedScans(batch, truth, sigma)


def survey_geometry(
    size_m: tuple[float, float] = (4.0, 4.0),
    spacing_m: float = 0.1,
    height_m: float = 0.0,
    *,
    transmitter: EmiTransmitter = LOOP,
    receiver: EmiReceiver | None = None,
) -> EmiGeometry:
    """A coil over a grid."""
    positions = grid_positions(size_m, spacing_m, height_m)
    return EmiGeometry(positions_m=positions, transmitter=transmitter, receiver=receiver or EmiReceiver())


def scenario_scans(emi: Emi, seed: int, batch_id: str = "sim") -> SimulatedScans:
    """The EMI part of a scenario: each of its targets is scanned by itself, over the same grid."""
    parts = [
        bury("body", t.polarizability_m3, np.array(t.position_m), *(radians(a) for a in t.attitude_deg))
        for t in emi.targets
    ]
    geometry = survey_geometry(emi.grid_m, emi.spacing_m, emi.height_m)
    return simulate(geometry, join(parts), emi.snr_db, seed, batch_id=batch_id)
