"""The bytes in docs/protocol.md are the bytes of the code, and mean what the page says."""

from __future__ import annotations

import re

import numpy as np
import pytest
from tests.network.processes import ROOT

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.messages import CONFIRMED, PlotBatch, ScanPart, TrackFrame
from trackmesh.protocol.messages.base import TopMessage

PAGE = (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8")
T_NS = 1_700_000_000_000_000_000

PLOTS = PlotBatch(
    sensor_id="north",
    boot_id="5f3a9c0d1e2b4a68",
    seq=7,
    t_ns=np.array([T_NS, T_NS + 500_000_000]),
    columns=["range_m", "azimuth_rad"],
    values=np.array([[30000.0, 0.5], [42000.5, 1.25]]),
    scan=ScanPart(index=3, sector=1, sectors=8),
)
COVARIANCE = [
    [900.0, 12.5, 30.0, 0.0, 0.0, 0.0],
    [800.0, 0.0, 28.0, 0.0, 0.0],
    [25.0, 0.0, 0.0, 0.0],
    [25.0, 0.0, 0.0],
    [0.0, 0.0],
    [0.0],
]
FRAME = TrackFrame(
    unit_id="main",
    boot_id="0123456789abcdef",
    seq=42,
    t_ns=T_NS + 1_000_000_000,
    track_id=np.array([189_000_000_000]),
    epoch=np.zeros(1, np.uint32),
    status=np.array([CONFIRMED], np.uint8),
    state=np.array([[14382.5, 26327.75, 120.0, -35.5, 0.0, 0.0]]),
    covariance=np.concatenate(COVARIANCE).astype(np.float32)[None],
    model_probability=np.array([[0.75, 0.25]]),
    models=["cv-1", "cv-50"],
    sensors=["north"],
    members=np.array([[5]]),
    updated_t_ns=np.array([T_NS + 500_000_000]),
    first_t_ns=np.array([T_NS - 20_000_000_000]),
)


def golden(name: str) -> bytes:
    found = re.search(rf"^```hex {name}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None, f"the page has no bytes of {name}"
    return bytes.fromhex(found.group(1))


@pytest.mark.parametrize("message", [PLOTS, FRAME], ids=lambda message: type(message).__name__)
def test_the_bytes_of_the_page_are_those_of_the_code(message: TopMessage) -> None:
    data = golden(type(message).__name__)
    assert encode(message).hex() == data.hex()
    assert decode(data, type(message)) == message


def test_the_page_words_what_the_bytes_hold() -> None:
    text = " ".join(PAGE.split())
    for words in ("boot id `5f3a9c0d1e2b4a68`, seq 7, sector 1 of 8 of turn 3", "(42000.5, 1.25) at 1700000000.5 s",
                  "track 189000000000 at (14382.5, 26327.75) m moving at (120, -35.5) m/s"):  # fmt: skip
        assert words in text
