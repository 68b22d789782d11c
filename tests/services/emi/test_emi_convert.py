from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trackmesh.protocol.codec import decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import EmiGeometry, EmiOptions, EmiResult, EmiScanBatch
from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.service.convert import Head, to_coils, to_message, to_options, to_request
from trackmesh.sim.emi import random_targets, simulate, survey_geometry

GEOMETRY = survey_geometry((3.0, 3.0), 0.3)
BATCH = simulate(GEOMETRY, random_targets(1, 5), 30.0, 5).batch


def solved(batch: EmiScanBatch) -> EmiResult:
    result = next(invert(*to_request(batch, GEOMETRY, 45.0)))
    return to_message(result, Head(batch.batch_id, batch.field_unit))


def asked(**changes: Any) -> EmiScanBatch:
    return EmiScanBatch.model_validate(BATCH.model_dump() | changes)


def test_units_are_tesla_inside_and_the_clients_outside() -> None:
    in_pt = asked(field=1e3 * BATCH.field, sigma=1e3 * BATCH.sigma, field_unit="pT")  # type: ignore[operator]
    results = [solved(b) for b in (BATCH, in_pt)]
    assert results[0].sigma_used == pytest.approx(BATCH.sigma)
    assert results[1].sigma_used == pytest.approx(1e3 * results[0].sigma_used)  # type: ignore[operator]
    np.testing.assert_allclose(results[1].targets[0].position_m, results[0].targets[0].position_m, atol=1e-7)
    np.testing.assert_allclose(results[1].targets[0].tensor_m3, results[0].targets[0].tensor_m3, rtol=1e-5, atol=1e-8)


def test_an_arbitrary_unit_makes_relative_tensors() -> None:
    assert "tensor_relative" in solved(asked(field_unit="arbitrary")).reasons


def test_sigma_comes_by_component_and_by_sample() -> None:
    n = len(GEOMETRY.positions_m)
    assert to_request(asked(sigma=None), GEOMETRY, 45.0).sigma_t is None
    by_component = to_request(asked(sigma=[1.0, 2.0, 3.0]), GEOMETRY, 45.0).sigma_t
    np.testing.assert_allclose(by_component, [1e-9, 2e-9, 3e-9])  # type: ignore[arg-type]
    factor = np.linspace(1.0, 2.0, n)
    both = to_request(asked(sigma=[1.0, 2.0, 3.0], sigma_factor=factor), GEOMETRY, 45.0).sigma_t
    np.testing.assert_allclose(both, 1e-9 * factor[:, None] * [1.0, 2.0, 3.0])  # type: ignore[arg-type]
    three = asked(sigma=2.0, channel_factor=[1.0, 3.0], field=np.repeat(BATCH.field, 2, axis=1))
    by_channel = to_request(three, GEOMETRY, 45.0).sigma_t
    np.testing.assert_allclose(by_channel, [[[2e-9]], [[6e-9]]])  # type: ignore[arg-type]


def test_coils_are_those_of_the_geometry() -> None:
    coils = to_coils(GEOMETRY)
    assert coils.moment_am2 == pytest.approx(20.0 * np.pi * 0.25)
    assert coils.is_loop
    tilted = EmiGeometry.model_validate(GEOMETRY.model_dump() | {"axes": np.ones((len(GEOMETRY.positions_m), 3))})
    assert to_coils(tilted).tx_axis.shape == (len(GEOMETRY.positions_m), 3)


def test_options_are_all_passed_on() -> None:
    wanted = EmiOptions.model_validate(
        {
            "max_targets": 3, "background": "plane", "robust": False, "depth_min_m": 0.2, "depth_max_m": 3.0,
            "side": "unknown", "area_m": [-1.0, -2.0, 1.0, 2.0], "block_m": 0.1,
            "prior": {"position_m": [0.0, 0.1, -1.0], "sd_m": [0.1, 0.1, 0.5]},
        }
    )  # fmt: skip
    got = to_options(wanted, 30.0)
    assert (got.most_targets, got.background, got.robust, got.side) == (3, "plane", False, "unknown")
    assert (got.depth_min_m, got.depth_max_m, got.block_m, got.lr_threshold) == (0.2, 3.0, 0.1, 30.0)
    assert got.area_m == (-1.0, -2.0, 1.0, 2.0)
    np.testing.assert_array_equal(got.prior_m, [[0.0, 0.1, -1.0], [0.1, 0.1, 0.5]])


@pytest.mark.parametrize("fmt", ["msgpack", "json"])
def test_a_whole_answer_travels(fmt: Any) -> None:
    result = solved(asked(field=np.repeat(BATCH.field, 2, axis=1), channels=["in phase", "quadrature"]))
    back = decode(encode(result, fmt), EmiResult, encoding(result, fmt))
    (target,) = back.targets
    assert target.angles is not None and target.channel_principal_m3 is not None
    assert target.angles.covariance.shape == (len(target.angles.undefined.keys() ^ {"theta", "phi", "psi"}),) * 2
    assert back == result


def test_no_target_comes_with_a_limit() -> None:
    noise = asked(field=np.random.default_rng(1).normal(size=BATCH.field.shape), sigma=1.0)
    result = solved(noise)
    assert result.status == "no_target"
    assert result.limit is not None and (result.limit.polarizability_m3 > 0.0).all()


def test_a_geometry_is_named_by_its_content() -> None:
    again = EmiGeometry.model_validate(GEOMETRY.model_dump())
    moved = EmiGeometry.model_validate(GEOMETRY.model_dump() | {"positions_m": GEOMETRY.positions_m + 1e-9})
    assert again.content_id() == GEOMETRY.content_id() != moved.content_id()


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
        {"channel_factor": np.ones(2)},
        {"channels": ["a", "b"]},
        {"geometry": None},
        {"options": {"max_targets": 4}},
        {"options": {"max_targets": 2, "estimator": "ekf9"}},
        {"options": {"estimator": "guess"}},
        {"options": {"area_m": [0.0, 0.0, 0.0, 1.0]}},
        {"options": {"prior": {"position_m": [0.0, 0.0, 0.0], "sd_m": [0.0, 1.0, 1.0]}}},
        {"options": {"depth_min_m": 2.0, "depth_max_m": 1.0}},
        {"geometry": {"positions_m": np.zeros((0, 3)), "transmitter": {"radius_m": 0.5}}},
        {"geometry": {"positions_m": np.full((4, 3), 2e3), "transmitter": {"radius_m": 0.5}}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.5, "axis": [0.0, 0.0, 0.0]}}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.5}, "axes": np.zeros((4, 3))}},
        {"geometry": {"positions_m": np.zeros((4, 3)), "transmitter": {"radius_m": 0.0}}},
        {"geometry": GEOMETRY.model_dump() | {"attitude": np.zeros((len(GEOMETRY.positions_m), 4))}},
        {"geometry": GEOMETRY.model_dump() | {"receivers": []}},
        {"geometry": GEOMETRY.model_dump() | {"receivers": [{"components": [[0.0, 0.0, 0.0]]}]}},
        {"geometry": GEOMETRY.model_dump() | {"receivers": [{}, {}]}},
    ],
)
def test_what_does_not_fit_together_is_refused(changes: dict[str, Any]) -> None:
    from trackmesh.protocol.codec import from_object

    with pytest.raises(RefusedMessage):
        from_object(BATCH.model_dump() | changes, EmiScanBatch)
