"""Every message: equal to itself after the wire and after JSON, strict about fields, axes, numbers and versions."""

from __future__ import annotations

import json
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.protocol.strategies import VALID, messages, plot_batches

from trackmesh.protocol.codec import Format, decode, encode, encoding
from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import (
    MESSAGES,
    EmiResult,
    EmiScanBatch,
    Geodetic,
    HistoryQuery,
    PlotBatch,
    RangeBatch,
    ScanPart,
    SensorInfo,
    TagFrame,
    TrackFrame,
    TrackQuery,
    TruthFrame,
)
from trackmesh.protocol.messages.base import TopMessage
from trackmesh.protocol.messages.plots import COLUMN_BOUNDS, COLUMN_SETS, MAX_PLOTS

T_NS = 1_700_000_000_000_000_000
PLOTS: dict[str, Any] = {
    "sensor_id": "north",
    "boot_id": "b1",
    "seq": 7,
    "t_ns": [T_NS, T_NS + 1],
    "columns": ["range_m", "azimuth_rad"],
    "values": [[1000.0, 0.5], [2000.0, 1.5]],
}
RADAR: dict[str, Any] = {
    "sensor_id": "north",
    "kind": "radar",
    "site_enu_m": [0.0, 0.0, 0.0],
    "period_s": 4.0,
    "p_detect": 0.9,
    "max_range_m": 1e5,
    "sigma": {"range_m": 50.0, "azimuth_rad": 1e-3},
}
TRUTH: dict[str, Any] = {"scenario_id": "s", "t_ns": 1, "id": [1], "state": [[0.0, 0.0, 0.0, 0.0]]}
TAGS: dict[str, Any] = {
    "unit_id": "main",
    "boot_id": "b",
    "seq": 0,
    "t_ns": 1,
    "tag_id": ["t"],
    "status": [1],
    "state": [[0.0] * 6],
    "covariance": [[1.0] * 21],
    "quality": [1.0],
    "certainty": [1.0],
    "other": [[0.0, 0.0]],
    "readers": ["r"],
    "used": [[0, 0]],
    "updated_t_ns": [1],
}
RANGES: dict[str, Any] = {
    "network_id": "hall",
    "boot_id": "b",
    "seq": 0,
    "t_ns": [1],
    "tags": ["t"],
    "readers": ["r"],
    "tag": [0],
    "reader": [0],
    "range_m": [1.0],
}
EMI: dict[str, Any] = {
    "batch_id": "area",
    "geometry": {"positions_m": [[0.0, 0.0, 0.0]], "transmitter": {"radius_m": 0.5}},
    "field": [[[[1.0, 2.0, 3.0]]]],
    "field_unit": "nT",
}
RESULT: dict[str, Any] = {"batch_id": "area", "index": 0, "status": "ok"}


def refusal(kind: type[TopMessage], fields: dict[str, Any]) -> RefusedMessage:
    """Refused the same way as msgpack and as JSON."""
    with pytest.raises(RefusedMessage) as packed:
        decode(msgpack.packb(fields), kind)
    try:
        text = json.dumps(fields).encode()
    except TypeError:
        return packed.value
    with pytest.raises(RefusedMessage) as written:
        decode(text, kind, "application/json")
    assert written.value.reason == packed.value.reason
    return packed.value


