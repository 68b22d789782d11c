"""The tag engine: pictures that are right, complete, repeatable, and valid messages."""

from __future__ import annotations

import math

import numpy as np
from tests.services.tags.worlds import SIGMA, T0, Hall, S, batch, place_of, reader, status_of

from trackmesh.protocol.codec import decode, encode
from trackmesh.protocol.files import to_line
from trackmesh.protocol.messages import GONE, LOCATED, LOST, UNSURE, RangeBatch, SensorInfo, TagFrame
from trackmesh.services.tags.engine import TagEngine, Unit
from trackmesh.services.tags.settings import TagEngineSettings


def walk(hall: Hall, tags: int, seconds: float) -> list[TagFrame]:
    """Tags that walk round circles; every reader hears each of them now and then."""
    frames = []
    for k in range(round(10 * seconds)):
        rows = []
        for tag in range(tags):
            for name in hall.places:
                if hall.rng.random() < 0.4:
                    rows += hall.rows(0.1 * k, f"tag-{tag}", path(tag, 0.1 * k), [name])
        if rows and (frame := hall.put(rows)) is not None:
            frames.append(frame)
    return frames


def path(tag: int, t_s: float) -> tuple[float, float]:
    angle = 0.1 * t_s + tag
    return 20.0 + 12.0 * math.cos(angle), 20.0 + 12.0 * math.sin(angle)


def test_walking_tags_are_where_they_are() -> None:
    hall = Hall()
    frames = walk(hall, 8, 20.0)
    errors, nees = [], []
    for frame in frames[50:]:
        assert set(frame.tag_id) == {f"tag-{k}" for k in range(8)}
        assert (frame.status == LOCATED).all() and (frame.certainty == 1.0).all()
        truth = np.array([path(int(name[4:]), (frame.t_ns - T0) / S) for name in frame.tag_id])
        e = frame.state[:, :2] - truth
        errors.append(e)
        P = frame.covariance_matrices()[:, :2, :2]
        nees.append(np.einsum("ka,kab,kb->k", e, np.linalg.inv(P), e))
    assert math.sqrt(np.mean(np.sum(np.square(errors), -1))) < 1.2 * SIGMA
    assert 0.4 < np.mean(nees) / 2 < 1.3


def test_frames_are_valid_messages() -> None:
    for bias_sd_m in (0.0, 0.5):
        hall = Hall(range_bias_sd_m=bias_sd_m)
        walk(hall, 3, 3.0)
        hall.put(hall.rows(3.0, "alone", (5.0, 5.0), ["sw"]))
        hall.put(hall.rows(4.5, "alone", (5.0, 5.0), ["sw"]))
        frame = hall.tick(5.0) or hall.tick(6.1)
        assert frame is not None and "alone" in frame.tag_id
        assert decode(encode(frame), TagFrame) == frame
        assert (frame.range_bias_m is None) == (not bias_sd_m)


def test_the_same_inputs_give_the_same_bytes() -> None:
    def lines() -> list[str]:
        hall = Hall(motion="tvimm", adapt_acceleration=True)
        return [to_line(frame) for frame in walk(hall, 5, 6.0)]

    first, second = lines(), lines()
    assert len(first) > 50
    assert first == second


def test_how_ranges_are_batched_changes_no_tag() -> None:
    one, other = Hall(), Hall()
    rows = [row for k in range(40) for row in one.rows(0.1 * k, "a", (10.0, 15.0))]
    for k in range(0, len(rows), 4):
        frame = one.put(rows[k : k + 4])
    for k in range(0, len(rows), 40):
        # In any order within the batch.
        mixed = [rows[k + i] for i in np.random.default_rng(k).permutation(40)]
        together = other.put(mixed)
    assert frame is not None and together is not None
    np.testing.assert_array_equal(frame.state, together.state)


def test_ranges_of_another_network_may_come_a_little_later() -> None:
    ordered, mixed = Hall(reorder_s=0.3), Hall(reorder_s=0.3)
    rows = [row for k in range(40) for row in ordered.rows(0.1 * k, "a", (10.0, 15.0))]
    for k in range(0, len(rows), 4):
        ordered.put(rows[k : k + 4])
    late = [rows[k : k + 2] for k in range(0, len(rows), 4)]
    early = [rows[k + 2 : k + 4] for k in range(0, len(rows), 4)]
    for k in range(len(early)):
        mixed.put(early[k])
        if k >= 2:
            mixed.put(late[k - 2], network_id="other")
    for k in (-2, -1):
        mixed.put(late[k], network_id="other")
    a, b = ordered.tick(10.0), mixed.tick(10.0)
    assert a is not None and b is not None
    np.testing.assert_array_equal(a.state, b.state)
    assert mixed.count("late_ranges") == 0


