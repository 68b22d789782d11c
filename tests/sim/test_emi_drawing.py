from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trackmesh.protocol.errors import TrackmeshError
from trackmesh.protocol.messages import EmiResult, EmiScanBatch
from trackmesh.services.emi.service.local import invert_locally
from trackmesh.services.emi.service.pool import OwnWork
from trackmesh.sim.emi import random_targets, simulate, survey_geometry
from trackmesh.sim.emi_drawing import draw_scans, ellipse, field_map, magnification


def inverted(size_m: tuple[float, float] = (3.0, 3.0)) -> tuple[EmiScanBatch, list[EmiResult]]:
    batch = simulate(survey_geometry(size_m, 0.3), random_targets(2, 5), 30.0, 5, batch_id="area").batch
    return batch, list(invert_locally(OwnWork(), batch))


def test_a_picture_a_scan(tmp_path: Path) -> None:
    batch, results = inverted()
    pictures = draw_scans([batch], results, tmp_path / "new")
    assert [p.name for p in pictures] == ["area-0.png", "area-1.png"]
    assert all(p.stat().st_size > 20_000 for p in pictures)


def test_a_single_line_and_a_scan_without_target_are_drawn(tmp_path: Path) -> None:
    batch, results = inverted((3.0, 0.0))
    assert len(draw_scans([batch], results, tmp_path)) == 2
    empty = EmiResult(batch_id="area", index=0, status="invalid", reasons=["not_finite"])
    nothing = batch.model_copy(update={"field": np.full_like(batch.field, np.nan)})
    assert draw_scans([nothing], [empty], tmp_path)[0].exists()


def test_the_map_is_that_of_the_strongest_channel() -> None:
    batch, _ = inverted()
    two = batch.model_copy(update={"field": np.concatenate([0.1 * batch.field, batch.field], axis=1)})
    np.testing.assert_array_equal(field_map(two, 1).size, field_map(batch, 1).size)


def test_ellipses_hold_what_they_say_and_are_magnified_to_be_seen() -> None:
    covariance = np.array([[0.04, 0.01], [0.01, 0.02]])
    x = ellipse([1.0, 2.0], covariance, 3) - np.array([[1.0], [2.0]])
    np.testing.assert_allclose(np.einsum("in,ij,jn->n", x, np.linalg.inv(covariance), x), 9.0 * 5.991, rtol=1e-9)
    _, results = inverted()
    targets = results[0].targets
    assert magnification(targets, 1e-6) == 1
    assert magnification(targets, 4.0) > 1
    assert magnification([], 4.0) == 1


def test_a_batch_without_its_geometry_cannot_be_drawn(tmp_path: Path) -> None:
    batch, results = inverted()
    named = batch.model_copy(update={"geometry": None, "geometry_id": "x"})
    with pytest.raises(TrackmeshError, match="no geometry"):
        draw_scans([named], results, tmp_path)
