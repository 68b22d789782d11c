"""How much a sensor may send."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from trackmesh.services.fusion.rates import LEAST_BURST, LEAST_PER_S, MOST_SENDERS, Rates


def taken(rates: Rates, sensor: str, per_s: float, seconds: float, begin_s: float = 0.0) -> int:
    n = round(per_s * seconds)
    return sum(rates.message(sensor, begin_s + k / per_s) for k in range(n))


def test_a_sensor_at_a_hundred_times_its_rate_is_held_to_its_limit() -> None:
    rates = Rates(0.0, 1e4)
    rates.expect("loud", 8.0)
    assert taken(rates, "loud", 800.0, 60.0) <= LEAST_PER_S * 60.0 + 480.0
    rates = Rates(0.0, 1e4)
    rates.expect("loud", 100.0)
    assert 24_000 <= taken(rates, "loud", 10_000.0, 60.0) <= 400.0 * 60.0 + 6000.0


@given(st.floats(0.05, 200.0), st.floats(1.0, 60.0))
def test_what_an_outage_of_up_to_a_minute_withheld_is_taken_at_once(per_s: float, outage_s: float) -> None:
    rates = Rates(0.0, 1e4)
    rates.expect("a", per_s)
    assert all(rates.message("a", 0.0) for _ in range(int(per_s * outage_s)))
    assert taken(rates, "a", per_s, 5.0, 0.1) == round(per_s * 5.0)


def test_a_limit_of_the_settings_holds_for_all() -> None:
    rates = Rates(2.0, 1e4)
    rates.expect("a", 1000.0)
    assert taken(rates, "a", 1000.0, 10.0) <= LEAST_BURST + 20


def test_what_a_sensor_declares_is_believed_to_a_point() -> None:
    rates = Rates(0.0, 1e4)
    rates.expect("liar", 1e9)
    assert taken(rates, "liar", 1e5, 10.0) <= 250 * 60 + 1000 * 10


def test_a_new_declaration_does_not_fill_the_bucket() -> None:
    rates = Rates(0.0, 1e4)
    total = 0
    for k in range(1000):
        rates.expect("sly", 10.0 + k % 2)
        total += taken(rates, "sly", 1000.0, 0.01, k * 0.01)
    assert total <= 11.0 * 60 + LEAST_PER_S * 10 + 1000


def test_plots_count_as_well() -> None:
    rates = Rates(0.0, 100.0)
    assert rates.plots("a", 6000, 0.0) and not rates.plots("a", 1, 0.0)
    assert rates.plots("a", 100, 1.0) and not rates.plots("a", 100, 1.5)
    assert rates.plots("b", 6000, 1.5)


def test_names_without_end_cost_no_memory_without_end() -> None:
    rates = Rates(0.0, 1e4)
    refused = sum(not rates.message(f"ghost-{k}", 0.0) for k in range(MOST_SENDERS + 1000))
    assert refused == 1000 - LEAST_BURST
    assert len(rates._batches) == MOST_SENDERS + 1
