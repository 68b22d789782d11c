"""The messages of trackmesh, one module a family; ``MESSAGES`` finds one by its schema id."""

from __future__ import annotations

from trackmesh.protocol.messages.base import ID_PATTERN, Message
from trackmesh.protocol.messages.emi import (
    EmiAngles,
    EmiGeometry,
    EmiLimit,
    EmiOptions,
    EmiPrior,
    EmiReceiver,
    EmiResult,
    EmiScanBatch,
    EmiTarget,
    EmiTransmitter,
)
from trackmesh.protocol.messages.envelope import Envelope
from trackmesh.protocol.messages.plots import Geodetic, PlotBatch, ScanPart, SensorInfo
from trackmesh.protocol.messages.status import SensorHealth, ServiceStatus
from trackmesh.protocol.messages.tags import GONE, LOCATED, LOST, UNSURE, RangeBatch, TagFrame
from trackmesh.protocol.messages.tracks import (
    COASTING,
    CONFIRMED,
    ENDED,
    TENTATIVE,
    UNKNOWN_HEIGHT_M2,
    BandFrame,
    HistoryQuery,
    RefinedFrame,
    Registration,
    SensorBias,
    TrackFrame,
    TrackQuery,
    UnitArea,
    symmetric,
)
from trackmesh.protocol.messages.truth import TruthFrame

MESSAGES: dict[str, type[Message]] = {
    m.schema_id(): m
    for m in (
        SensorInfo,
        PlotBatch,
        RangeBatch,
        TrackFrame,
        RefinedFrame,
        TagFrame,
        TrackQuery,
        HistoryQuery,
        BandFrame,
        Registration,
        EmiScanBatch,
        EmiResult,
        ServiceStatus,
        TruthFrame,
        Envelope,
    )
}
"""Every message that travels by itself, by its schema id."""

__all__ = [
    "COASTING",
    "CONFIRMED",
    "ENDED",
    "GONE",
    "ID_PATTERN",
    "LOCATED",
    "LOST",
    "MESSAGES",
    "TENTATIVE",
    "UNKNOWN_HEIGHT_M2",
    "UNSURE",
    "BandFrame",
    "EmiAngles",
    "EmiGeometry",
    "EmiLimit",
    "EmiOptions",
    "EmiPrior",
    "EmiReceiver",
    "EmiResult",
    "EmiScanBatch",
    "EmiTarget",
    "EmiTransmitter",
    "Envelope",
    "Geodetic",
    "HistoryQuery",
    "Message",
    "PlotBatch",
    "RangeBatch",
    "RefinedFrame",
    "Registration",
    "ScanPart",
    "SensorBias",
    "SensorHealth",
    "SensorInfo",
    "ServiceStatus",
    "TagFrame",
    "TrackFrame",
    "TrackQuery",
    "TruthFrame",
    "UnitArea",
    "symmetric",
]
