from __future__ import annotations

import numpy as np
import pytest
from geoana.em.static import CircularLoopWholeSpace, MagneticDipoleWholeSpace

from trackmesh.protocol.codec import encode
from trackmesh.protocol.messages import EmiReceiver
from trackmesh.sim.emi import (
    bury,
    clean_field_nt,
    grid_positions,
    principal_polarizability,
    random_targets,
    scenario_scans,
    simulate,
    survey_geometry,
)
from trackmesh.sim.scenario import Scenario

SMALL = survey_geometry((1.0, 1.0), 0.5)


def test_a_grid_has_both_ends_and_its_middle_at_the_origin() -> None:
    positions = grid_positions((4.0, 2.0), 0.1, 0.3)
    assert positions.shape == (41 * 21, 3)
    np.testing.assert_allclose(positions.min(0), [-2.0, -1.0, 0.3])
    np.testing.assert_allclose(positions.max(0), [2.0, 1.0, 0.3])
    np.testing.assert_allclose(positions[1] - positions[0], [0.1, 0.0, 0.0], atol=1e-12)


def test_same_seed_same_bytes_another_seed_another_noise() -> None:
    first, again, other = (encode(simulate(SMALL, random_targets(3, 1), 20.0, s).batch) for s in (7, 7, 8))
    assert first == again != other


def test_noise_has_the_asked_power_and_is_told_where_it_is_common() -> None:
    geometry, one = survey_geometry((4.0, 4.0), 0.1), random_targets(1, 2)
    clean = clean_field_nt(geometry, one)
    got = simulate(geometry, one, 10.0, 1)
    noise = got.batch.field - clean
    assert 10.0 * np.log10((clean**2).mean() / (noise**2).mean()) == pytest.approx(10.0, abs=0.2)
    assert got.batch.sigma == pytest.approx(float(noise.std()), rel=0.03)
    assert simulate(geometry, random_targets(2, 2), 10.0, 1).batch.sigma is None
    np.testing.assert_array_equal(simulate(geometry, one, None, 1).batch.field, clean)


def test_field_is_that_of_geoana() -> None:
    place, tensor = np.array([0.1, -0.2, -0.9]), np.diag([-0.1, -0.08, -0.04])
    truth = bury("body", (-0.1, -0.08, -0.04), place, 0.0, 0.0)
    np.testing.assert_allclose(truth.tensor_m3[0], tensor, atol=1e-15)
    expected = []
    for position in SMALL.positions_m:
        coil = CircularLoopWholeSpace(
            radius=0.5, current=20.0, location=position, orientation=np.array([0.0, 0.0, 1.0])
        )
        m = tensor @ coil.magnetic_field(place[None])[0]
        size = float(np.linalg.norm(m))
        answer = MagneticDipoleWholeSpace(moment=size, orientation=m / size, location=place)
        expected.append(1e9 * answer.magnetic_flux_density(position[None])[0])
    np.testing.assert_allclose(clean_field_nt(SMALL, truth)[0, 0], expected, rtol=1e-8, atol=1e-10)


def test_a_scalar_receiver_measures_z() -> None:
    scalar = survey_geometry((1.0, 1.0), 0.5, receiver=EmiReceiver(components="z"))
    truth = random_targets(2, 1)
    np.testing.assert_array_equal(clean_field_nt(scalar, truth)[..., 0], clean_field_nt(SMALL, truth)[..., 2])


def test_random_targets_stay_where_they_are_wanted() -> None:
    truth = random_targets(50, 4, depth_m=(0.5, 0.9), spread_m=0.7, surface_m=0.2)
    assert (np.abs(truth.position_m[:, :2]) <= 0.7).all()
    assert ((truth.position_m[:, 2] <= -0.3) & (truth.position_m[:, 2] >= -0.7)).all()
    np.testing.assert_allclose(np.linalg.norm(truth.axis, axis=1), 1.0)
    assert truth.kinds[:2] == ("sphere", "cylinder")


def test_copper_pushes_the_field_out() -> None:
    assert max(principal_polarizability("sphere")) < 0.0
    across, along = principal_polarizability("cylinder")
    assert across < along < 0.0


def test_a_scenario_scans_each_target_by_itself(two_radars: Scenario) -> None:
    assert two_radars.emi is not None
    got = scenario_scans(two_radars.emi, 1)
    assert got.batch.field.shape == (3, 1, 1681, 3)
    np.testing.assert_array_equal(got.truth.position_m, [t.position_m for t in two_radars.emi.targets])
