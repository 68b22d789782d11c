"""Samples of a publisher, live and from its cache, become one sequence; what is missing is asked for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from trackmesh.protocol.zenoh_history import _after, _Merge

NUMBERS = st.integers(0, 2**32 - 1)


@given(NUMBERS, st.integers(-(2**31) + 1, 2**31 - 1))
def test_numbers_go_round(number: int, step: int) -> None:
    assert _after((number + step) % 2**32, number) == step


class Source:
    """Of samples: as far as the merge looks."""

    zid, eid = "a1", 7


class FakeSample:
    key_expr = "x/@v1/plots/a"

    def __init__(self, number: int) -> None:
        self.source_info = self
        self.source_id, self.source_sn = Source, number


class FakeReply:
    def __init__(self, number: int) -> None:
        self.ok = FakeSample(number)


class FakeSession:
    """A publisher's cache behind a link: deaf to the first questions, then it answers, at most ``portion`` at once."""

    def __init__(self, cache: range, deaf: int = 0, portion: int = 10**6) -> None:
        self.cache, self.deaf, self.portion, self.asked = cache, deaf, portion, list[str]()

    def get(self, selector: str, handler: object, **_more: object) -> None:
        self.asked.append(selector.partition("?")[2])
        first = int(selector.partition("_sn=")[2].rstrip(".") or 0)
        callback, done = cast(Any, handler).callback, cast(Any, handler).drop
        if self.deaf:
            self.deaf -= 1
        else:
            for number in [n for n in self.cache if n >= first][: self.portion]:
                callback(FakeReply(number))
        done()


class Timer:
    """Runs at once."""

    daemon = False

    def __init__(self, _delay_s: float, action: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        self._action, self._arguments = action, arguments

    def start(self) -> None:
        self._action(*self._arguments)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "Timer", Timer)


def merged(session: FakeSession, live: list[int]) -> list[int]:
    got: list[int] = []
    merge = _Merge(cast(zenoh.Session, session), lambda sample: got.append(cast(Any, sample).source_sn))
    for number in live:
        merge.on_sample(cast(zenoh.Sample, FakeSample(number)))
    return got


def test_a_late_joiner_gets_what_is_kept_first() -> None:
    assert merged(FakeSession(range(6)), [4, 5, 6, 7]) == list(range(8))


@pytest.mark.parametrize("deaf", [0, 1, 3])
def test_a_gap_is_filled_even_if_the_first_questions_find_nobody(deaf: int) -> None:
    session = FakeSession(range(3))
    got: list[int] = []
    merge = _Merge(cast(zenoh.Session, session), lambda sample: got.append(cast(Any, sample).source_sn))
    for number in (0, 1, 2):
        merge.on_sample(cast(zenoh.Sample, FakeSample(number)))
    # An outage: what was published meanwhile is in the cache only.
    session.cache, session.deaf = range(200), deaf
    for number in (200, 201):
        merge.on_sample(cast(zenoh.Sample, FakeSample(number)))
    assert got == list(range(202))
    assert session.asked[-1] == "_sn=2.."


def test_answers_in_portions_are_asked_for_until_nothing_is_missing() -> None:
    session = FakeSession(range(3))
    got: list[int] = []
    merge = _Merge(cast(zenoh.Session, session), lambda sample: got.append(cast(Any, sample).source_sn))
    merge.on_sample(cast(zenoh.Sample, FakeSample(2)))
    session.cache, session.portion = range(100), 30
    merge.on_sample(cast(zenoh.Sample, FakeSample(100)))
    assert got == list(range(101))


def test_what_no_cache_holds_is_given_up_and_the_stream_goes_on() -> None:
    assert merged(FakeSession(range(0)), [5, 6, 9, 10]) == [5, 6, 9, 10]
    assert merged(FakeSession(range(4)), [9, 10, 12]) == [0, 1, 2, 3, 9, 10, 12]
    session = FakeSession(range(5))
    got: list[int] = []
    merge = _Merge(cast(zenoh.Session, session), lambda sample: got.append(cast(Any, sample).source_sn))
    merge.on_sample(cast(zenoh.Sample, FakeSample(4)))
    # The outage was longer than the cache: 50 to 60 is what is left.
    session.cache = range(50, 60)
    for number in (60, 61):
        merge.on_sample(cast(zenoh.Sample, FakeSample(number)))
    assert got == [*range(5), *range(50, 62)]


@given(st.lists(st.integers(0, 60), max_size=40))
def test_nothing_comes_twice_nor_out_of_order(live: list[int]) -> None:
    got = merged(FakeSession(range(20, 40)), live)
    assert got == sorted(set(got))
    assert not live or got[-1] == max(live[0], *live, 39)