def changed(fields: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """The fields with the one at ``a.b`` replaced; ``...`` removes it."""
    first, _, rest = path.partition(".")
    new = dict(fields)
    if rest:
        new[first] = changed(new.get(first, {}), rest, value)
    elif value is ...:
        del new[first]
    else:
        new[first] = value
    return new


# --- what is valid


@pytest.mark.parametrize("kind", list(VALID), ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("fmt", ["msgpack", "json"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], deadline=None)
@given(data=st.data())
def test_every_message_survives_the_way_there(kind: type[TopMessage], fmt: Format, data: st.DataObject) -> None:
    message = data.draw(VALID[kind])
    there = decode(encode(message, fmt), kind, encoding(message, fmt))
    assert there == message
    assert encode(there, fmt) == encode(message, fmt)


@settings(max_examples=50, deadline=None)
@given(messages)
def test_arrays_are_read_only_in_memory_and_after_the_wire(message: TopMessage) -> None:
    for one in (
        message,
        decode(encode(message), type(message)),
        decode(encode(message, "json"), type(message), encoding(message, "json")),
    ):
        found = [value for value in vars(one).values() if isinstance(value, np.ndarray)]
        assert not any(array.flags.writeable for array in found)


@given(plot_batches())
def test_a_message_cannot_be_changed(batch: PlotBatch) -> None:
    with pytest.raises(ValidationError):
        batch.seq = 3  # type: ignore[misc]


def test_an_empty_batch_knows_its_columns_however_it_came() -> None:
    empty = changed(changed(PLOTS, "t_ns", []), "values", [])
    for columns in COLUMN_SETS:
        batch = decode(json.dumps(changed(empty, "columns", list(columns))).encode(), PlotBatch, "application/json")
        assert batch.values.shape == (0, len(columns))


def test_what_has_a_default_may_be_left_out() -> None:
    assert decode(b"\x80", TrackQuery) == TrackQuery()
    batch = decode(msgpack.packb(PLOTS), PlotBatch)
    assert (batch.schema_version, batch.variances, batch.labels, batch.scan) == (1, None, None, None)


def test_the_schema_names_are_those_of_the_classes() -> None:
    assert {name: f"trackmesh.{kind.__name__}.v1" for name, kind in MESSAGES.items()} == {
        name: name for name in MESSAGES
    }


def test_covariances_are_unpacked_row_by_row() -> None:
    one = TrackFrame(
        unit_id="u", boot_id="b", seq=0, t_ns=0, track_id=[1], epoch=[0], status=[1], state=[[0.0] * 6],
        covariance=[[float(i) for i in range(21)]], model_probability=[[1.0]], models=["cv"], sensors=[], members=[[]],
        updated_t_ns=[0], first_t_ns=[0],
    )  # fmt: skip
    (full,) = one.covariance_matrices()
    assert full[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert full[1, 1:].tolist() == [6, 7, 8, 9, 10]
    assert (full == full.T).all()


# --- what is not


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("surprise", 1, "unknown_field"),
        ("scan", {"index": 0, "sector": 0, "sectors": 1, "more": 1}, "unknown_field"),
        ("seq", ..., "missing_field"),
        ("values", ..., "missing_field"),
        ("scan", {"index": 0, "sector": 0}, "missing_field"),
        ("schema_version", 2, "wrong_version"),
        ("schema_version", 0, "wrong_version"),
        ("schema_version", True, "wrong_version"),
        ("schema_version", 1.0, "wrong_version"),
        ("schema_version", "1", "wrong_version"),
        ("schema_version", None, "wrong_version"),
        ("sensor_id", "North", "invalid_id"),
        ("sensor_id", "", "invalid_id"),
        ("sensor_id", "a/b", "invalid_id"),
        ("sensor_id", "north\n", "invalid_id"),
        ("sensor_id", "a" * 65, "invalid_id"),
        ("sensor_id", 7, "invalid"),
        ("boot_id", "with blank", "invalid_id"),
        ("seq", True, "invalid"),
        ("seq", 7.0, "invalid"),
        ("seq", "7", "invalid"),
        ("seq", -1, "out_of_bounds"),
        ("seq", 2**63, "out_of_bounds"),
        ("t_ns", [T_NS], "wrong_length"),
        ("t_ns", [T_NS] * 3, "wrong_length"),
        ("t_ns", [-1, 0], "out_of_bounds"),
        ("t_ns", [float(T_NS)] * 2, "wrong_dtype"),
        ("t_ns", [True, 2], "wrong_dtype"),
        ("t_ns", "now", "wrong_type"),
        ("values", [[1.0, 0.5, 0.1], [2.0, 0.5, 0.1]], "wrong_length"),
        ("values", [[1.0], [2.0]], "wrong_length"),
        ("values", [[1.0, 0.5], [2.0]], "wrong_length"),
        ("values", [1.0, 0.5], "wrong_length"),
        ("values", [[[1.0, 0.5]], [[1.0, 0.5]]], "wrong_length"),
        ("values", [[True, 0.5], [2.0, 0.5]], "wrong_dtype"),
        ("values", [["1.0", 0.5], [2.0, 0.5]], "wrong_dtype"),
        ("values", [[None, 0.5], [2.0, 0.5]], "wrong_dtype"),
        ("columns", ["azimuth_rad", "range_m"], "invalid"),
        ("columns", ["range_m", "speed"], "invalid"),
        ("columns", ["range_m"], "wrong_length"),
        ("columns", "range_m", "invalid"),
        ("variances", [[1.0, 1e-6]], "wrong_length"),
        ("variances", [[0.0, 1e-6]] * 2, "out_of_bounds"),
        ("variances", [[1.0, 2e18]] * 2, "out_of_bounds"),
        ("variances", [[1.0, 10.0]] * 2, "out_of_bounds"),
        ("labels", ["one"], "wrong_length"),
        ("labels", ["one", "x" * 65], "wrong_length"),
        ("labels", [1, 2], "invalid"),
        ("scan", {"index": 0, "sector": 4, "sectors": 4}, "out_of_bounds"),
        ("scan", {"index": -1, "sector": 0, "sectors": 4}, "out_of_bounds"),
        ("scan", 3, "invalid"),
        ("site", {"latitude_deg": 91.0, "longitude_deg": 0.0}, "out_of_bounds"),
        ("site_enu_m", [0.0, 0.0], "wrong_length"),
        ("site_enu_m", [0.0, 0.0, 1e300], "out_of_bounds"),
        ("site_enu_m", [0.0, 0.0, np.nan], "not_finite"),
        ("site_velocity_enu_mps", [1.0, 0.0, 0.0], "missing_field"),
    ],
)  # fmt: skip
def test_a_batch_of_plots_is_refused_with_its_reason(path: str, value: Any, reason: str) -> None:
    assert refusal(PlotBatch, changed(PLOTS, path, value)).reason == reason


MOVING = PLOTS | {"site_enu_m": [1.0, 2.0, 3.0], "site_velocity_enu_mps": [8.0, 0.0, 0.0]}


def test_a_batch_says_where_its_sensor_stood_in_one_way() -> None:
    place = {"latitude_deg": 1.0, "longitude_deg": 2.0}
    assert refusal(PlotBatch, MOVING | {"site": place}).reason == "invalid"
    assert refusal(PlotBatch, MOVING | {"site_velocity_enu_mps": [2e5, 0.0, 0.0]}).reason == "out_of_bounds"
    moving = decode(msgpack.packb(MOVING), PlotBatch)
    assert (moving.site_enu_m, moving.site_velocity_enu_mps) == ([1.0, 2.0, 3.0], [8.0, 0.0, 0.0])
    geodetic = changed(MOVING, "site_enu_m", ...) | {"site": place}
    assert decode(msgpack.packb(geodetic), PlotBatch).site == Geodetic(latitude_deg=1.0, longitude_deg=2.0)


def test_a_batch_of_a_sensor_that_knows_nothing_of_moving_is_one_of_a_sensor_at_rest() -> None:
    old = decode(msgpack.packb(PLOTS), PlotBatch)
    assert (old.site, old.site_enu_m, old.site_velocity_enu_mps) == (None, None, None)


@pytest.mark.parametrize(("columns", "i"), [(columns, i) for columns in COLUMN_SETS for i in range(len(columns))])
def test_every_column_has_its_bounds(columns: tuple[str, ...], i: int) -> None:
    low, high = COLUMN_BOUNDS[columns[i]]
    good = np.zeros((3, len(columns)))
    for value, fits in (
        (low, True), (high, True), (np.nextafter(low, -np.inf), False), (np.nextafter(high, np.inf), False),
    ):  # fmt: skip
        good[1, i] = value
        fields = PLOTS | {"columns": list(columns), "values": good.tolist(), "t_ns": [1, 1, 1]}
        if fits:
            decode(msgpack.packb(fields), PlotBatch)
        else:
            error = refusal(PlotBatch, fields)
            assert (error.reason, columns[i] in error.detail) == ("out_of_bounds", True)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_refused(value: float) -> None:
    assert refusal(PlotBatch, PLOTS | {"values": [[value, 0.5], [1.0, 0.5]]}).reason == "not_finite"
    assert refusal(PlotBatch, PLOTS | {"variances": [[1.0, 1e-6], [1.0, value]]}).reason == "not_finite"
    assert refusal(SensorInfo, RADAR | {"period_s": value}).reason == "not_finite"
    assert refusal(SensorInfo, RADAR | {"sigma": {"range_m": value}}).reason == "not_finite"
    assert refusal(TrackQuery, {"bbox_enu_m": [0.0, 0.0, value, 1.0]}).reason == "not_finite"


def test_a_batch_has_a_largest_number_of_plots() -> None:
    def fields(n: int) -> dict[str, Any]:
        return PLOTS | {"t_ns": [1] * n, "values": [[1.0, 0.5]] * n}

    assert len(decode(msgpack.packb(fields(MAX_PLOTS)), PlotBatch).t_ns) == MAX_PLOTS
    assert refusal(PlotBatch, fields(MAX_PLOTS + 1)).reason == "too_large"


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("site_enu_m", ..., "missing_field"),
        ("site", {"latitude_deg": 0.0, "longitude_deg": 0.0}, "invalid"),
        ("site", {"latitude_deg": 91.0, "longitude_deg": 0.0}, "out_of_bounds"),
        ("site_enu_m", [0.0, 0.0], "wrong_length"),
        ("site_enu_m", [1e300, 0.0, 0.0], "out_of_bounds"),
        ("kind", "sonar", "invalid"),
        ("period_s", 0.0, "out_of_bounds"),
        ("period_s", 1e300, "out_of_bounds"),
        ("period_s", True, "invalid"),
        ("max_range_m", 1e300, "out_of_bounds"),
        ("max_range_m", 1e-300, "out_of_bounds"),
        ("p_detect", 0.0, "out_of_bounds"),
        ("p_detect", 1.1, "out_of_bounds"),
        ("clutter_density", 1e300, "out_of_bounds"),
        ("sigma", {"range_m": 1e300}, "out_of_bounds"),
        ("sigma", {"azimuth_rad": 4.0}, "out_of_bounds"),
        ("sigma", {"speed": 1.0}, "invalid"),
        ("sigma", {"schema_version": 0.0}, "out_of_bounds"),
        ("interference", {"speed": 1.0}, "invalid"),
        ("interference", {"range_m": -1.0}, "out_of_bounds"),
    ],
)
def test_a_sensor_is_refused_with_its_reason(path: str, value: Any, reason: str) -> None:
    assert refusal(SensorInfo, changed(RADAR, path, value)).reason == reason


