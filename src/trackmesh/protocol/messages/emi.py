"""Electromagnetic induction: batches of scans asked, one result a scan answered."""

from __future__ import annotations

import hashlib
import math
from typing import Annotated, Any, Literal, Self

import msgpack
import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError, core_schema

from trackmesh.protocol.arrays import AnyArray, ArrayField, Axis, FloatArray
from trackmesh.protocol.messages.base import Count, Finite, Id, Message, NonNegative, Positive, Probability, TopMessage

Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)]
Label = Annotated[str, Field(max_length=64)]
COMPONENTS = {"xyz": 3, "z": 1}
SHORTEST = 1e-6
"""Length of a vector below which it is no direction."""


class GappyField(ArrayField):
    """An array whose elements may be missing: NaN or infinite in msgpack, null in JSON; NaN in memory.

    A sensor loses samples, and one broken scan must not have its whole batch refused.
    """

    also = (type(None),)

    def validate(self, value: Any) -> AnyArray:
        """As any array, with NaN for what is missing."""
        array = super().validate(value)
        if np.isinf(array).any():
            array = np.where(np.isfinite(array), array, np.nan)
            array.flags.writeable = False
        return array

    def _check_values(self, array: AnyArray) -> None:
        pass

    def serialize(self, value: AnyArray, info: core_schema.SerializationInfo) -> Any:
        """Wire map for msgpack; for JSON a nested list with null for what is not finite."""
        if info.mode == "json":
            return np.where(np.isfinite(value), value, np.array(None)).tolist()
        return super().serialize(value, info)


EmiStatus = Literal[
    "ok", "no_target", "low_snr", "multiple_or_mismatch", "underdetermined", "edge", "invalid", "too_large"
]


class EmiTransmitter(Message):
    """The transmitting coil; the moment is turns * current * area along ``axis``."""

    model: Literal["dipole", "loop"] = "loop"
    radius_m: Length
    turns: Annotated[Positive, Field(le=1e6)] = 1.0
    current_a: Annotated[Positive, Field(le=1e6)] = 1.0
    axis: Vector3 = [0.0, 0.0, 1.0]
    offset_m: Vector3 = [0.0, 0.0, 0.0]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not 1e-6 <= math.hypot(*self.axis) <= 1e6:
            raise PydanticCustomError("invalid", "axis must be a direction, not the zero vector")
        return self


class EmiReceiver(Message):
    """A receiver: its offset from the sensor position, and the components of the field it measures.

    These are ``xyz``, ``z``, or directions of any length. ``radius_m`` is that of a receiving coil, which measures the
    mean over its area; 0 for a point.
    """

    offset_m: Vector3 = [0.0, 0.0, 0.0]
    components: Literal["xyz", "z"] | Annotated[list[Vector3], Field(min_length=1, max_length=16)] = "xyz"
    radius_m: Annotated[float, Field(ge=0, le=1e3, allow_inf_nan=False)] = 0.0

    @model_validator(mode="after")
    def _have_directions(self) -> Self:
        if isinstance(self.components, list) and not all(SHORTEST <= math.hypot(*v) <= 1e6 for v in self.components):
            raise PydanticCustomError("invalid", "components must be directions, not zero vectors")
        return self

    @property
    def n_components(self) -> int:
        """How many numbers it gives at each sample."""
        return COMPONENTS[self.components] if isinstance(self.components, str) else len(self.components)


