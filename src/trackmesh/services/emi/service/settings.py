"""What the EMI service can be told."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from trackmesh.protocol.messages.base import Positive
from trackmesh.services.emi.diagnosis.detection import LR_THRESHOLD
from trackmesh.services.runtime import ServiceSettings


class EmiSettings(ServiceSettings):
    """Settings of the EMI service."""

    processes: Annotated[int, Field(ge=0, le=256)] | None = Field(
        None, description="processes that compute; 0: the service itself does; default: one a core"
    )
    workers: Annotated[int, Field(ge=1, le=64)] = Field(4, description="requests answered at a time")
    waiting: Annotated[int, Field(ge=0, le=64)] = Field(8, description="requests that may wait, more are told busy")
    max_samples: Annotated[int, Field(ge=1)] = Field(200_000, description="larger scans are answered too_large")
    max_numbers: Annotated[int, Field(ge=1)] = Field(
        6_000_000, description="requests with more numbers (scans x channels x samples x components) are refused"
    )
    max_request_bytes: Annotated[int, Field(ge=1024)] = Field(64 * 2**20, description="larger requests are refused")
    max_geometries: Annotated[int, Field(ge=1)] = Field(256, description="geometries remembered, to be named again")
    request_deadline_s: Positive = Field(60.0, description="scans not done by then are answered too_large")
    lr_threshold: Positive = Field(LR_THRESHOLD, description="likelihood ratio that makes a target")
