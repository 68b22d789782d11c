from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW

from trackmesh.services.estimation.lookup import index_of

whole = st.integers(-(2**62), 2**62) | st.integers(-5, 5)


@LAW
@given(st.lists(whole, unique=True, max_size=20), st.lists(whole, max_size=20))
def test_finds_what_a_dictionary_finds(values: list[int], wanted: list[int]) -> None:
    place = {value: k for k, value in enumerate(values)}
    # Some that are there, too: two random lists seldom meet.
    wanted = wanted + values[::2]
    got = index_of(np.array(values, np.int64), np.array(wanted, np.int64))
    assert got.tolist() == [place.get(w, -1) for w in wanted]