def test_without_a_buffer_what_comes_too_late_is_left_out() -> None:
    hall = Hall()
    hall.stand("a", (10.0, 15.0), 0.0, 2.0)
    hall.put(hall.rows(1.0, "a", (10.0, 15.0)), network_id="other")
    assert hall.count("late_ranges") == 4


def test_a_frame_says_which_readers_were_used() -> None:
    hall = Hall(heard_s=2.0)
    hall.stand("a", (10.0, 15.0), 0.0, 1.0)
    frame = hall.put(hall.rows(3.5, "a", (10.0, 15.0), ["se", "nw"]) + hall.rows(3.5, "b", (9.0, 9.0), ["sw"]))
    assert frame is not None
    assert frame.readers_of(frame.tag_id.index("a")) == ["nw", "se"]
    whole = hall.stand("b", (9.0, 9.0), 3.6, 4.6)
    assert whole.readers_of(whole.tag_id.index("b")) == ["ne", "nw", "se", "sw"]
    assert whole.readers == ["ne", "nw", "se", "sw"]


def test_quality_is_the_share_of_ranges_that_fit() -> None:
    hall = Hall()
    good = hall.stand("a", (10.0, 15.0), 0.0, 5.0)
    assert good.quality[0] > 0.8
    rows = []
    for k in range(40):
        rows = hall.rows(5.0 + 0.1 * k, "a", (10.0, 15.0))
        frame = hall.put([(t, tag, name, z + 9.0 * (name in ("sw", "se"))) for t, tag, name, z in rows])
    assert frame is not None and frame.quality[0] < 0.7
    assert math.dist(place_of(frame, "a"), (10.0, 15.0)) < 2.0


def test_a_silent_tag_is_lost_then_gone_and_may_come_back() -> None:
    hall = Hall(lost_s=30.0, forget_s=100.0)
    spread = [math.sqrt(float(hall.stand("a", (10.0, 15.0), 0.0, 3.0).covariance[0, 0]))]
    for t_s in (10.0, 30.0, 63.0):
        frame = hall.tick(t_s)
        assert status_of(frame, "a") == (LOST if t_s > 33.0 else LOCATED)
        assert frame is not None and frame.updated_t_ns[0] == T0 + round(2.9 * S)
        spread.append(math.sqrt(float(frame.covariance[0, 0])))
    assert spread == sorted(spread) and spread[-1] > 10.0
    assert status_of(hall.tick(104.0), "a") == GONE
    frame = hall.tick(106.0)
    assert frame is not None and frame.tag_id == []
    assert hall.count("gone") == 1
    back = hall.put(hall.rows(200.0, "a", (30.0, 5.0)))
    assert status_of(back, "a") == LOCATED
    assert math.dist(place_of(back, "a"), (30.0, 5.0)) < 5 * SIGMA


def test_the_place_of_a_tag_that_is_gone_is_free_for_another() -> None:
    hall = Hall(max_tags=1, lost_s=30.0, forget_s=100.0)
    hall.stand("a", (10.0, 15.0), 0.0, 1.0)
    hall.tick(200.0)
    frame = hall.stand("b", (30.0, 5.0), 200.0, 201.0)
    assert frame.tag_id == ["b"] and hall.count("too_many_tags") == 0
    # One that was heard once, and never placed, is forgotten too, and silently.
    hall = Hall(max_tags=1, lost_s=30.0, start_wait_s=1e6)
    hall.put(hall.rows(0.0, "a", (10.0, 15.0), ["sw"]))
    assert hall.tick(200.0) is not None
    assert hall.stand("b", (30.0, 5.0), 200.0, 201.0).tag_id == ["b"]


def test_a_lost_tag_that_is_heard_again_is_where_it_is_heard() -> None:
    hall = Hall(lost_s=30.0)
    hall.stand("a", (10.0, 15.0), 0.0, 3.0)
    assert status_of(hall.tick(60.0), "a") == LOST
    frame = hall.put(hall.rows(61.0, "a", (35.0, 35.0)))
    assert status_of(frame, "a") == LOCATED
    assert math.dist(place_of(frame, "a"), (35.0, 35.0)) < 5 * SIGMA


