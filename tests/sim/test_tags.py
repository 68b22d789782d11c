"""Simulated tags: the reference way, what readers hear of it, and that all of it follows from the seed."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.files import read_records
from trackmesh.protocol.messages import RangeBatch, SensorInfo, TruthFrame
from trackmesh.sim.recording import write_ranges
from trackmesh.sim.scenario import Scenario, ScenarioError, load_scenario
from trackmesh.sim.tag_paths import TagPaths
from trackmesh.sim.tags import TagWorld, hear, reader_infos, strength


@pytest.fixture
def hall() -> Scenario:
    return load_scenario("rfid19")


def changed(scenario: Scenario, **change: Any) -> Scenario:
    return scenario.model_copy(update={"tags": scenario.heard_tags().model_copy(update=change)})


def walked(scenario: Scenario, until_s: float = 60.0) -> FloatArray:
    """Places (n, 2) of the first tag, a hundred a second."""
    paths = TagPaths(scenario.heard_tags())
    t_s = np.arange(0.0, until_s, 0.01)
    return paths.place(np.zeros(len(t_s), np.int64), t_s)


def test_the_hall_has_the_readers_of_the_table(hall: Scenario) -> None:
    tags = hall.heard_tags()
    assert len(tags.readers) == 19
    assert tags.readers[0].site_enu_m == (22.46, 28.80) and tags.readers[18].site_enu_m == (95.05, 7.456)
    infos = reader_infos(hall)
    assert {info.kind for info in infos} == {"ranging"} and infos[3].sigma == {"range_m": 2.0}


def test_the_reference_way_is_a_walk_in_stop_and_go(hall: Scenario) -> None:
    paths, at = TagPaths(hall.heard_tags()), walked(hall)
    assert paths.length_m == pytest.approx(267.0, abs=0.5)
    assert paths.duration_s == pytest.approx(60.0, abs=0.1)
    velocity = np.gradient(at, 0.01, axis=0)[50:-50]
    speed = np.hypot(*velocity.T)
    assert speed.min() == pytest.approx(2.6, abs=0.1) and speed.max() == pytest.approx(6.1, abs=0.1)
    acceleration = np.gradient(velocity, 0.01, axis=0)
    assert np.sqrt((acceleration**2).sum(1).mean()) == pytest.approx(1.6, abs=0.1)
    for place in hall.heard_tags().path_enu_m:
        assert np.hypot(*(at - place).T).min() < 0.2


def test_two_to_eight_readers_are_in_reach(hall: Scenario) -> None:
    world = TagWorld(hall, 1)
    d = np.hypot(*(walked(hall)[:, None] - world.readers).transpose(2, 0, 1))
    count = (d <= 30.0).sum(1)
    assert (count.min(), count.max()) == (2, 8)
    assert count.mean() == pytest.approx(4.4, abs=0.2)


def test_other_tags_walk_elsewhere_and_turn_back_smoothly(hall: Scenario) -> None:
    scenario = changed(hall, count=8, turn_m=8.0)
    paths = TagPaths(scenario.heard_tags())
    at = np.array([paths.positions(t) for t in np.arange(0.0, 200.0, 0.05)])
    assert at.shape == (4000, 8, 2)
    assert at.min() > 0.0 and at.max() < 100.0
    apart = np.hypot(*(at[:, :, None] - at[:, None]).transpose(3, 0, 1, 2)).mean(0)
    assert apart[~np.eye(8, dtype=bool)].min() > 10.0
    acceleration = np.diff(at, 2, axis=0) / 0.05**2
    assert np.hypot(*acceleration.transpose(2, 0, 1)).max() < 15.0


def heard_often(tags: Any, place: tuple[float, float], n: int = 4000) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distances of readers, shares heard, and all errors, of a tag that stands."""
    readers = np.array([reader.site_enu_m for reader in tags.readers])
    heard = hear(tags, readers, np.broadcast_to(np.array(place), (n, 2)), np.random.default_rng(4))
    d = np.hypot(*(readers - place).T)
    share = np.bincount(heard.reader, minlength=len(readers)) / n
    return d, share, heard.range_m - d[heard.reader]


def test_a_reader_in_reach_hears_with_its_probability_and_noise(hall: Scenario) -> None:
    d, share, error = heard_often(hall.heard_tags(), (50.0, 35.0))
    np.testing.assert_allclose(share, np.where(d <= 30.0, 0.27, 0.0), atol=0.03)
    assert stats.kstest(error / 2.0, "norm").pvalue > 1e-3


