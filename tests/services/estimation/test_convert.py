from __future__ import annotations

import numpy as np
import pymap3d
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.services.estimation.makers import LAW, FloatArray, seeds, unpacked

from trackmesh.services.estimation.convert import polar_to_plane

ranges_m = st.floats(10.0, 3e5)
azimuths = st.floats(-np.pi, 2 * np.pi)


def one(
    range_m: float, azimuth: float, elevation: float | None, sigma_r: float, sigma_az: float
) -> tuple[FloatArray, FloatArray]:
    """Position (2,) and covariance (2, 2) of one plot."""
    tilt = None if elevation is None else np.array([elevation])
    z, R = polar_to_plane(
        np.array([range_m]), np.array([azimuth]), tilt, np.array([sigma_r**2]), np.array([sigma_az**2])
    )
    return z[0], unpacked(R)[0]


@LAW
@given(ranges_m, azimuths, st.floats(-1.5, 1.5))
def test_positions_are_those_of_pymap3d(range_m: float, azimuth: float, elevation: float) -> None:
    z, _ = one(range_m, azimuth, elevation, 50.0, 1e-3)
    east, north, _ = pymap3d.aer2enu(np.degrees(azimuth), np.degrees(elevation), range_m)
    np.testing.assert_allclose(z, [east, north], atol=1e-7)


@LAW
@given(ranges_m, azimuths, st.floats(1.0, 500.0), st.floats(1e-4, 0.1))
def test_covariance_lies_along_and_across_the_line_of_sight(
    range_m: float, azimuth: float, sigma_r: float, sigma_az: float
) -> None:
    _, R = one(range_m, azimuth, None, sigma_r, sigma_az)
    along = np.array([np.sin(azimuth), np.cos(azimuth)])
    across = np.array([np.cos(azimuth), -np.sin(azimuth)])
    want = sigma_r**2 * np.outer(along, along) + (range_m * sigma_az) ** 2 * np.outer(across, across)
    np.testing.assert_allclose(R, want, rtol=1e-9, atol=1e-6 * want.max())


@LAW
@given(seeds)
def test_a_full_turn_more_is_the_same_plot(seed: int) -> None:
    rng = np.random.default_rng(seed)
    range_m, azimuth = rng.uniform(1e3, 1e5), rng.uniform(-np.pi, 0.0)
    for a, b in zip(
        one(range_m, azimuth, None, 50.0, 1e-3), one(range_m, azimuth + 2 * np.pi, None, 50.0, 1e-3), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("azimuth", [0.0, 0.7, 2.5, -1.9])
@pytest.mark.parametrize("sigma_deg", [0.1, 1.0, 2.0])
def test_moments_against_drawn_errors(azimuth: float, sigma_deg: float) -> None:
    """Converted plots lie about the truth without bias, spread as the covariance says but for a wide beam's bend."""
    rng, n, sigma_az = np.random.default_rng(1), 400_000, np.deg2rad(sigma_deg)
    range_m, sigma_r = 80e3, 50.0
    measured_r = range_m + sigma_r * rng.standard_normal(n)
    measured_az = azimuth + sigma_az * rng.standard_normal(n)
    z, R = polar_to_plane(measured_r, measured_az, None, np.full(n, sigma_r**2), np.full(n, sigma_az**2))
    truth = range_m * np.array([np.sin(azimuth), np.cos(azimuth)])
    error = z - truth
    # Below half a degree the bias is left in: it is smaller than a hundredth of the error.
    left_in = range_m * sigma_az**2 / 2 if sigma_deg < 0.5 else 0.0
    assert np.abs(error.mean(axis=0)).max() < 4 * error.std(axis=0).max() / np.sqrt(n) + left_in
    whitened = np.linalg.solve(np.linalg.cholesky(unpacked(R)), error[..., None])[..., 0]
    # Seen from the plot, the truth is off by r s^2 (1 + chi_1^2) / 2 along the range: an arc, which no ellipse holds.
    bend = 1.5 * (range_m * sigma_az**2) ** 2 / sigma_r**2
    assert np.mean(whitened**2) == pytest.approx(1.0 + bend / 2, rel=0.02)


def test_a_wide_beam_shortens_the_mean_and_is_stretched_back() -> None:
    narrow, wide = one(1e5, 0.5, None, 50.0, np.deg2rad(0.49))[0], one(1e5, 0.5, None, 50.0, np.deg2rad(2.0))[0]
    assert np.hypot(*narrow) == pytest.approx(1e5, abs=1e-6)
    assert np.hypot(*wide) == pytest.approx(1e5 * np.exp(np.deg2rad(2.0) ** 2 / 2), abs=1e-6)


def test_no_plots_give_no_rows() -> None:
    none = np.empty(0)
    z, R = polar_to_plane(none, none, None, none, none)
    assert z.shape == (0, 2)
    assert R.shape == (0, 3)
