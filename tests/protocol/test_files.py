"""The JSON-lines files: what is written is read again; what is wrong is named by file and line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.protocol.strategies import (
    VALID,
    boot_ids,
    ids,
    json_values,
    places,
    plot_batches,
    sensor_infos,
    texts,
    times_ns,
)
from tests.protocol.test_messages import PLOTS, RADAR

from trackmesh.protocol.errors import RefusedMessage, TrackmeshError
from trackmesh.protocol.files import (
    RECORD_TYPES,
    Gone,
    RecordWriter,
    RegistrationRecord,
    Tick,
    UnitRecord,
    from_line,
    read_records,
    replace_with,
    to_line,
)
from trackmesh.protocol.messages import Geodetic, Message, PlotBatch, SensorInfo
from trackmesh.protocol.messages.base import TopMessage

units = st.builds(
    UnitRecord,
    unit_id=ids,
    unit_number=st.integers(0, 4095),
    boot_id=boot_ids,
    first_track_number=st.integers(0, 2**41 - 1),
    settings=st.dictionaries(texts, json_values, max_size=3),
    registration=st.none() | st.builds(RegistrationRecord, t_ns=times_ns, state=st.just({})),
)
registrations = st.builds(RegistrationRecord, t_ns=times_ns, state=st.dictionaries(texts, json_values, max_size=3))
RECORDS: dict[type[Message], st.SearchStrategy[Any]] = {
    UnitRecord: units,
    RegistrationRecord: registrations,
    Geodetic: places,
    Tick: st.builds(Tick, t_ns=times_ns),
    Gone: st.builds(Gone, sensor_id=ids),
    **{kind: VALID[kind] for kind in RECORD_TYPES.values() if issubclass(kind, TopMessage)},
}
SENSOR_LINE = json.dumps({"type": "sensor"} | RADAR)
PLOTS_LINE = json.dumps({"type": "plots"} | PLOTS)


def wrong(path: Path, *wanted: type[Message]) -> str:
    with pytest.raises(TrackmeshError) as error:
        list(read_records(path, *wanted))
    return str(error.value)


def test_every_kind_of_line_has_a_strategy() -> None:
    assert set(RECORDS) == set(RECORD_TYPES.values())


@pytest.mark.parametrize("name", RECORD_TYPES)
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_a_line_is_read_as_it_was_written(name: str, data: st.DataObject) -> None:
    record = data.draw(RECORDS[RECORD_TYPES[name]])
    line = to_line(record)
    assert "\n" not in line
    assert next(iter(json.loads(line).items())) == ("type", name)
    assert from_line(line) == record


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.one_of(units, places, RECORDS[Tick], sensor_infos(), plot_batches()), max_size=5))
def test_a_black_box_is_read_in_its_order(tmp_path: Path, records: list[Message]) -> None:
    path = tmp_path / "box.jsonl"
    with RecordWriter(path) as box:
        for record in records:
            box.write(record)
    assert list(read_records(path)) == records
    assert list(read_records(path, *RECORD_TYPES.values())) == records


def test_a_killed_process_loses_no_line(tmp_path: Path) -> None:
    writer = RecordWriter(tmp_path / "box.jsonl")
    writer.write(Tick(t_ns=1))
    assert list(read_records(tmp_path / "box.jsonl")) == [Tick(t_ns=1)]
    writer.close()


def test_blank_lines_are_nothing_and_type_may_stand_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "plots.jsonl"
    path.write_text(f"\n{SENSOR_LINE}\n  \n{json.dumps(PLOTS | {'type': 'plots'})}")
    assert [type(record) for record in read_records(path)] == [SensorInfo, PlotBatch]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("no json", "malformed"),
        ('{"type": "tick", "t_ns": 1', "malformed"),
        ("[1, 2]", "malformed"),
        ("7", "malformed"),
        ("null", "malformed"),
        ("[" * 100_000, "malformed"),
        ('{"type":"tick","t_ns":' * 50_000, "malformed"),
        ('{"type": "tick", "t_ns": ' + "9" * 5000 + "}", "malformed"),
        ("{}", "wrong_schema"),
        ('{"t_ns": 1}', "wrong_schema"),
        ('{"type": "clock", "t_ns": 1}', "wrong_schema"),
        ('{"type": ["tick"], "t_ns": 1}', "wrong_schema"),
        ('{"type": {"a": 1}, "t_ns": 1}', "wrong_schema"),
        ('{"type": "\\ud800", "t_ns": 1}', "wrong_schema"),
        ('{"type": "tick"}', "missing_field"),
        ('{"type": "tick", "t_ns": 1, "more": 1}', "unknown_field"),
        ('{"type": "tick", "t_ns": 1, "\\ud800": 1}', "malformed"),
        ('{"type": "tick", "t_ns": -1}', "out_of_bounds"),
        ('{"type": "tick", "t_ns": ' + "9" * 30 + "}", "out_of_bounds"),
        ('{"type": "tick", "t_ns": true}', "invalid"),
        ('{"type": "tick", "t_ns": 1.0}', "invalid"),
        ('{"type": "origin", "latitude_deg": NaN, "longitude_deg": 0.0}', "not_finite"),
        ('{"type": "unit", "unit_id": "a", "unit_number": 4096, "boot_id": "b", "first_track_number": 0, '
         '"settings": {}}', "out_of_bounds"),
        ('{"type": "unit", "unit_id": "a", "unit_number": 0, "boot_id": "b", "first_track_number": 2199023255552, '
         '"settings": {}}', "out_of_bounds"),
        (PLOTS_LINE.replace("1000.0", "NaN"), "not_finite"),
        (PLOTS_LINE.replace("north", "North"), "invalid_id"),
    ],
)  # fmt: skip
def test_a_wrong_line_is_named_with_its_reason(tmp_path: Path, line: str, reason: str) -> None:
    with pytest.raises(RefusedMessage) as error:
        from_line(line)
    assert error.value.reason == reason
    path = tmp_path / "plots.jsonl"
    path.write_text(f"{SENSOR_LINE}\n\n{line}\n{PLOTS_LINE}\n")
    sentence = wrong(path)
    assert sentence.startswith(f"{path}, line 3: ") and sentence.endswith(f" [{reason}]")
    assert "\n" not in sentence


def test_lines_before_a_wrong_one_are_read(tmp_path: Path) -> None:
    path = tmp_path / "plots.jsonl"
    path.write_text(f"{SENSOR_LINE}\nnothing\n")
    records = read_records(path)
    assert isinstance(next(records), SensorInfo)
    with pytest.raises(TrackmeshError, match="line 2"):
        next(records)


def test_a_line_that_is_not_wanted_is_named(tmp_path: Path) -> None:
    path = tmp_path / "plots.jsonl"
    path.write_text(f"{SENSOR_LINE}\n{PLOTS_LINE}\n")
    assert wrong(path, SensorInfo, Tick) == (f"{path}, line 2: a line of type sensor or tick is expected, not plots.")


def test_files_that_cannot_be_read_are_one_sentence(tmp_path: Path) -> None:
    assert wrong(tmp_path / "none.jsonl") == f"Cannot read {tmp_path / 'none.jsonl'}: No such file or directory."
    assert wrong(tmp_path) == f"Cannot read {tmp_path}: Is a directory."
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    assert wrong(tmp_path / "binary") == f"{tmp_path / 'binary'} is not a text file."
    with pytest.raises(TrackmeshError, match=r"Cannot write .*: No such file or directory\."):
        RecordWriter(tmp_path / "none" / "box.jsonl")


def test_a_file_of_one_record_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "one.jsonl"
    for t_ns in (1, 2):
        replace_with(path, Tick(t_ns=t_ns))
        assert list(read_records(path)) == [Tick(t_ns=t_ns)]
    assert [one.name for one in tmp_path.iterdir()] == ["one.jsonl"]
    with pytest.raises(TrackmeshError, match="Cannot write"):
        replace_with(tmp_path / "nowhere" / "one.jsonl", Tick(t_ns=3))
