from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import EmiGeometry, EmiScanBatch
from trackmesh.services.emi.convert import to_coils, to_message, to_request
from trackmesh.services.emi.engine import invert
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

GEOMETRY = survey_geometry((3.0, 3.0), 0.3)
BATCH = simulate(GEOMETRY, random_targets(1, 5), 30.0, 5).batch


def asked(**changes: Any) -> EmiScanBatch:
    return EmiScanBatch.model_validate(BATCH.model_dump() | changes)


def test_units_are_tesla_inside_and_the_clients_outside() -> None:
    in_pt = asked(field=1e3 * BATCH.field, sigma=1e3 * BATCH.sigma, field_unit="pT")  # type: ignore[operator]
    results = [to_message(b, next(invert(*to_request(b, 45.0)))) for b in (BATCH, in_pt)]
    assert results[0].sigma_used == pytest.approx(BATCH.sigma)
    assert results[1].sigma_used == pytest.approx(1e3 * results[0].sigma_used)  # type: ignore[operator]
    np.testing.assert_allclose(results[1].targets[0].position_m, results[0].targets[0].position_m, atol=1e-7)
    np.testing.assert_allclose(results[1].targets[0].tensor_m3, results[0].targets[0].tensor_m3, rtol=1e-5, atol=1e-8)


def test_an_arbitrary_unit_makes_relative_tensors() -> None:
    batch = asked(field_unit="arbitrary")
    result = to_message(batch, next(invert(*to_request(batch, 45.0))))
    assert "tensor_relative" in result.reasons


def test_sigma_comes_by_component_and_by_sample() -> None:
    n = len(GEOMETRY.positions_m)
    assert to_request(asked(sigma=None), 45.0).sigma_t is None
    by_component = to_request(asked(sigma=[1.0, 2.0, 3.0]), 45.0).sigma_t
    np.testing.assert_allclose(by_component, [1e-9, 2e-9, 3e-9])  # type: ignore[arg-type]
    factor = np.linspace(1.0, 2.0, n)
    both = to_request(asked(sigma=[1.0, 2.0, 3.0], sigma_factor=factor), 45.0).sigma_t
    np.testing.assert_allclose(both, 1e-9 * factor[:, None] * [1.0, 2.0, 3.0])  # type: ignore[arg-type]


def test_coils_are_those_of_the_geometry() -> None:
    coils = to_coils(GEOMETRY)
    assert coils.moment_am2 == pytest.approx(20.0 * np.pi * 0.25)
    assert coils.is_loop
    tilted = EmiGeometry.model_validate(GEOMETRY.model_dump() | {"axes": np.ones((len(GEOMETRY.positions_m), 3))})
    assert to_coils(tilted).tx_axis.shape == (len(GEOMETRY.positions_m), 3)


@pytest.mark.parametrize("fmt", ["msgpack", "json"])
def test_gaps_in_the_field_travel(fmt: Any) -> None:
    field = BATCH.field.copy()
    field[0, 0, 3, 1], field[0, 0, 4, 0] = np.nan, np.inf
    gappy = asked(field=field)
    back = decode(encode(gappy, fmt), EmiScanBatch, encoding(gappy, fmt))
    np.testing.assert_array_equal(np.isfinite(back.field), np.isfinite(field))
    np.testing.assert_array_equal(back.field[np.isfinite(field)], field[np.isfinite(field)])


@pytest.mark.parametrize(
    "changes",
    [
        {"field": np.zeros((1, 1, 5, 3))},
        {"field": np.zeros((1, 1, len(GEOMETRY.positions_m), 1))},
        {"field": np.zeros((0, 1, len(GEOMETRY.positions_m), 3))},
        {"field": [[[["a"]]]]},
        {"field": [[[1.0], [1.0, 2.0]]]},
        {"sigma": [1.0]},
        {"sigma": 0.0},
        {"sigma": None, "sigma_factor": np.ones(len(GEOMETRY.positions_m))},
        {"sigma_factor": np.ones(3)},
        {"options": {"depth_min_m": 2.0, "depth_max_m": 1.0}},
        {"geometry": {"positions_m": np.zeros((0, 3)), "transmitter": {"radius_m": 0.5}}},
        {"geometry": {"positions_m": np.full((4, 3), 2e3), "transmitter": {"radius_m": 0.5}}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.5, "axis": [0.0, 0.0, 0.0]}}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.5}, "axes": np.zeros((4, 3))}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.0}}},
    ],
)
def test_what_does_not_fit_together_is_refused(changes: dict[str, Any]) -> None:
    from trackmesh.protocol.codec import from_object

    with pytest.raises(RefusedMessage):
        from_object(BATCH.model_dump() | changes, EmiScanBatch)
