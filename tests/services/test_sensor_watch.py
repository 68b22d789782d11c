"""Who is silent since when, of whom nothing is taken, whose clock is off: told once, in a sentence."""

from __future__ import annotations

from trackmesh.services.health import Notices
from trackmesh.services.sensor_watch import Limits, SensorWatch

S = 1_000_000_000
AT = 1_700_000_000 * S
TOD = "22:13:20 UTC"


def watch(*, named: tuple[str, ...] = (), clocks: bool = True) -> SensorWatch:
    return SensorWatch(Limits(0.25, 100.0), clocks, named, AT)


def feed(one: SensorWatch, name: str, seconds: float, ahead_s: float = 0.0, begin_s: float = 0.0) -> int:
    """Eight batches a second, each taken; the time of the last."""
    now_ns = AT
    for k in range(round(8 * seconds)):
        now_ns = AT + round((begin_s + k / 8) * S)
        one.heard(name, now_ns - 20_000_000 + round(ahead_s * S), 8, now_ns)
        one.took(name, now_ns)
    return now_ns


def test_a_sensor_on_time_is_not_mentioned() -> None:
    one = watch()
    one.expect("a", 1.0, AT)
    now_ns = feed(one, "a", 20.0)
    assert one.notices({"a"}, now_ns + 2 * S) == {}
    assert one.silent_since_ns("a", now_ns + 2 * S) is None


def test_silence_is_told_with_its_beginning_and_whether_there_is_life() -> None:
    one = watch()
    for name in "ab":
        one.expect(name, 1.0, AT)
    now_ns = AT + 4 * S
    told = one.notices({"b"}, now_ns)
    assert f"Sensor a is silent since {TOD}: not alive: process, host or link is down." in told.values()
    assert f"Sensor b is silent since {TOD}: alive, but no batch comes." in told.values()
    assert one.silent_since_ns("a", now_ns) == AT
    # A slow sensor is given three of its periods; one that left for good is forgotten.
    one.expect("slow", 10.0, AT)
    assert "slow" not in " ".join(one.notices(set(), AT + 29 * S))
    assert one.notices(set(), AT + 3700 * S) == {}


def test_a_sensor_that_was_never_heard_is_missed_if_it_was_named() -> None:
    one = watch(named=("a",))
    assert one.notices(set(), AT + 1 * S) == {}
    assert "Sensor a is silent" in "".join(one.notices(set(), AT + 4 * S).values())
    one.expect("a", 1.0, AT + 4 * S)
    assert one.notices(set(), AT + 5 * S) == {}


def test_a_sensor_of_whom_all_is_refused_is_told_with_the_reason() -> None:
    one = watch()
    one.expect("a", 1.0, AT)
    now_ns = feed(one, "a", 5.0)
    for _ in range(40):
        now_ns += S // 8
        one.heard("a", now_ns + 5 * S, 8, now_ns)
        one.refused("a", "future")
    told = list(one.notices({"a"}, now_ns).values())
    assert any(line.startswith("Nothing of sensor a is taken since") and "(future)" in line for line in told)


def test_clocks_are_told_beyond_their_limits_only() -> None:
    for ahead_s, words in ((0.2, ""), (0.5, "0.48 s ahead"), (-0.2, ""), (-0.6, "0.62 s after its time")):
        one = watch()
        one.expect("a", 1.0, AT)
        now_ns = feed(one, "a", 20.0, ahead_s)
        told = "".join(one.notices({"a"}, now_ns).values())
        assert words in told and bool(words) == bool(told), (ahead_s, told)


def test_of_sensors_that_are_not_followed_nothing_is_expected() -> None:
    one = watch()
    for name in "ab":
        one.expect(name, 1.0, AT)
    one.follow(frozenset("a"), AT)
    assert list(one.notices(set("ab"), AT + 5 * S)) == ["silent a"]
    assert one.silent_since_ns("b", AT + 5 * S) is None
    # From when it is followed on it is given its time.
    one.follow(frozenset("b"), AT + 60 * S)
    assert one.notices(set("ab"), AT + 61 * S) == {}
    assert list(one.notices(set("ab"), AT + 65 * S)) == ["silent b"]


def test_where_there_are_no_tokens_none_are_missed() -> None:
    one = SensorWatch(Limits(0.25, 100.0), True, word="network")
    one.expect("hall", 1.5, AT)
    assert list(one.notices(None, AT + 6 * S).values()) == [f"Network hall is silent since {TOD}: no batch comes."]


def test_a_recording_has_no_clock() -> None:
    one = watch(clocks=False)
    one.expect("a", 1.0, AT)
    now_ns = feed(one, "a", 20.0, -1e6)
    assert one.notices({"a"}, now_ns) == {} and one.clock("a").offset_s is None


def test_a_drift_is_told_in_seconds_an_hour() -> None:
    one = watch()
    one.expect("a", 1.0, AT)
    now_ns = AT
    for k in range(1600):
        now_ns = AT + k * S // 8
        one.heard("a", now_ns + round(500e-6 * k / 8 * S), 8, now_ns)
        one.took("a", now_ns)
    assert "The clock of sensor a gains 500 ± 8 ppm (1.80 s an hour)." in one.notices({"a"}, now_ns).values()


def test_each_notice_is_told_once_and_its_end_once() -> None:
    said: list[str] = []
    notices = Notices(said.append, said.append)
    for now in ({"x": "X is off by 1."}, {"x": "X is off by 2."}, {"x": "X is off by 2.", "y": "Y."}, {"y": "Y."}, {}):
        assert notices.update(now) == list(now.values())
    assert said == ["X is off by 1.", "Y.", "over: X is off by 2.", "over: Y."]
