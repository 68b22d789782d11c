from __future__ import annotations

import numpy as np
import pytest
from tests.services.emi.makers import MOMENT, TENSOR, coils, field_t, rod, solve

from trackmesh.services.emi.diagnosis.geometry import Mirror, mirrors, reflected, reflection
from trackmesh.services.emi.fields import from_elements, to_elements
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import XYZ, Z_ONLY, Coils, Receiver, sensor_arrays
from trackmesh.sim.emi import grid_positions

LINE = Coils(grid_positions((4.0, 0.0), 0.1), 0.5, MOMENT)
XZ = (Receiver(XYZ[[0, 2]]),)
PLACE = np.array([0.2, 0.4, -0.9])


def found(c: Coils) -> list[Mirror]:
    return mirrors(sensor_arrays(c, "none"))


@pytest.mark.parametrize(
    ("c", "normals"),
    [
        (coils(n=9), []),
        (coils(n=9)._replace(receivers=(Receiver(Z_ONLY),)), [[0, 0, 1]]),
        (LINE, []),
        (LINE._replace(receivers=XZ), [[0, 1, 0]]),
        (LINE._replace(receivers=(Receiver(Z_ONLY),)), [[0, 1, 0], [0, 0, 1]]),
        (LINE._replace(receivers=XZ, tx_axis=np.array([0.3, 0.0, 0.9])), [[0, 1, 0]]),
        (LINE._replace(receivers=XZ, tx_axis=np.array([0.0, 0.3, 0.9])), []),
        (LINE._replace(receivers=(Receiver(XYZ[[0, 2]], np.array([0.0, 0.1, 0.0])),)), []),
        (coils(n=9)._replace(receivers=(Receiver(Z_ONLY),), tx_offset_m=np.array([0.0, 0.0, 0.1])), []),
    ],
)
def test_a_plane_through_all_coils_is_a_mirror_unless_a_coil_tells_its_sides(
    c: Coils, normals: list[list[int]]
) -> None:
    planes = [np.abs(mirror.normal) for mirror in found(c)]
    np.testing.assert_allclose(np.reshape(planes, (-1, 3)), np.reshape(normals, (-1, 3)), atol=1e-9)


@pytest.mark.parametrize(
    "c",
    [
        LINE._replace(receivers=XZ),
        coils(n=9)._replace(receivers=(Receiver(Z_ONLY),)),
        LINE._replace(receivers=XZ, radius_m=0.2),
    ],
)
def test_the_image_gives_the_same_field(c: Coils) -> None:
    mirror = found(c)[0]
    turn = reflection(mirror, 1)
    image = from_elements(turn[3:, 3:] @ to_elements(TENSOR))
    y, y_image = field_t(c, PLACE, TENSOR), field_t(c, reflected(mirror, PLACE), image)
    np.testing.assert_allclose(y_image, y, rtol=1e-9, atol=1e-12 * np.abs(y).max())


def measured(c: Coils, place: FloatArray, sigma_share: float = 1e-4) -> tuple[FloatArray, float]:
    """One scan in nT with a little noise."""
    clean = 1e9 * field_t(c, place, rod().tensor_m3[0])[None]
    sigma = sigma_share * float(np.abs(clean).max())
    return clean + sigma * np.random.default_rng(1).normal(size=clean.shape), sigma


def test_both_sides_of_a_line_are_told() -> None:
    c = LINE._replace(receivers=XZ)
    (result,) = solve(c, *measured(c, PLACE))
    assert (result.status, result.reasons[:2]) == ("underdetermined", ("collinear", "mirror"))
    places = np.array([target.position_m for target in result.targets])
    np.testing.assert_allclose(np.sort(places[:, 1]), [-0.4, 0.4], atol=0.05)
    np.testing.assert_allclose(places[:, [0, 2]], [PLACE[[0, 2]]] * 2, atol=0.05)
    assert [target.ambiguous for target in result.targets] == ["mirror", "mirror"]
    np.testing.assert_allclose(np.diagonal(result.targets[0].covariance), np.diagonal(result.targets[1].covariance))


def test_both_sides_of_a_flat_scan_of_one_component_are_told_where_both_are_possible() -> None:
    c = coils(n=15)._replace(receivers=(Receiver(Z_ONLY),))
    scan = measured(c, PLACE)
    (known,) = solve(c, *scan)
    assert (known.status, len(known.targets)) == ("ok", 1)
    (result,) = solve(c, *scan, Options(side="unknown"))
    assert (result.status, result.reasons[0]) == ("underdetermined", "mirror")
    assert sorted(round(t.depth_m, 1) for t in result.targets) == [-0.9, 0.9]


def test_three_components_tell_above_from_below() -> None:
    c = coils(n=15)
    for place, side in ((PLACE, 1.0), (PLACE * [1, 1, -1], -1.0)):
        (result,) = solve(c, *measured(c, place), Options(side="unknown"))
        assert result.status == "ok"
        assert result.targets[0].depth_m == pytest.approx(side * 0.9, abs=0.02)
        (result,) = solve(c, *measured(c, place), Options(side="above" if side < 0 else "below"))
        assert result.status == "ok"
