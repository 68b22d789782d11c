"""What was carried where: the coils of a sensor, and their geometry sample by sample as the kernels take it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from trackmesh.services.emi.kernels import FloatArray, IntArray

Background = Literal["none", "const", "plane"]
N_BACKGROUND: dict[Background, int] = {"none": 0, "const": 1, "plane": 3}
XYZ = np.eye(3)
Z_ONLY = XYZ[2:]
N_NEAR = 4


class Receiver(NamedTuple):
    """One receiver.

    Attributes:
        directions: (k, 3) of the components it measures.
        offset_m: (3,) from the sensor position.
        radius_m: of a receiving coil, which measures the mean over its area; 0 for a point.
    """

    directions: FloatArray = XYZ
    offset_m: FloatArray = np.zeros(3)
    radius_m: float = 0.0


class Coils(NamedTuple):
    """The sensor.

    Attributes:
        positions_m: (W, 3), z up.
        radius_m: of the transmitter.
        moment_am2: turns times current times area.
        is_loop: whether the transmitter is a loop of that radius, or taken as a point dipole.
        tx_axis: (3,) on the sensor, or (W, 3) in the world.
        tx_offset_m: (3,) from the sensor position to the transmitter's centre.
        receivers: in the order of the components of the data.
        rotation: (W, 3, 3) from the sensor's axes to the world's; None where they are the same.
    """

    positions_m: FloatArray
    radius_m: float
    moment_am2: float
    is_loop: bool = True
    tx_axis: FloatArray = XYZ[2]
    tx_offset_m: FloatArray = np.zeros(3)
    receivers: tuple[Receiver, ...] = (Receiver(),)
    rotation: FloatArray | None = None


class Sensor(NamedTuple):
    """Where the coils were at each of W samples. Component k belongs to receiver j if first[j] <= k < first[j + 1].

    Attributes:
        tx_m, tx_axis: (W, 3) centre and unit axis of the transmitter.
        rx_m: (W, R, 3) places of the receivers.
        direction: (W, K, 3) unit vectors of the components.
        first: (R + 1,) first component of each receiver.
        rx_radius_m: (R,) of each receiver; 0 for a point.
        place_m: (W, 3) where a sample counts as taken.
        point_m: (W R, 3) midway between transmitter and receiver, where the reading of a receiver counts as taken.
        near: (W R, 4) the nearest other points.
        basis: (W, p) background columns of each component, p = 0, 1 or 3.
        radius_m: of the transmitter loop; 0 for a point dipole.
        moment_am2: turns times current times area.
    """

    tx_m: FloatArray
    tx_axis: FloatArray
    rx_m: FloatArray
    direction: FloatArray
    first: IntArray
    rx_radius_m: FloatArray
    place_m: FloatArray
    point_m: FloatArray
    near: IntArray
    basis: FloatArray
    radius_m: float
    moment_am2: float


def sensor_arrays(coils: Coils, background: Background) -> Sensor:
    """The geometry as the kernels take it: one row a sample, unit vectors, background columns of order one."""
    # C order throughout: each other memory layout would have the kernels compiled again.
    positions = np.array(coils.positions_m, np.float64, order="C")
    tx = positions + _turned(coils.tx_offset_m, coils.rotation)
    rx = np.stack([positions + _turned(one.offset_m, coils.rotation) for one in coils.receivers], 1)
    axes = coils.tx_axis if np.ndim(coils.tx_axis) == 2 else _turned(coils.tx_axis, coils.rotation)
    directions = np.concatenate([one.directions for one in coils.receivers])
    turned = np.stack([np.broadcast_to(_turned(e, coils.rotation), positions.shape) for e in directions], 1)
    point = 0.5 * (tx[:, None] + rx)
    counts = [0, *(len(one.directions) for one in coils.receivers)]
    return Sensor(
        np.ascontiguousarray(tx),
        _unit(np.broadcast_to(axes, positions.shape)),
        np.ascontiguousarray(rx),
        _unit(turned),
        np.cumsum(counts).astype(np.int64),
        np.array([one.radius_m for one in coils.receivers], np.float64),
        np.ascontiguousarray(point.mean(1)),
        np.ascontiguousarray(point.reshape(-1, 3)),
        nearest_points(point.reshape(-1, 3)),
        np.ascontiguousarray(background_columns(positions)[:, : N_BACKGROUND[background]]),
        float(coils.radius_m) if coils.is_loop else 0.0,
        float(coils.moment_am2),
    )


def background_columns(positions_m: FloatArray) -> FloatArray:
    """Columns (W, 3) of a constant and of a plane over the scan."""
    flat = positions_m[:, :2] - positions_m[:, :2].mean(0)
    return np.column_stack([np.ones(len(flat)), flat / max(float(np.abs(flat).max()), 1e-3)])


def nearest_points(point_m: FloatArray) -> IntArray:
    """For each of n points (n, 3) the four nearest others, (n, 4); the point itself where there are not so many."""
    n = len(point_m)
    if n == 1 or not np.isfinite(point_m).all():
        return np.repeat(np.arange(n, dtype=np.int64)[:, None], N_NEAR, axis=1)
    k = min(N_NEAR + 1, n)
    _, found = KDTree(point_m).query(point_m, k=k)
    own = np.arange(n)[:, None]
    # Of places visited more than once the point itself may not come first, or not at all.
    found = np.take_along_axis(found, np.argsort(found == own, axis=1, kind="stable"), 1)[:, : k - 1]
    return np.ascontiguousarray(np.concatenate([found, np.repeat(own, N_NEAR + 1 - k, axis=1)], axis=1), np.int64)


def rotations(wxyz: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3), sensor to world, of quaternions (n, 4); they need not be of unit length."""
    q = wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _turned(vector: FloatArray, rotation: FloatArray | None) -> FloatArray:
    return np.asarray(vector, np.float64) if rotation is None else rotation @ np.asarray(vector, np.float64)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.ascontiguousarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
