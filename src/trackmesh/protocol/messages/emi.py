"""Electromagnetic induction: batches of scans asked, one result a scan answered."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError, core_schema

from trackmesh.protocol.arrays import AnyArray, ArrayField, FloatArray
from trackmesh.protocol.messages.base import Count, Finite, Id, Message, NonNegative, Positive, Probability, TopMessage

Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)]
COMPONENTS = {"xyz": 3, "z": 1}


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
    """The receiver: its offset from the sensor position, and the components of the field it measures."""

    offset_m: Vector3 = [0.0, 0.0, 0.0]
    components: Literal["xyz", "z"] = "xyz"


class EmiGeometry(Message):
    """Where the sensor stood at each sample (frame: z up, metres), and its coils.

    ``axes`` is the transmitter's axis at each sample, where the sensor tilts; it replaces ``transmitter.axis``.
    """

    positions_m: Annotated[FloatArray, ArrayField("<f8", ("w", 3), ge=-1e3, le=1e3)]
    transmitter: EmiTransmitter
    receiver: EmiReceiver = EmiReceiver()
    axes: Annotated[FloatArray, ArrayField("<f8", ("w", 3), ge=-1e6, le=1e6)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if len(self.positions_m) == 0:
            raise PydanticCustomError("wrong_length", "positions_m must hold at least one position")
        if self.axes is not None and not (np.linalg.norm(self.axes, axis=1) >= 1e-6).all():
            raise PydanticCustomError("invalid", "axes must be directions, not zero vectors")
        return self


class EmiOptions(Message):
    """How to invert; depths are below the median height of the sensor (None: twice the scan's width at most)."""

    estimator: Literal["varpro"] = "varpro"
    max_targets: Literal[1] = 1
    background: Literal["none", "const", "plane"] = "const"
    robust: bool = True
    depth_min_m: Length = 0.05
    depth_max_m: Length | None = None

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if self.depth_max_m is not None and self.depth_max_m <= self.depth_min_m:
            raise PydanticCustomError("out_of_bounds", "depth_max_m must be above depth_min_m")
        return self


class EmiScanBatch(TopMessage):
    """A batch of scans over one geometry: ``field`` (scans b, channels c, samples w, components k) in ``field_unit``.

    Channels (in-phase and quadrature, frequencies, gates) share the target's position, each has its own tensor.
    ``sigma`` is the standard deviation of the noise of one number in the same unit: one for all, one a component, or
    None (estimated). ``sigma_factor`` multiplies it sample by sample.
    """

    batch_id: Id
    geometry: EmiGeometry
    field: Annotated[FloatArray, GappyField("<f8", ("b", "c", "w", "k"))]
    field_unit: Literal["T", "nT", "pT", "arbitrary"]
    sigma: Positive | Annotated[list[Positive], Field(max_length=3)] | None = None
    sigma_factor: Annotated[FloatArray, ArrayField("<f8", ("w",), ge=1e-9, le=1e9)] | None = None
    options: EmiOptions = EmiOptions()

    @model_validator(mode="after")
    def _fits_geometry(self) -> Self:
        n_scans, n_channels, n_samples, n_components = self.field.shape
        want = COMPONENTS[self.geometry.receiver.components]
        lengths = [
            ("field", "samples", n_samples, len(self.geometry.positions_m)),
            ("field", "components", n_components, want),
        ]
        if isinstance(self.sigma, list):
            lengths.append(("sigma", "components", len(self.sigma), want))
        for name, what, got, needed in lengths:
            if got != needed:
                raise PydanticCustomError(
                    "wrong_length",
                    "{name} has {got} {what}, where the geometry has {needed}",
                    {"name": name, "what": what, "got": got, "needed": needed},
                )
        if n_scans == 0 or n_channels == 0:
            raise PydanticCustomError("wrong_length", "field must hold at least one scan and one channel")
        if self.sigma_factor is not None and self.sigma is None:
            raise PydanticCustomError("missing_field", "sigma_factor needs sigma")
        return self


class EmiTarget(Message):
    """One target: m = M H with M the polarizability tensor (m^3; xx yy zz xy xz yz a channel).

    ``covariance`` is that of x, y, z and then of each channel's six elements. Principal values and axis are those of
    the strongest channel: of an axisymmetric body transverse, transverse, axial; of others descending by magnitude.
    The axis points up; an isotropic body has none. With the field in an arbitrary unit the tensors are relative.
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


class EmiResult(TopMessage):
    """The answer for scan ``index`` of a batch; ``reasons`` are words that qualify the status.

    ``chi2`` is of all samples but outliers, ``likelihood_ratio`` that of a target against none, ``sigma_used`` in the
    unit of the field, ``n_used`` and ``n_masked`` count samples, ``n_outliers`` numbers that were weighed down.
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
