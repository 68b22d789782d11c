"""The judge of a chaos run can fail: who is late, who lost a number, which batch went missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from benchmarks.faults.judge import Account, Batch, Fault, Judge, account, read_black_box, read_journal, tracked
from hypothesis import given
from hypothesis import strategies as st
from tests.protocol.builders import frame

from trackmesh.protocol.messages import CONFIRMED, ENDED

S = 1_000_000_000


def test_every_batch_is_somewhere() -> None:
    published: list[Batch] = [("a", "x", n) for n in range(10)] + [("a", "y", n) for n in range(5)]
    first = [("a", "x", n) for n in (0, 1, 2, 4, 5)]
    second = [("a", "x", n) for n in (5, 6, 7)] + [("a", "y", n) for n in range(5)]
    # 3 is missing in between; 8 and 9 died with the radar.
    assert account(published, [first, second], 1) == Account(15, 12, 2, 1, 0, 0)
    assert account(published, [first, second], 0) == Account(15, 12, 2, 0, 1, 0)
    assert account(published, [first, [*second, second[0]]], 1).twice == 1


@given(st.lists(st.booleans(), max_size=30), st.integers(0, 5))
def test_accounts_add_up(taken: list[bool], gaps: int) -> None:
    published: list[Batch] = [("a", "x", n) for n in range(len(taken))]
    one = account(published, [[b for b, t in zip(published, taken, strict=True) if t]], gaps)
    assert one.taken + one.died + one.told + one.untold == one.published


def test_a_track_belongs_to_its_nearest_target_only() -> None:
    one = frame([1, 2, 3]).model_copy(
        update={
            "status": np.array([CONFIRMED, CONFIRMED, ENDED], np.uint8),
            "state": np.array([[0.0, 0, 0, 0, 0, 0], [500.0, 0, 0, 0, 0, 0], [9e4, 0, 0, 0, 0, 0]]),
            "updated_t_ns": np.array([5, 6, 7]),
        }
    )
    there = np.array([[10.0, 0.0], [100.0, 0.0], [9e4, 0.0]])
    assert tracked(one, np.array([11, 12, 13]), there) == {11: (1, 5), 12: (2, 6)}


def test_recovery_needs_a_plot_from_after_the_healing_and_numbers_are_compared() -> None:
    judge = Judge()
    judge.take({1: (7, 1), 2: (8, 1)}, 2, 1 * S)
    judge.healed(Fault("kill", "fusion", 1 * S, 3 * S, {1: 7, 2: 8}))
    judge.take({1: (7, 2 * S), 2: (8, 2 * S)}, 2, 4 * S)
    assert judge.judged[0].missing == {1, 2}
    judge.take({1: (7, 4 * S)}, 2, 5 * S)
    judge.take({1: (7, 4 * S), 2: (9, 6 * S)}, 2, 7 * S)
    (one,) = judge.judged
    assert one.recovered_s == {1: 2.0, 2: 4.0} and one.kept == {1: True, 2: False}
    assert one.undisturbed_s == one.recovered_s
    # It was whole from 1 to 4 s, of which only the first one and a half count, and from 4 to 5.
    assert (judge.seen_ns, judge.whole_ns) == (6 * S, 2.5 * S)


def test_a_later_fault_that_concerns_all_restarts_the_clock_of_those_not_yet_tracked() -> None:
    judge = Judge()
    judge.healed(Fault("kill", "fusion", 0, 1 * S, {1: 7, 2: 8}))
    judge.take({1: (7, 2 * S)}, 2, 3 * S)
    judge.healed(Fault("kill", "north", 4 * S, 5 * S, {}))
    judge.healed(Fault("cut", "client", 6 * S, 8 * S, {1: 7}))
    judge.take({1: (7, 9 * S), 2: (8, 9 * S)}, 2, 10 * S)
    first, _, last = judge.judged
    assert first.recovered_s == {1: 2.0, 2: 9.0} and first.undisturbed_s == {1: 2.0, 2: 2.0}
    assert last.recovered_s == {1: 2.0}


def test_files_are_read_up_to_where_they_were_cut_off(tmp_path: Path) -> None:
    journal, box = tmp_path / "j", tmp_path / "b"
    journal.write_text("x 0 5 17\nx 1 5 18\nx 2 5")
    assert read_journal(journal, "a") == [("a", "x", 0), ("a", "x", 1)]
    line = '{"type":"plots","sensor_id":"a","boot_id":"x","seq":%d}'
    box.write_text('{"type":"tick","t_ns":5}\n' + line % 0 + "\n" + (line % 1)[:-5])
    assert read_black_box(box) == [("a", "x", 0)]