def test_some_ranges_go_round_a_corner(hall: Scenario) -> None:
    tags = hall.heard_tags().model_copy(update={"nlos_share": 0.3, "sigma_range_m": 0.01})
    _, _, error = heard_often(tags, (50.0, 35.0))
    long = error[error > 0.1]
    assert len(long) / len(error) == pytest.approx(0.3, abs=0.03)
    assert long.mean() == pytest.approx(8.0, rel=0.1)


def test_signal_strengths_are_heard_above_a_threshold(hall: Scenario) -> None:
    rssi = {"power_1m_dbm": -40.0, "exponent": 3.0, "noise_db": 2.0}
    source = hall.model_dump(mode="json")
    source["tags"] |= {"rssi": rssi, "p_detect": 1.0}
    world = TagWorld(Scenario.model_validate(source), 1)
    batches = list(islice(world.batches(boot_id="b", start_ns=0), 200))
    weakest = strength(np.array([30.0]), -40.0, 3.0)[0]
    heard = np.concatenate([b.rssi_dbm for b in batches if b.rssi_dbm is not None])
    assert all(b.range_m is None for b in batches) and len(heard) > 500
    assert heard.min() >= weakest - 1e-9


def test_any_process_hears_the_same(hall: Scenario) -> None:
    one, other = TagWorld(hall, 5), TagWorld(hall, 5)
    for tick in (0, 7, 3):
        a, b = (world.batch(tick, boot_id="b", seq=tick, start_ns=0) for world in (one, other))
        assert a == b
    assert TagWorld(hall, 6).batch(7, boot_id="b", seq=7, start_ns=0) != one.batch(7, boot_id="b", seq=7, start_ns=0)


def test_a_recording_holds_readers_ranges_and_truth(hall: Scenario, tmp_path: Path) -> None:
    for name in ("a", "b"):
        n = write_ranges(hall, 3, tmp_path / f"{name}.jsonl", tmp_path / f"{name}-truth.jsonl", duration_s=5.0)
    assert (tmp_path / "a.jsonl").read_bytes() == (tmp_path / "b.jsonl").read_bytes()
    records = list(read_records(tmp_path / "a.jsonl"))
    assert sum(isinstance(record, SensorInfo) for record in records) == 19
    batches = [record for record in records if isinstance(record, RangeBatch)]
    assert len(batches) == 51 and sum(len(b.t_ns) for b in batches) == n
    truth = [frame for frame in read_records(tmp_path / "a-truth.jsonl") if isinstance(frame, TruthFrame)]
    assert len(truth) == 11 and truth[0].state[0, :2] == pytest.approx([12.0, 20.0])
    step = (truth[5].state[0, :2] - truth[4].state[0, :2]) / 0.5
    assert truth[4].state[0, 2:] == pytest.approx(step, abs=1.0)


@pytest.mark.parametrize("name", ["many"])
def test_a_scenario_without_tags_says_so(name: str) -> None:
    with pytest.raises(ScenarioError, match=r"has no \[tags\] section"):
        TagWorld(load_scenario(name), 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"readers": [{"id": "a", "site_enu_m": [0, 0]}] * 2}, "the reader id 'a' is used more than once"),
        ({"p_detect": 0.0}, "greater than 0"),
        ({"path_enu_m": [[0, 0]]}, "at least 2 items"),
        ({"stop_and_go": 1.0}, "less than 1"),
    ],
)
def test_what_is_wrong_with_tags_is_said(hall: Scenario, change: dict[str, Any], sentence: str) -> None:
    source = hall.model_dump(mode="json")
    source["tags"] |= change
    with pytest.raises(ValueError, match=sentence):
        Scenario.model_validate(source)


def test_a_scenario_must_hold_something(hall: Scenario) -> None:
    with pytest.raises(ValueError, match="there must be targets with radars, tags or emi"):
        Scenario.model_validate(hall.model_dump(mode="json", exclude={"tags"}))
    with pytest.raises(ValueError, match="radars that see them"):
        targets = {"count": 1, "area_enu_m": [-1e5, -1e5, 1e5, 1e5], "speed_mps": [10, 20]}
        Scenario.model_validate(hall.model_dump(mode="json") | {"targets": targets})
