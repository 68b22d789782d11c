"""Simulated EMI scans: coils carried over buried spheres and cylinders, with the truth beside the scans.

The same arguments and seed give the same bytes. Fields are those of ``services.emi.fields``: a static primary field,
targets that answer as dipoles. Frequencies and gates are channels: see ``real_channels``.
"""

from __future__ import annotations

from math import pi, radians
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.messages import EmiGeometry, EmiOptions, EmiReceiver, EmiScanBatch, EmiTransmitter
from trackmesh.services.emi.fields import MU0, primary_field, secondary_field, to_elements
from trackmesh.services.emi.polarizability import cylinder, rotation, sphere, world_tensor
from trackmesh.services.emi.sensor import rotations
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
    """Secondary field (B, 1, W, K) in nT without noise, in-phase part, one target a scan."""
    scans = zip(truth.position_m, truth.tensor_m3, strict=True)
    return np.stack([channel_field_nt(geometry, place, tensor[None]) for place, tensor in scans])


def channel_field_nt(geometry: EmiGeometry, position_m: FloatArray, tensors_m3: FloatArray) -> FloatArray:
    """Secondary field (C, W, K) in nT of one target at (3,) with a tensor (C, 3, 3) for each channel."""
    tx, positions = geometry.transmitter, geometry.positions_m
    turn = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    if geometry.attitude is not None:
        turn = rotations(geometry.attitude)
    moment = tx.turns * tx.current_a * pi * tx.radius_m**2
    axis = turn @ np.array(tx.axis) if geometry.axes is None else geometry.axes
    to_target = position_m - positions - turn @ np.array(tx.offset_m)
    h, _ = primary_field(to_target, axis, moment, tx.radius_m if tx.model == "loop" else 0.0)
    dipoles = np.einsum("cij,wj->cwi", tensors_m3, h)
    return np.concatenate(
        [_received_nt(one, positions, turn, position_m, dipoles) for one in geometry.all_receivers], 2
    )


def _received_nt(
    receiver: EmiReceiver, positions_m: FloatArray, turn: FloatArray, position_m: FloatArray, dipoles: FloatArray
) -> FloatArray:
    """Field (C, W, k) that one receiver measures of dipoles (C, W, 3) at a place."""
    directions = np.eye(3) if receiver.components == "xyz" else np.eye(3)[2:]
    if not isinstance(receiver.components, str):
        directions = np.array(receiver.components)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    axes = np.einsum("wij,kj->wki", turn, unit)
    offset = positions_m + turn @ np.array(receiver.offset_m) - position_m
    if receiver.radius_m == 0.0:
        fields = np.stack([secondary_field(offset, m) for m in dipoles])
        return np.asarray(1e9 * np.einsum("cwi,wki->cwk", fields, axes))
    # Reciprocity: the mean field along a coil's axis is what the coil, driven with unit moment, does at the dipole.
    driven = np.stack([primary_field(-offset, axes[:, k], 1.0, receiver.radius_m)[0] for k in range(len(unit))], 1)
    return np.asarray(1e9 * MU0 * np.einsum("wki,cwi->cwk", driven, dipoles))


def real_channels(tensors_m3: npt.NDArray[np.complex128]) -> FloatArray:
    """Complex tensors (F, 3, 3), one a frequency, as channels (2 F, 3, 3): in-phase and quadrature in turn."""
    return np.stack([tensors_m3.real, tensors_m3.imag], 1).reshape(-1, 3, 3)


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
