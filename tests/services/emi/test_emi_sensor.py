"""Sensors with offset, tilted and several coils, whose field is told by other code than the one that inverts it."""

from __future__ import annotations

import numpy as np
import pytest
from geoana.em.static import CircularLoopWholeSpace, MagneticDipoleWholeSpace
from tests.services.emi.makers import FINE, NO_PRIOR, TENSOR, noisy, solve

from trackmesh.protocol.messages import EmiGeometry, EmiReceiver, EmiTransmitter
from trackmesh.services.emi.design import model_field
from trackmesh.services.emi.engine import invert
from trackmesh.services.emi.fields import MU0, from_elements, to_elements
from trackmesh.services.emi.kernels import FloatArray
from trackmesh.services.emi.polarizability import rotation, sphere, sphere_step_off
from trackmesh.services.emi.scans import Options, search_grounds
from trackmesh.services.emi.sensor import Coils, nearest_points, rotations, sensor_arrays
from trackmesh.services.emi.service.convert import to_coils
from trackmesh.sim.emi import channel_field_nt, grid_positions, real_channels

PLACE = np.array([0.2, -0.1, -0.9])
CART = EmiTransmitter(radius_m=0.4, current_a=10.0, turns=5.0, axis=[0.1, -0.2, 1.0], offset_m=[0.3, 0.0, 0.1])
ARRAY = [
    EmiReceiver(offset_m=[-0.3, 0.4, 0.05], components=[[0.0, 0.2, 1.0]]),
    EmiReceiver(offset_m=[-0.3, 0.0, 0.0]),
    EmiReceiver(offset_m=[0.3, 0.0, 0.1], components="z", radius_m=0.2),
]