def test_a_position_sensor_needs_no_site() -> None:
    decode(msgpack.packb(changed(RADAR, "site_enu_m", ...) | {"kind": "position"}), SensorInfo)


@pytest.mark.parametrize(
    ("kind", "fields", "reason"),
    [
        (TruthFrame, changed(TRUTH, "state", [[0.0] * 5]), "wrong_length"),
        (TruthFrame, changed(TRUTH, "state", []), "wrong_length"),
        (RangeBatch, changed(RANGES, "tag", [1]), "out_of_bounds"),
        (RangeBatch, changed(RANGES, "reader", [-1]), "out_of_bounds"),
        (RangeBatch, changed(RANGES, "tags", ["T"]), "invalid_id"),
        (RangeBatch, changed(RANGES, "tags", ["t"] * 20_001), "wrong_length"),
        (RangeBatch, changed(RANGES, "range_m", None), "missing_field"),
        (RangeBatch, changed(RANGES, "rssi_dbm", [-60.0]), "missing_field"),
        (RangeBatch, changed(RANGES, "range_m", [2e6]), "out_of_bounds"),
        (RangeBatch, RANGES | {"range_m": None, "rssi_dbm": [-60.0], "variance_m2": [1.0]}, "invalid"),
        (RangeBatch, RANGES | {"range_m": None, "rssi_dbm": [101.0]}, "out_of_bounds"),
        (TagFrame, changed(TAGS, "used", [[1, 0]]), "out_of_bounds"),
        (TagFrame, changed(TAGS, "used", [[0, 1]]), "out_of_bounds"),
        (TagFrame, changed(TAGS, "quality", [1.5]), "out_of_bounds"),
        (TagFrame, changed(TAGS, "other", [[0.0, 0.0, 0.0]]), "wrong_length"),
        (TrackQuery, {"track_ids": [2**53 + 1]}, "out_of_bounds"),
        (TrackQuery, {"track_ids": [-1]}, "out_of_bounds"),
        (TrackQuery, {"track_ids": [True]}, "invalid"),
        (TrackQuery, {"status": [4]}, "out_of_bounds"),
        (TrackQuery, {"bbox_deg": [0.0, 0.0, 1.0]}, "wrong_length"),
        (TrackQuery, {"max_age_s": -1.0}, "out_of_bounds"),
        (HistoryQuery, {"from_t_ns": 2, "to_t_ns": 1}, "invalid"),
        (HistoryQuery, {}, "missing_field"),
        (EmiScanBatch, changed(EMI, "field", [[[[1.0, 2.0]]]]), "wrong_length"),
        (EmiScanBatch, changed(EMI, "field", [[[[1.0, 2.0, 3.0]] * 2]]), "wrong_length"),
        (EmiScanBatch, changed(EMI, "field", []), "wrong_length"),
        (EmiScanBatch, changed(EMI, "field", [[[["1", 2.0, 3.0]]]]), "wrong_dtype"),
        (EmiScanBatch, changed(EMI, "field", [[[[True, 2.0, 3.0]]]]), "wrong_dtype"),
        (EmiScanBatch, changed(EMI, "field_unit", "gauss"), "invalid"),
        (EmiScanBatch, changed(EMI, "geometry.positions_m", []), "wrong_length"),
        (EmiScanBatch, changed(EMI, "geometry.positions_m", [[0.0, 0.0, 2e3]]), "out_of_bounds"),
        (EmiScanBatch, changed(EMI, "geometry.transmitter.axis", [0.0, 0.0, 0.0]), "invalid"),
        (EmiScanBatch, changed(EMI, "geometry.axes", [[0.0, 0.0, 0.0]]), "invalid"),
        (EmiScanBatch, changed(EMI, "sigma_factor", [1.0]), "missing_field"),
        (EmiScanBatch, changed(EMI, "sigma", [1.0, 1.0]), "wrong_length"),
        (EmiScanBatch, changed(EMI, "options.depth_max_m", 0.01), "out_of_bounds"),
        (EmiResult, changed(RESULT, "n_used", -1), "out_of_bounds"),
        (EmiResult, changed(RESULT, "dof", 2**63), "out_of_bounds"),
        (EmiResult, changed(RESULT, "p_value", 1.5), "out_of_bounds"),
        (EmiResult, changed(RESULT, "status", "fine"), "invalid"),
    ],
)  # fmt: skip
def test_other_messages_are_refused_with_their_reason(
    kind: type[TopMessage], fields: dict[str, Any], reason: str
) -> None:
    assert refusal(kind, fields).reason == reason


