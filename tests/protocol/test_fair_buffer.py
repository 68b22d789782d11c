"""Keys that share a buffer: turns, shares, and the order of each."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from trackmesh.protocol.bus import Sample
from trackmesh.protocol.fair_buffer import FairBuffer


def sample(key: str, number: int) -> Sample:
    return Sample(key, str(number).encode(), "")


def drained(buffer: FairBuffer) -> list[Sample]:
    return list(iter(lambda: buffer.receive(0.0), None))


def test_a_key_that_floods_displaces_only_itself() -> None:
    buffer = FairBuffer(100)
    for n in range(10):
        buffer.offer(sample("quiet", n))
    for n in range(100_000):
        buffer.offer(sample("loud", n))
    for n in range(10, 20):
        buffer.offer(sample("quiet", n))
    kept = drained(buffer)
    assert [int(s.payload) for s in kept if s.key == "quiet"] == list(range(20))
    assert [int(s.payload) for s in kept if s.key == "loud"] == list(range(100_000 - 80, 100_000))
    assert buffer.dropped == 100_000 - 80


def test_who_waits_behind_a_flood_waits_for_one_message_of_it() -> None:
    buffer = FairBuffer(1000)
    for n in range(500):
        buffer.offer(sample("loud", n))
    buffer.offer(sample("quiet", 0))
    assert [s.key for s in (buffer.receive(0.0), buffer.receive(0.0)) if s] == ["loud", "quiet"]


@given(st.lists(st.tuples(st.sampled_from("abc"), st.booleans()), max_size=200), st.integers(1, 20))
def test_each_key_keeps_its_order_and_its_newest(steps: list[tuple[str, bool]], capacity: int) -> None:
    buffer, offered, taken = FairBuffer(capacity), 0, list[Sample]()
    for number, (key, take) in enumerate(steps):
        buffer.offer(sample(key, number))
        offered += 1
        assert len(buffer) <= capacity
        if take and (one := buffer.receive(0.0)) is not None:
            taken.append(one)
    taken += drained(buffer)
    assert len(taken) + buffer.dropped == offered
    assert len(buffer) == 0 and not buffer._queues and not buffer._turns
    for key in "abc":
        numbers = [int(s.payload) for s in taken if s.key == key]
        assert numbers == sorted(numbers)
        last = [n for n, (k, _) in enumerate(steps) if k == key][-1:]
        # The newest of a key is given up only for a key that has none.
        assert numbers[-1:] == last or capacity < 3