def quaternions(n: int, seed: int = 1) -> FloatArray:
    """Yaw all around, some pitch and roll."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4)) * [1.0, 0.1, 0.1, 1.0]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True) * rng.uniform(0.5, 2.0, (n, 1)))


def geometry(n: int = 15, *, turned: bool = True, receivers: list[EmiReceiver] | None = None) -> EmiGeometry:
    positions = grid_positions((3.0, 3.0), 3.0 / (n - 1))
    return EmiGeometry(
        positions_m=positions,
        transmitter=CART,
        receivers=receivers or ARRAY,
        attitude=quaternions(len(positions)) if turned else None,
    )


def test_quaternions_are_rotations() -> None:
    q = np.array([[np.cos(0.3), 0.0, 0.0, np.sin(0.3)], [2.0, 0.0, 0.0, 0.0]])
    turn = rotations(q)
    np.testing.assert_allclose(turn[0] @ [1.0, 0.0, 0.0], [np.cos(0.6), np.sin(0.6), 0.0], atol=1e-12)
    np.testing.assert_allclose(turn[1], np.eye(3), atol=1e-12)
    some = rotations(quaternions(20))
    np.testing.assert_allclose(some @ some.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    assert np.linalg.det(some) == pytest.approx(1.0)


@pytest.mark.parametrize("turned", [False, True])
def test_the_model_of_an_array_is_the_field_of_the_simulation(turned: bool) -> None:
    g = geometry(turned=turned)
    sensor = sensor_arrays(to_coils(g), "none")
    ours, _ = model_field(sensor, PLACE[None], to_elements(TENSOR)[None, None], np.zeros((1, 5, 0)))
    theirs = 1e-9 * channel_field_nt(g, PLACE, TENSOR[None])
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12 * np.abs(theirs).max())


def test_the_field_at_tilted_and_offset_coils_is_that_of_geoana() -> None:
    g = geometry(4)
    turn = rotations(g.attitude)  # type: ignore[arg-type]
    axis = np.array(CART.axis) / np.linalg.norm(CART.axis)
    ours = 1e-9 * channel_field_nt(g, PLACE, TENSOR[None])[0, :, 0]
    for i, place in enumerate(g.positions_m):
        loop = CircularLoopWholeSpace(
            radius=0.4, current=50.0, orientation=turn[i] @ axis, location=place + turn[i] @ CART.offset_m
        )
        moment = TENSOR @ loop.magnetic_flux_density(PLACE[None])[0] / loop.mu
        size = float(np.linalg.norm(moment))
        dipole = MagneticDipoleWholeSpace(moment=size, orientation=moment / size, location=PLACE)
        b = dipole.magnetic_flux_density((place + turn[i] @ ARRAY[0].offset_m)[None])[0]
        direction = turn[i] @ np.array([0.0, 0.2, 1.0]) / np.hypot(0.2, 1.0)
        assert ours[i] == pytest.approx(float(b @ direction), rel=1e-9)
        assert dipole.mu == pytest.approx(MU0, rel=1e-9)


def test_a_receiving_coil_measures_the_mean_over_its_area() -> None:
    coil = [EmiReceiver(offset_m=[0.3, 0.0, 0.1], components="z", radius_m=0.2)]
    g = geometry(4, turned=False, receivers=coil)
    measured = channel_field_nt(g, PLACE, TENSOR[None])[0, :, 0]
    # Gauss-Legendre over the squared radius, equal angles around.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    radius, angle = 0.2 * np.sqrt(0.5 * (nodes + 1.0)), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    mean = np.zeros(len(measured))
    for r, weight in zip(radius, weights, strict=True):
        for a in angle:
            point = [0.3 + r * np.cos(a), r * np.sin(a), 0.1]
            at = geometry(4, turned=False, receivers=[EmiReceiver(offset_m=point, components="z")])
            mean += 0.5 * weight / len(angle) * channel_field_nt(at, PLACE, TENSOR[None])[0, :, 0]
    np.testing.assert_allclose(measured, mean, rtol=1e-8)


@pytest.mark.parametrize("turned", [False, True])
def test_a_target_under_an_array_is_found_exactly(turned: bool) -> None:
    g = geometry(turned=turned)
    field = channel_field_nt(g, PLACE, TENSOR[None])[None]
    (result,) = solve(g, field, None, Options(background="none"))
    (target,) = result.targets
    np.testing.assert_allclose(target.position_m, PLACE, atol=1e-6)
    np.testing.assert_allclose(from_elements(target.tensor_m3[0]), TENSOR, atol=1e-6)


def test_an_array_at_rest_needs_no_lines() -> None:
    # Nine places of a transmitter above, three components at each of five receivers.
    receivers = [
        EmiReceiver(offset_m=[x, y, 0.0]) for x, y in ((0, 0), (0.3, 0.3), (-0.3, 0.3), (0.3, -0.3), (-0.3, -0.3))
    ]
    g = EmiGeometry(positions_m=grid_positions((0.8, 0.8), 0.4), transmitter=CART, receivers=receivers)
    field, sigma = noisy(channel_field_nt(g, PLACE, TENSOR[None])[None], 40.0)
    (result,) = solve(g, field, sigma, Options(background="none"))
    assert result.status == "ok"
    np.testing.assert_allclose(result.targets[0].position_m, PLACE, atol=0.02)


def test_one_receiver_that_fails_costs_its_readings_alone() -> None:
    g = geometry()
    field, sigma = noisy(channel_field_nt(g, PLACE, TENSOR[None])[None], 30.0)
    field[0, 0, ::2, 2] = np.nan
    (result,) = solve(g, field, sigma)
    assert (result.status, result.n_masked) == ("ok", 113)
    np.testing.assert_allclose(result.targets[0].position_m, PLACE, atol=0.03)


FREQUENCIES = np.array([90.0, 1e3, 1e4])


def spheres() -> FloatArray:
    """In-phase and quadrature (6, 3, 3) of a steel sphere at three frequencies."""
    values = np.array([sphere(0.05, omega, 6e6, 50.0) for omega in FREQUENCIES])
    return real_channels(np.asarray(values[:, None, None] * np.eye(3), np.complex128))


def test_frequencies_share_the_place_and_give_the_spectrum() -> None:
    clean = channel_field_nt(FINE, PLACE, spheres())[None]
    field, sigma = noisy(clean, 25.0)
    (result,) = solve(FINE, field, sigma)
    (target,) = result.targets
    assert result.status == "ok"
    assert target.covariance.shape == (3 + 36, 3 + 36)
    truth = spheres()[:, 0, 0]
    assert target.channel == int(np.argmax(np.abs(truth)))
    sd = np.sqrt(np.diagonal(target.covariance)[3::6])
    assert (np.abs(target.channel_principal_m3.mean(1) - truth) < 4.0 * sd).all()
    # Channels together know the place better than the best one alone.
    (alone,) = solve(FINE, field[:, target.channel : target.channel + 1], sigma)
    assert np.trace(target.covariance[:3, :3]) < np.trace(alone.targets[0].covariance[:3, :3])


def test_magnitudes_of_complex_numbers_are_no_field() -> None:
    # What is wrong with |B_x + j B_x'| shows as a mismatch.
    clean = channel_field_nt(FINE, PLACE, spheres()[:2])[None]
    field, sigma = noisy(np.hypot(clean[:, :1], clean[:, 1:]), 25.0)
    (result,) = solve(FINE, field, sigma)
    assert result.status != "ok"


def test_gates_share_the_place_and_give_the_decay() -> None:
    gates = np.geomspace(1e-4, 1e-2, 8)
    decay = sphere_step_off(0.05, gates, 3.5e7)
    clean = channel_field_nt(FINE, PLACE, decay[:, None, None] * np.eye(3))[None]
    sigma = 0.02 * np.abs(clean).max() * np.geomspace(1.0, 0.1, 8)[:, None, None]
    field = clean + sigma * np.random.default_rng(3).normal(size=clean.shape)
    (result,) = invert(to_coils(FINE), 1e-9 * field, 1e-9 * sigma, Options())
    (target,) = result.targets
    np.testing.assert_allclose(target.position_m, PLACE, atol=0.03)
    np.testing.assert_allclose(target.channel_principal_m3.mean(1), decay, rtol=0.15, atol=0.02 * decay[0])


def test_near_points_are_others_and_near() -> None:
    grid = grid_positions((1.0, 1.0), 0.25)
    near = nearest_points(grid)
    assert sorted(near[12].tolist()) == [7, 11, 13, 17]
    twice = np.repeat(grid[:3], 3, axis=0)
    assert not (nearest_points(twice) == np.arange(9)[:, None]).any()
    assert nearest_points(grid[:1]).tolist() == [[0, 0, 0, 0]]
    assert nearest_points(grid[:2]).tolist() == [[1, 0, 0, 0], [0, 1, 1, 1]]


def test_a_search_goes_where_it_is_told() -> None:
    place = sensor_arrays(Coils(grid_positions((4.0, 2.0), 0.5), 0.5, 1.0), "none").place_m
    below, above = search_grounds(place, Options(side="unknown", depth_max_m=3.0), True)
    assert (below.bounds.lower_m[2], below.bounds.upper_m[2]) == (-3.0, -0.05)
    assert (above.bounds.lower_m[2], above.bounds.upper_m[2]) == (0.05, 3.0)
    (area,) = search_grounds(place, Options(area_m=(1.0, 0.0, -1.0, 0.5)), True)
    assert area.bounds.lower_m[:2].tolist() == [-1.0, 0.0]
    assert area.prior.information.tolist() == NO_PRIOR.information.tolist()
    (prior,) = search_grounds(place, Options(prior_m=np.array([[0, 0, -1], [0.1, 0.2, 0.5]])), True)
    np.testing.assert_allclose(np.diagonal(prior.prior.information), [100.0, 25.0, 4.0])


def test_axes_in_the_frame_replace_those_on_the_sensor() -> None:
    g = geometry()
    axes = np.tile([0.0, 0.0, 1.0], (len(g.positions_m), 1))
    replaced = sensor_arrays(to_coils(g.model_copy(update={"axes": axes})), "none")
    np.testing.assert_array_equal(replaced.tx_axis, axes)
    turn = rotation(0.0, 0.0, 0.0)
    np.testing.assert_allclose(turn, np.eye(3))
