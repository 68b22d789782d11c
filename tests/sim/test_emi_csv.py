from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import EmiOptions, EmiReceiver, EmiTransmitter
from trackmesh.services.emi.sensor import rotations
from trackmesh.sim.emi_csv import Columns, Setup, quaternions, read_log

SETUP = Setup(EmiTransmitter(radius_m=0.5), [EmiReceiver()], "nT", None, EmiOptions())
PLAIN = Columns("x", "y", None, (("bx", "by", "bz"),))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "Field 3.csv"
    path.write_text(
        "\ufeffx, y, h, line, bx,by,bz, qx,qy,qz, yaw\n"
        "500000.5, 4100000, 0.1, A, 1,2,3, .1,.2,.3, 90\n"
        "500001.5, 4100000, 0.2, A, 4,,6, .4,.5,.6, 90\n"
        ", 4100001, 0.2, A, 4,5,6, .4,.5,.6, 90\n"
        "500002.5, 4100001, 0.1, B, 7,bad,9, .7,.8,.9, 0\n"
    )
    return path


def test_rows_are_samples_and_large_places_lose_their_origin(log: Path) -> None:
    found = read_log(log, PLAIN, SETUP)
    (batch,) = found.batches
    assert batch.batch_id == "field-3"
    assert batch.geometry is not None
    assert found.origin_m.tolist() == [500000.0, 4100000.0]
    np.testing.assert_allclose(batch.geometry.positions_m, np.array([[0.5, 0, 0], [1.5, 0, 0], [2.5, 1, 0]]))
    np.testing.assert_allclose(batch.field[0, 0], np.array([[1, 2, 3], [4, np.nan, 6], [7, np.nan, 9]]))
    assert found.without_place == 1


def test_scans_channels_heights_and_headings_have_their_columns(log: Path) -> None:
    columns = Columns("x", "y", "h", (("bx", "by", "bz"), ("qx", "qy", "qz")), "line", "yaw")
    a, b = read_log(log, columns, SETUP).batches
    assert [a.batch_id, b.batch_id] == ["field-3-a", "field-3-b"]
    assert a.field.shape == (1, 2, 2, 3) and b.field.shape == (1, 2, 1, 3)
    assert a.channels == ["bx+by+bz", "qx+qy+qz"]
    assert a.geometry is not None and a.geometry.attitude is not None
    assert a.geometry.positions_m[:, 2].tolist() == [0.1, 0.2]
    # A sensor that heads east has its nose, its own y axis, towards x.
    np.testing.assert_allclose(rotations(a.geometry.attitude)[0] @ [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], atol=1e-12)


def test_nose_up_and_right_side_down() -> None:
    up, down = np.array([10.0, 0.0]), np.array([0.0, 10.0])
    turn = rotations(quaternions(np.zeros(2), up, down))
    assert (turn[0] @ [0.0, 1.0, 0.0])[2] == pytest.approx(np.sin(np.radians(10.0)))
    assert (turn[1] @ [1.0, 0.0, 0.0])[2] == pytest.approx(-np.sin(np.radians(10.0)))


def test_several_receivers_take_the_columns_in_turn(log: Path) -> None:
    several = SETUP._replace(receivers=[EmiReceiver(), EmiReceiver(offset_m=[0.0, 0.5, 0.0], components="z")])
    (batch,) = read_log(log, Columns("x", "y", None, (("bx", "by", "bz", "qz"),)), several).batches
    assert batch.geometry is not None and batch.geometry.n_components == 4
    assert batch.field[0, 0, 0].tolist() == [1.0, 2.0, 3.0, 0.3]


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        (Columns("x", "y", "height", (("bx", "by", "bz"),)), "no column 'height'; it has x, y, h,"),
        (Columns("x", "y", None, (("bx", "by"),)), r"A channel has 2 columns \(bx, by\), where the receivers give 3"),
        (Columns("line", "y", None, (("bx", "by", "bz"),)), "no row with a place"),
    ],
)
def test_what_does_not_fit_is_told(log: Path, columns: Columns, sentence: str) -> None:
    with pytest.raises(TrackmeshError, match=sentence):
        read_log(log, columns, SETUP)


def test_a_log_of_a_whole_county_is_no_scan(log: Path) -> None:
    log.write_text("x,y,bx,by,bz\n0,0,1,2,3\n50000,0,1,2,3\n")
    with pytest.raises(TrackmeshError, match="positions_m"):
        read_log(log, PLAIN, SETUP)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"x,y,bx,by,bz\n"])
def test_an_empty_or_binary_file_is_told(log: Path, content: bytes) -> None:
    log.write_bytes(content)
    with pytest.raises(TrackmeshError):
        read_log(log, PLAIN, SETUP)
    with pytest.raises(TrackmeshError, match="Cannot read"):
        read_log(log.with_name("none.csv"), PLAIN, SETUP)


def test_scans_of_one_name_get_ids_of_their_own(log: Path) -> None:
    log.write_text("x,y,s,bx,by,bz\n0,0,é,1,2,3\n1,0,è,1,2,3\n")
    batches = read_log(log, Columns("x", "y", None, (("bx", "by", "bz"),), "s"), SETUP).batches
    assert len({batch.batch_id for batch in batches}) == 2