class EmiGeometry(Message):
    """Where the sensor stood at each sample (frame: z up, metres), and its coils.

    ``receivers`` replaces ``receiver`` where there are several; their components follow each other. Offsets, axes and
    directions are those on the sensor; ``attitude`` turns them into the frame, sample by sample, as a quaternion
    w, x, y, z. ``axes`` is the transmitter's axis in the frame at each sample and replaces ``transmitter.axis``.
    """

    positions_m: Annotated[FloatArray, ArrayField("<f8", ("w", 3), ge=-1e3, le=1e3)]
    transmitter: EmiTransmitter
    receiver: EmiReceiver = EmiReceiver()
    axes: Annotated[FloatArray, ArrayField("<f8", ("w", 3), ge=-1e6, le=1e6)] | None = None
    receivers: Annotated[list[EmiReceiver], Field(min_length=1, max_length=64)] | None = None
    attitude: Annotated[FloatArray, ArrayField("<f8", ("w", 4), ge=-1e6, le=1e6)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if len(self.positions_m) == 0:
            raise PydanticCustomError("wrong_length", "positions_m must hold at least one position")
        for name, rows in (("axes", self.axes), ("attitude", self.attitude)):
            if rows is not None and not (np.linalg.norm(rows, axis=1) >= SHORTEST).all():
                raise PydanticCustomError("invalid", "{name} must be no zero vectors", {"name": name})
        return self

    @property
    def all_receivers(self) -> list[EmiReceiver]:
        """The receivers in the order of their components."""
        return self.receivers or [self.receiver]

    @property
    def n_components(self) -> int:
        """Numbers that a channel has at each sample."""
        return sum(receiver.n_components for receiver in self.all_receivers)

    def content_id(self) -> str:
        """A name by content: equal geometries have equal ones (SHA-256 of the message, shortened)."""
        return hashlib.sha256(msgpack.packb(self.model_dump())).hexdigest()[:32]


class EmiPrior(Message):
    """What is known of the first target's position: mean and standard deviation of x, y, z."""

    position_m: Vector3
    sd_m: Annotated[list[Length], Field(min_length=3, max_length=3)]


class EmiOptions(Message):
    """How to invert; depths are from the median height of the sensor (None: twice the scan's width at most).

    ``area_m`` holds two corners x, y, x, y within which targets lie (None: half a scan's width around it). Samples are
    averaged in cells of ``block_m`` (None: only those of very large scans).
    """

    estimator: Literal["varpro", "ekf9", "kf-ekf-thesis", "initial"] = "varpro"
    max_targets: Annotated[int, Field(ge=1, le=3)] = 1
    background: Literal["none", "const", "plane"] = "const"
    robust: bool = True
    depth_min_m: Length = 0.05
    depth_max_m: Length | None = None
    side: Literal["below", "above", "unknown"] = "below"
    area_m: Annotated[list[Finite], Field(min_length=4, max_length=4)] | None = None
    prior: EmiPrior | None = None
    block_m: Length | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.depth_max_m is not None and self.depth_max_m <= self.depth_min_m:
            raise PydanticCustomError("out_of_bounds", "depth_max_m must be above depth_min_m")
        if self.area_m is not None and (self.area_m[0] == self.area_m[2] or self.area_m[1] == self.area_m[3]):
            raise PydanticCustomError("out_of_bounds", "area_m must have an extent")
        if self.max_targets > 1 and self.estimator != "varpro":
            raise PydanticCustomError("invalid", "max_targets above 1 needs the estimator varpro")
        return self


class EmiScanBatch(TopMessage):
    """A batch of scans over one geometry: ``field`` (scans b, channels c, samples w, components k) in ``field_unit``.

    Channels (in-phase and quadrature, frequencies, gates) share the target's position, each has its own tensor;
    ``channels`` may name them. ``sigma`` is the standard deviation of the noise of one number in the same unit: one for
    all, one a component, or None (estimated). ``sigma_factor`` multiplies it sample by sample, ``channel_factor``
    channel by channel. A geometry that a service has seen may be named by ``geometry_id`` instead of sent again.
    """

    batch_id: Id
    geometry: EmiGeometry | None = None
    field: Annotated[FloatArray, GappyField("<f8", ("b", "c", "w", "k"))]
    field_unit: Literal["T", "nT", "pT", "arbitrary"]
    sigma: Positive | Annotated[list[Positive], Field(max_length=1024)] | None = None
    sigma_factor: Annotated[FloatArray, ArrayField("<f8", ("w",), ge=1e-9, le=1e9)] | None = None
    options: EmiOptions = EmiOptions()
    geometry_id: Id | None = None
    channel_factor: Annotated[FloatArray, ArrayField("<f8", ("c",), ge=1e-9, le=1e9)] | None = None
    channels: Annotated[list[Label], Field(max_length=1024), Axis("c")] | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        n_scans, n_channels = self.field.shape[:2]
        if self.geometry is None and self.geometry_id is None:
            raise PydanticCustomError("missing_field", "geometry or geometry_id is needed")
        if self.geometry is not None and (problem := self.misfit(self.geometry)):
            raise PydanticCustomError("wrong_length", "{problem}", {"problem": problem})
        if n_scans == 0 or n_channels == 0:
            raise PydanticCustomError("wrong_length", "field must hold at least one scan and one channel")
        for name in ("sigma_factor", "channel_factor"):
            if getattr(self, name) is not None and self.sigma is None:
                raise PydanticCustomError("missing_field", "{name} needs sigma", {"name": name})
        return self

    def misfit(self, geometry: EmiGeometry) -> str | None:
        """What of this batch does not fit a geometry, or None."""
        _, _, n_samples, n_components = self.field.shape
        lengths = [
            ("field", "samples", n_samples, len(geometry.positions_m)),
            ("field", "components", n_components, geometry.n_components),
        ]
        if isinstance(self.sigma, list):
            lengths.append(("sigma", "components", len(self.sigma), geometry.n_components))
        for name, what, got, needed in lengths:
            if got != needed:
                return f"{name} has {got} {what}, where the geometry has {needed}"
        return None


class EmiAngles(Message):
    """Pitch theta and roll phi of a target's axis, and the yaw psi about it; None where ``undefined`` says why.

    The axis is (-sin theta, cos theta sin phi, cos theta cos phi). ``covariance`` is that of the angles that are there,
    in this order. Reasons are ``isotropic``, ``axisymmetric`` (no yaw), ``gimbal`` (the axis lies along x: roll and yaw
    are one) and ``uncertain``.
    """

    theta_rad: Finite | None = None
    phi_rad: Finite | None = None
    psi_rad: Finite | None = None
    covariance: Annotated[FloatArray, ArrayField("<f8", ("a", "a"))]
    undefined: dict[str, str] = {}


class EmiTarget(Message):
    """One target: m = M H with M the polarizability tensor (m^3; xx yy zz xy xz yz a channel).

    ``covariance`` is that of x, y, z and then of each channel's six elements, already raised by ``inflation`` for what
    the model does not explain. Principal values and axis are those of the strongest ``channel``: of an axisymmetric
    body transverse, transverse, axial; of others descending by magnitude. ``channel_principal_m3`` is every
    channel's response along the same axes. The axis points up; an isotropic body has none. A target is ``ambiguous``
    if only one of it and another target of the same scan, its image in a mirror, is there. With the field in an
    arbitrary unit the tensors are relative.
    """

    position_m: Vector3
    depth_m: Finite
    covariance: Annotated[FloatArray, ArrayField("<f8", ("p", "p"))]
    tensor_m3: Annotated[FloatArray, ArrayField("<f8", ("c", 6))]
    principal_m3: Vector3
    principal_sd_m3: Annotated[list[NonNegative], Field(min_length=3, max_length=3)]
    shape: Literal["isotropic", "axisymmetric", "general"] | None = None
    axis: Vector3 | None = None
    axis_sd_rad: NonNegative | None = None
    p_isotropic: Probability | None = None
    p_axisymmetric: Probability | None = None
    axis_covariance: Annotated[FloatArray, ArrayField("<f8", (3, 3))] | None = None
    angles: EmiAngles | None = None
    channel: Count = 0
    channel_principal_m3: Annotated[FloatArray, ArrayField("<f8", ("c", 3))] | None = None
    inflation: Positive = 1.0
    ambiguous: Literal["mirror"] | None = None


class EmiLimit(Message):
    """What a scan without a target excludes: a sphere below its middle as strong as this is seen in 95 of 100 scans."""

    depth_m: Annotated[FloatArray, ArrayField("<f8", ("n",))]
    polarizability_m3: Annotated[FloatArray, ArrayField("<f8", ("n",))]


class EmiResult(TopMessage):
    """The answer for scan ``index`` of a batch; ``reasons`` are words that qualify the status.

    ``chi2`` is of all samples but outliers, ``local_chi2`` its mean where the signal is (1 for a good fit),
    ``likelihood_ratio`` that of the targets against none, ``bic`` the information criterion of 0, 1, ... targets as far
    as tried, ``sigma_used`` in the unit of the field, ``n_used`` and ``n_masked`` count samples, ``n_outliers`` numbers
    that were weighed down. ``geometry_id`` names the geometry for further batches to ``unit_id``.
    """

    batch_id: Id
    index: Count
    status: EmiStatus
    reasons: Annotated[list[str], Field(max_length=64)] = []
    targets: Annotated[list[EmiTarget], Field(max_length=64)] = []
    chi2: Finite | None = None
    dof: Count | None = None
    p_value: Probability | None = None
    likelihood_ratio: Finite | None = None
    sigma_used: Finite | None = None
    n_used: Count = 0
    n_masked: Count = 0
    n_outliers: Count = 0
    iterations: Count = 0
    local_chi2: Finite | None = None
    bic: Annotated[list[Finite], Field(max_length=64)] = []
    limit: EmiLimit | None = None
    unit_id: Id | None = None
    geometry_id: Id | None = None
