"""The numbers that order a publisher's samples."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from trackmesh.protocol.zenoh_history import _after

NUMBERS = st.integers(0, 2**32 - 1)


@given(NUMBERS, st.integers(-(2**31) + 1, 2**31 - 1))
def test_numbers_go_round(number: int, step: int) -> None:
    assert _after((number + step) % 2**32, number) == step