def test_a_tag_heard_once_is_somewhere_on_the_circle() -> None:
    hall = Hall(start_wait_s=1.0)
    frame = hall.put(hall.rows(0.0, "a", (3.0, 4.0), ["sw"]))
    assert frame is not None and frame.tag_id == []
    frame = hall.tick(1.2)
    assert frame is not None and status_of(frame, "a") == UNSURE
    # Five metres away then, and walking since.
    assert 5.0 < math.sqrt(frame.covariance[0, 0] + frame.covariance[0, 6]) < 8.0
    assert frame.certainty[0] < 0.2


def test_readers_may_come_move_and_go() -> None:
    hall = Hall(readers={"sw": (0.0, 0.0), "se": (40.0, 0.0)})
    hall.stand("a", (10.0, 15.0), 0.0, 3.0)
    assert hall.engine.figures()["unsure"] == 1
    # A third one comes.
    hall.places["ne"] = (40.0, 40.0)
    assert hall.engine.reader(reader("ne", 40.0, 40.0))
    frame = hall.stand("a", (10.0, 15.0), 3.0, 5.0)
    assert status_of(frame, "a") == LOCATED and math.dist(place_of(frame, "a"), (10.0, 15.0)) < 3 * SIGMA
    # It moves, and measures from there.
    hall.places["ne"] = (0.0, 40.0)
    assert hall.engine.reader(reader("ne", 0.0, 40.0))
    frame = hall.stand("a", (10.0, 15.0), 5.0, 8.0)
    assert math.dist(place_of(frame, "a"), (10.0, 15.0)) < 3 * SIGMA
    assert hall.count("restarts") == 0
    # It goes: its ranges are those of nobody.
    assert hall.engine.drop_reader("ne") and not hall.engine.drop_reader("ne")
    hall.stand("a", (10.0, 15.0), 8.0, 9.0)
    assert hall.count("unknown_reader") == 10


def test_other_sensors_are_none_of_ours() -> None:
    hall = Hall()
    radar = SensorInfo(
        sensor_id="north",
        kind="radar",
        site_enu_m=[0.0, 0.0, 0.0],
        period_s=4.0,
        p_detect=0.9,
        max_range_m=1e5,
        sigma={},
    )
    assert not hall.engine.reader(radar)
    assert "north" not in hall.engine.readers.infos


def test_very_many_tags_find_room() -> None:
    hall = Hall()
    rows = []
    for tag in range(300):
        place = (1.0 + 0.12 * tag, 20.0)
        rows += hall.rows(0.0, f"t{tag}", place, ["sw", "se", "ne"] if tag % 3 else ["sw"])
    hall.put(rows)
    frame = hall.tick(1.5)
    assert frame is not None and len(frame.tag_id) == 300
    assert hall.engine.figures()["unsure"] >= 100
    for name in ("t1", "t100", "t298"):
        assert math.dist(place_of(frame, name), (1.0 + 0.12 * int(name[1:]), 20.0)) < 6 * SIGMA


def test_frames_come_no_faster_than_wanted() -> None:
    hall = Hall(frame_period_s=1.0, idle_frame_s=5.0)
    told = [hall.put(hall.rows(0.1 * k, "a", (10.0, 15.0))) for k in range(31)]
    assert [k for k, frame in enumerate(told) if frame is not None] == [0, 10, 20, 30]
    assert [t_s for t_s in range(4, 15) if hall.tick(float(t_s)) is not None] == [8, 13]


def test_an_empty_batch_is_welcome() -> None:
    hall = Hall()
    assert hall.engine.ranges(batch(0, [])) is None
    hall.stand("a", (10.0, 15.0), 0.0, 1.0)
    frame = hall.engine.ranges(batch(1, []))
    assert frame is not None and frame.tag_id == ["a"]


def test_the_engine_of_a_batch_without_readers() -> None:
    engine = TagEngine(TagEngineSettings(), Unit())
    engine.ranges(batch(0, [(0.0, "a", "sw", 3.0)]))
    assert engine.counts()["unknown_reader"] == 1
    assert isinstance(batch(0, []), RangeBatch)
