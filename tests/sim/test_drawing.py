from __future__ import annotations

import builtins
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import Geodetic, Message, PlotBatch, SensorInfo, TrackFrame
from trackmesh.sim.drawing import PlotScene, draw_tracks, ellipse, magnification, short_names, track_paths
from trackmesh.sim.plane import geodetic_to_enu
from trackmesh.sim.radar import sensor_info
from trackmesh.sim.recording import recorded_batches, recorded_truth
from trackmesh.sim.scenario import Scenario
from trackmesh.sim.scoring import picture
from trackmesh.sim.truth import make_truth

MakeFrame = Callable[..., TrackFrame]
ORIGIN = Geodetic(latitude_deg=48.0, longitude_deg=11.0)


def followed(scenario: Scenario, frame: MakeFrame) -> list[TrackFrame]:
    truth, frames = make_truth(scenario, 1), []
    for t_s in np.arange(10.0, 41.0, 2.0):
        ids, states = truth.state_at(t_s)
        frames.append(frame(t_s, ids, states, status=1 + (ids + t_s // 10) % 7 // 6))
    return frames


def test_a_whole_picture_is_drawn(tmp_path: Path, two_radars: Scenario, frame: MakeFrame) -> None:
    out = tmp_path / "tracks.png"
    plots: list[Message] = [two_radars.origin, *(sensor_info(two_radars, r) for r in two_radars.radars)]
    plots += recorded_batches(two_radars, 1, duration_s=40.0)
    draw_tracks(followed(two_radars, frame), recorded_truth(two_radars, 1, duration_s=40.0), plots, out=out)
    pixels = imread(out)
    assert min(pixels.shape[:2]) > 1000
    assert len(np.unique(pixels[::3, ::3, :3].reshape(-1, 3), axis=0)) > 500


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_tracks_alone_can_be_drawn_in_other_formats(tmp_path: Path, frame: MakeFrame, suffix: str) -> None:
    out = tmp_path / f"tracks.{suffix}"
    draw_tracks([frame(0.0, [1], [[1e3, 0.0, 0.0, 0.0]])], out=out)
    assert out.stat().st_size > 1000


def test_mistakes_are_one_sentence(tmp_path: Path, frame: MakeFrame) -> None:
    one = [frame(0.0, [1], np.zeros((1, 4)))]
    with pytest.raises(TrackmeshError, match="nothing to draw"):
        draw_tracks([frame(0.0, [1], np.zeros((1, 4)), status=[0])], out=tmp_path / "a.png")
    with pytest.raises(TrackmeshError, match="Cannot write"):
        draw_tracks(one, out=tmp_path / "no" / "a.png")
    with pytest.raises(TrackmeshError, match="Cannot draw into"):
        draw_tracks(one, out=tmp_path / "a.nothing")


def test_without_matplotlib_one_sentence_says_what_to_do(
    tmp_path: Path, frame: MakeFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_import = builtins.__import__

    def no_matplotlib(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_matplotlib)
    with pytest.raises(TrackmeshError, match=r"pip install 'trackmesh\[studies\]'"):
        draw_tracks([frame(0.0, [1], np.zeros((1, 4)))], out=tmp_path / "a.png")


def test_paths_tell_coasting_and_keep_the_last_frame(frame: MakeFrame) -> None:
    frames = [
        frame(float(k), [1, 2], [[k * 1e3, 0, 0, 0], [0, k * 1e3, 0, 0]], status=[1 + (k > 1500), k > 3])
        for k in range(2000)
    ]
    paths = track_paths(frames)
    assert set(paths) == {1, 2}
    assert 300 < len(paths[1].t_s) <= 800
    assert paths[1].t_s[-1] == pytest.approx(1999.0)
    assert paths[1].km[-1].tolist() == [1999.0, 0.0]
    np.testing.assert_array_equal(paths[1].coasting, paths[1].t_s > 1500)
    assert track_paths([]) == {}


def test_the_ellipse_of_a_covariance() -> None:
    assert ellipse(np.diag([9.0, 4.0]), 2.0) == pytest.approx((12.0, 8.0, 0.0)) or ellipse(
        np.diag([9.0, 4.0]), 2.0
    ) == pytest.approx((12.0, 8.0, 180.0))
    turned = np.array([[1.0, 0.8], [0.8, 1.0]])
    width, height, angle = ellipse(turned, 1.0)
    assert (width, height) == pytest.approx((2 * np.sqrt(1.8), 2 * np.sqrt(0.2)))
    assert np.mod(angle, 180.0) == pytest.approx(45.0)


def test_small_ellipses_are_magnified(frame: MakeFrame) -> None:
    shown = picture(frame(0.0, [1, 2, 3], np.zeros((3, 4)), sigma_m=100.0))
    assert magnification(shown, 10.0) == 1
    assert magnification(shown, 100.0) == 5
    assert magnification(picture(frame(0.0, [], np.zeros((0, 4)))), 100.0) == 1


@pytest.mark.parametrize(
    ("ids", "names"),
    [
        ([7], ["7"]),
        ([3 << 41 | 5, 3 << 41 | 12], ["05", "12"]),
        ([157852800000, 157852800041, 157852800123], ["000", "041", "123"]),
        ([157852800001, 157852800002], ["01", "02"]),
        ([], []),
    ],
)
def test_long_track_numbers_are_shortened_to_what_differs(ids: list[int], names: list[str]) -> None:
    assert list(short_names(ids).values()) == names


def batch(columns: list[str], values: list[list[float]]) -> PlotBatch:
    return PlotBatch(
        sensor_id="s",
        boot_id="b",
        seq=0,
        t_ns=np.zeros(len(values), np.int64),
        columns=columns,
        values=np.array(values),
    )


def info(kind: str, **site: Any) -> SensorInfo:
    return SensorInfo.model_validate(
        {"sensor_id": "s", "kind": kind, "period_s": 1, "p_detect": 0.9, "max_range_m": 1e5, "sigma": {}} | site
    )


@pytest.mark.parametrize(
    ("records", "expected_km"),
    [
        ([info("position"), batch(["east_m", "north_m"], [[1e3, 2e3]])], [[1.0, 2.0]]),
        (
            [info("radar", site_enu_m=[1e3, 0.0, 0.0]), batch(["range_m", "azimuth_rad"], [[2e3, np.pi / 2]])],
            [[3.0, 0.0]],
        ),
        (
            [ORIGIN, info("radar", site=ORIGIN), batch(["range_m", "azimuth_rad"], [[2e3, 0.0]])],
            [[0.0, 2.0]],
        ),
        (
            [ORIGIN, info("position"), batch(["latitude_deg", "longitude_deg"], [[48.1, 11.2]])],
            geodetic_to_enu(np.array([[48.1, 11.2, 0.0]]), ORIGIN)[:, :2] / 1e3,
        ),
    ],
)
def test_plots_of_every_kind_find_their_place(records: list[Message], expected_km: Any) -> None:
    np.testing.assert_allclose(np.concatenate(PlotScene.read(records).plots_km), expected_km, atol=1e-9)


@pytest.mark.parametrize(
    ("records", "sentence"),
    [
        ([batch(["east_m", "north_m"], [[0.0, 0.0]])], "before it has said who it is"),
        ([info("radar", site=ORIGIN)], "holds no origin"),
        ([info("position"), batch(["range_m", "azimuth_rad"], [[1.0, 0.0]])], "has no site"),
        ([info("position"), batch(["latitude_deg", "longitude_deg"], [[48.0, 11.0]])], "holds no origin"),
    ],
)
def test_plots_without_a_place_are_refused(records: list[Message], sentence: str) -> None:
    with pytest.raises(TrackmeshError, match=sentence):
        PlotScene.read(records)
