"""Electromagnetic induction: batches of scans asked, one result a scan answered."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from trackmesh.protocol.arrays import ArrayField, FloatArray
from trackmesh.protocol.messages.base import Finite, Id, Message, NonNegative, Positive, TopMessage

Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]

EmiStatus = Literal[
    "ok", "no_target", "low_snr", "multiple_or_mismatch", "underdetermined", "edge", "invalid", "too_large"
]


class EmiTransmitter(Message):
    """The transmitting coil; the moment is turns * current * area along ``axis``."""

    model: Literal["dipole", "loop"] = "loop"
    radius_m: Positive
    turns: Positive = 1.0
    current_a: Positive = 1.0
    axis: Vector3 = [0.0, 0.0, 1.0]
    offset_m: Vector3 = [0.0, 0.0, 0.0]


class EmiReceiver(Message):
    """The receiver: its offset from the sensor position, and the components of the field it measures."""

    offset_m: Vector3 = [0.0, 0.0, 0.0]
    components: Literal["xyz", "z"] = "xyz"


class EmiGeometry(Message):
    """Where the sensor stood at each sample (frame: z up, metres), and its coils."""

    positions_m: Annotated[FloatArray, ArrayField("<f8", ("w", 3), ge=-1e3, le=1e3)]
    transmitter: EmiTransmitter
    receiver: EmiReceiver = EmiReceiver()


class EmiOptions(Message):
    """How to invert."""

    estimator: Literal["varpro"] = "varpro"
    max_targets: Literal[1] = 1
    background: Literal["none", "const", "plane"] = "const"
    robust: bool = False
    depth_min_m: Positive = 0.05
    depth_max_m: Positive | None = None


class EmiScanBatch(TopMessage):
    """A batch of scans over one geometry: ``field`` (scans b, channels c, samples w, components k) in ``field_unit``.

    ``sigma`` is the standard deviation of the noise of one sample in the same unit, or None (estimated).
    """

    batch_id: Id
    geometry: EmiGeometry
    field: Annotated[FloatArray, ArrayField("<f8", ("b", "c", "w", "k"))]
    field_unit: Literal["T", "nT", "pT", "arbitrary"]
    sigma: Positive | None = None
    options: EmiOptions = EmiOptions()


class EmiTarget(Message):
    """One target: position, polarizability tensor (m^3, xx yy zz xy xz yz per channel), principal values and axis."""

    position_m: Vector3
    depth_m: Finite
    covariance: Annotated[FloatArray, ArrayField("<f8", ("p", "p"))]
    tensor_m3: Annotated[FloatArray, ArrayField("<f8", ("c", 6))]
    principal_m3: Vector3
    principal_sd_m3: Annotated[list[NonNegative], Field(min_length=3, max_length=3)]
    axis: Vector3 | None = None
    axis_sd_rad: NonNegative | None = None


class EmiResult(TopMessage):
    """The answer for scan ``index`` of a batch."""

    batch_id: Id
    index: Annotated[int, Field(ge=0)]
    status: EmiStatus
    reasons: list[str] = []
    targets: list[EmiTarget] = []
    chi2: Finite | None = None
    dof: int | None = None
    p_value: Finite | None = None
    likelihood_ratio: Finite | None = None
    sigma_used: Finite | None = None
    n_used: int = 0
    n_masked: int = 0
    iterations: int = 0
