"""Words of the tables that people read."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table
from tests.protocol.builders import frame

from trackmesh.protocol.messages import UNKNOWN_HEIGHT_M2, SensorBias, SensorHealth, ServiceStatus
from trackmesh.services.cli.tables import bias_text, degraded_lines, status_table, track_table


def text(table: Table) -> str:
    console = Console(width=160)
    with console.capture() as shown:
        console.print(table)
    return shown.get()


def test_heights_have_a_column_where_there_are_any() -> None:
    plain = frame([1])
    high = frame([2, 3], unit="other").model_copy(
        update={"height_m": np.array([8012.4, 0.0]), "height_variance_m2": np.array([1225.0, UNKNOWN_HEIGHT_M2])}
    )
    assert "height" not in text(track_table([plain]))
    shown = text(track_table([plain, high]))
    assert "height m" in shown and "8012 ± 35" in shown
    assert sum("│ " in line and " - " in line for line in shown.splitlines()) == 2


def test_inputs_are_told_in_tracks_and_frames_and_sensors_in_plots_and_batches() -> None:
    heard = [SensorHealth(sensor_id=s, alive=True, plots=7, batches=3, gaps=0, duplicates=0, refused=1) for s in "ab"]
    status = ServiceStatus(
        kind="fusion", unit_id="main", boot_id="x", seq=0, t_ns=0, state="ready", uptime_s=1.0,
        figures={"input_tracks.b": 4.0}, sensors=heard,
    )  # fmt: skip
    shown = text(status_table([status]))
    assert "7 plots, 3 batches, 0 missing, 1 refused" in shown and "7 tracks, 3 frames, 0 missing, 1 refused" in shown


def test_silence_and_clocks_of_sensors_are_shown_and_what_is_missing_is_told() -> None:
    counts = dict.fromkeys(("plots", "batches", "gaps", "duplicates", "refused"), 0)
    heard = [
        SensorHealth(sensor_id="a", alive=False, silent_since_ns=5, last_t_ns=10**9, **counts),
        SensorHealth(sensor_id="b", alive=True, clock_offset_s=0.31, clock_drift_ppm=-120.0, **counts),
    ]
    status = ServiceStatus(
        kind="fusion", unit_id="main", boot_id="x", seq=0, t_ns=4 * 10**9, state="ready", uptime_s=1.0, sensors=heard,
        degraded=["Sensor a is silent since 12:00:00 UTC: not alive: process, host or link is down."],
    )  # fmt: skip
    shown = text(status_table([status]))
    assert "gone, silent" in shown and "3.0" in shown and "clock +0.31 s, -120 ppm" in shown
    assert degraded_lines([status]) == [f"fusion main: {status.degraded[0]}"]


def test_a_bias_is_told_with_its_error_and_in_brackets_where_it_is_not_applied() -> None:
    bias = SensorBias(
        sensor_id="north",
        columns=["range_m", "azimuth_rad"],
        bias=np.array([148.3, np.deg2rad(0.391)]),
        covariance=np.diag([81.0, np.deg2rad(0.01) ** 2]),
        locked=True,
        pairs=5,
        jumps=0,
    )
    assert bias_text(bias) == "range 148 ± 9 m, azimuth 0.39 ± 0.01 deg"
    assert bias_text(bias.model_copy(update={"locked": False})) == "(range 148 ± 9 m, azimuth 0.39 ± 0.01 deg)"
