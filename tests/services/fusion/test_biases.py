from __future__ import annotations

import json
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.services.fusion.biased import (
    EAST,
    NORTH,
    PLACES,
    RING,
    SMALL,
    Sky,
    announced,
    assert_registered,
    finish,
)

from trackmesh.services.fusion.registration import Registration

FloatArray = npt.NDArray[np.float64]


def running(seed: int = 36) -> tuple[Registration, Sky]:
    sky = Sky(seed, 50, [NORTH, EAST._replace(bias=SMALL), PLACES])
    registration = announced(sky)
    finish(registration, sky, 60.0)
    return registration, sky


@pytest.mark.parametrize("as_json", [False, True])
def test_a_snapshot_is_restored(as_json: bool) -> None:
    registration, sky = running()
    kept = registration.snapshot()
    if as_json:
        kept = json.loads(json.dumps(kept, default=lambda array: array.tolist()))
    again = Registration()
    again.restore(kept)
    assert not again.messages()
    for station in reversed(sky.stations):
        again.announce(station.name, station.kind, station.site_m)
    for old, new in zip(registration.messages(), again.messages(), strict=True):
        assert old.sensor_id == new.sensor_id
        assert (old.locked, old.pairs, old.jumps, old.notes) == (new.locked, new.pairs, new.jumps, new.notes)
        assert np.array_equal(old.bias, new.bias)
        assert np.array_equal(old.covariance, new.covariance)
        assert np.array_equal(registration.shift(old.sensor_id, RING), again.shift(old.sensor_id, RING))
    finish(again, sky, 120.0, begin_s=60.0)
    assert_registered(again, sky)


def test_what_is_old_is_less_certain() -> None:
    registration, _ = running()
    again = Registration()
    again.restore(registration.snapshot(), age_s=3600.0)
    old, new = registration.snapshot()["covariance"], again.snapshot()["covariance"]
    assert np.sqrt(new[0, 0] - old[0, 0]) == pytest.approx(60.0, rel=0.05)
    assert again.locked("east")


@pytest.fixture(scope="module")
def kept() -> dict[str, Any]:
    return running()[0].snapshot()


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("sensors", "abc", "must be a list"), ("sensors", ["a", "a", "b"], "different names"),
        ("sensors", ["a", 1, "b"], "different names"), ("sensors", ["a"], "as many as"),
        ("kinds", ["polar", "polar", "radar"], "polar or position"), ("kinds", ["polar", "polar", []], "polar or"),
        ("prior", np.zeros((3, 2)), "shape"), ("prior", -np.ones((3, 3)), "negative"), ("bias", "x", "numbers"),
        ("bias", np.full((3, 3), np.nan), "finite"), ("bias", [[1.0], [1.0, 2.0]], "numbers"),
        ("applied", np.full((3, 3), np.inf), "finite"), ("covariance", np.eye(8), "shape"),
        ("covariance", np.ones((9, 9)), "zero where the prior is"),
        ("covariance", -np.diag([1.0, 1.0, 0.0] * 3), "positive definite"),
        ("covariance", np.diag([1.0, 1.0, 0.0] * 3) + np.eye(9, k=1) * ([0, 1, 0] + [0] * 6), "symmetric|zero"),
        ("locked", [1, 0, 1], "true or false"), ("pairs", [1, 2, -1], "counts"), ("jumps", [True, 1, 2], "counts"),
    ],
)  # fmt: skip
def test_what_is_no_snapshot_is_refused(kept: dict[str, Any], name: str, value: Any, sentence: str) -> None:
    registration = Registration()
    with pytest.raises(ValueError, match=sentence):
        registration.restore(kept | {name: value})
    assert not registration.snapshot()["sensors"]


def test_a_snapshot_with_a_part_missing_is_refused(kept: dict[str, Any]) -> None:
    for name in kept:
        with pytest.raises(ValueError, match=f"{name} is missing"):
            Registration().restore({k: v for k, v in kept.items() if k != name})


def test_a_snapshot_is_for_the_beginning_and_of_the_past(kept: dict[str, Any]) -> None:
    registration, _ = running()
    with pytest.raises(ValueError, match="before the first sensor"):
        registration.restore(kept)
    for age_s in (-1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="age_s"):
            Registration().restore(kept, age_s)


def test_the_snapshot_is_a_copy() -> None:
    registration, _ = running()
    kept = registration.snapshot()
    before = registration.messages()[1].bias
    for name in ("prior", "bias", "covariance", "applied"):
        kept[name][:] = 0.0
    assert np.array_equal(registration.messages()[1].bias, before)
    assert registration.shift("east", RING).any()


def test_equal_calls_give_equal_numbers() -> None:
    one, other = running()[0].snapshot(), running()[0].snapshot()
    for name, value in one.items():
        assert np.array_equal(value, other[name]), name
