"""What the EMI service can be told."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from trackmesh.protocol.messages.base import Positive
from trackmesh.services.emi.diagnosis import LR_THRESHOLD
from trackmesh.services.runtime import ServiceSettings


class EmiSettings(ServiceSettings):
    """Settings of the EMI service."""

    workers: Annotated[int, Field(ge=1, le=64)] = Field(2, description="requests answered at a time")
    max_samples: Annotated[int, Field(ge=1)] = Field(200_000, description="larger scans are refused")
    max_numbers: Annotated[int, Field(ge=1)] = Field(
        6_000_000, description="requests with more numbers (scans x channels x samples x components) are refused"
    )
    max_request_bytes: Annotated[int, Field(ge=1024)] = Field(64 * 2**20, description="larger requests are refused")
    request_deadline_s: Positive = Field(60.0, description="after this time the rest of a request is given up")
    lr_threshold: Positive = Field(LR_THRESHOLD, description="likelihood ratio that makes a target")