def test_a_field_of_a_scan_may_have_gaps() -> None:
    batch = decode(json.dumps(changed(EMI, "field", [[[[None, 2.0, 3]]]])).encode(), EmiScanBatch, "application/json")
    assert np.isnan(batch.field).tolist() == [[[[True, False, False]]]]
    assert b"null" in encode(batch, "json")
    endless = np.array([[[[np.inf, -np.inf, 3.0]]]])
    fields = EMI | {"field": {"dtype": "<f8", "shape": [1, 1, 1, 3], "data": endless.tobytes()}}
    assert np.isnan(decode(msgpack.packb(fields), EmiScanBatch).field).tolist() == [[[[True, True, False]]]]


def test_a_sector_is_one_of_its_scan() -> None:
    assert ScanPart(index=0, sector=3, sectors=4).sector == 3


@pytest.mark.parametrize(
    ("field", "shape"), [("values", [0, 7]), ("values", [0, 3]), ("variances", [0, 3]), ("t_ns", [0, 2])]
)
def test_an_array_without_rows_has_the_axes_of_its_message(field: str, shape: list[int]) -> None:
    empty = {"dtype": "<i8" if field == "t_ns" else "<f8", "shape": shape, "data": b""}
    fields = PLOTS | {"t_ns": [], "values": []} | {field: empty}
    assert refusal(PlotBatch, fields).reason == "wrong_length"
