"""The world of the thesis: its coil, scan and bodies (tables 5-1 to 5-3), its noise, and estimates of all kinds in it.

Liu Zhiyang, EMI detection by filter tracking, master thesis, University of Science and Technology Beijing, 2018. Its
claims come back under one reading: the transmitter a point dipole, only the real part of the polarizability, the axial
time constant of the cylinder 3 L tau, and a signal-to-noise ratio of mean power over all samples and components.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.protocol.messages import EmiGeometry, EmiTransmitter
from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.diagnosis.covariance import fisher_matrix
from trackmesh.services.emi.diagnosis.results import ScanResult
from trackmesh.services.emi.engine import Survey, invert_over, survey
from trackmesh.services.emi.estimators import ESTIMATORS, Enough, EstimatorName, Task
from trackmesh.services.emi.polarizability import cylinder
from trackmesh.services.emi.scans import Options
from trackmesh.services.emi.sensor import Background, Coils, Receiver
from trackmesh.services.emi.varpro import evaluate
from trackmesh.sim.emi import (
    CONDUCTIVITY_S_M,
    OMEGA_RAD_S,
    Buried,
    bury,
    channel_field_nt,
    principal_polarizability,
    survey_geometry,
)

COIL = EmiTransmitter(model="dipole", radius_m=0.5, current_a=20.0)
LOOP = EmiTransmitter(model="loop", radius_m=0.5, current_a=20.0)
RADIUS_M, LENGTH_M = 0.2, 0.8
SIZE_M, SPACING_M = (4.0, 4.0), 0.1
SNR_DB = 20.0
ATTITUDES_DEG = ((0, 0), (15, 0), (30, 0), (45, 0), (60, 0), (75, 0), (90, 0))
"""Pitch and roll of table 5-4."""


class World(NamedTuple):
    """A scan and what is known of it: the geometry, the same as the engine takes it, what to invert with."""

    geometry: EmiGeometry
    coils: Coils
    ready: Survey


class Estimates(NamedTuple):
    """Positions (n, 3) and tensors (n, 6) of n draws."""

    position_m: FloatArray
    tensor_m3: FloatArray


def world(
    transmitter: EmiTransmitter = COIL,
    *,
    model: EmiTransmitter | None = None,
    spacing_m: float = SPACING_M,
    background: Background = "none",
    most_targets: int = 1,
    sigma_known: bool = True,
) -> World:
    """The thesis's scan; ``model`` is the transmitter that the inversion believes in."""
    geometry = survey_geometry(SIZE_M, spacing_m, transmitter=transmitter)
    believed = model or transmitter
    moment = believed.turns * believed.current_a * np.pi * believed.radius_m**2
    coils = Coils(geometry.positions_m, believed.radius_m, moment, believed.model == "loop", receivers=(Receiver(),))
    options = Options(background=background, most_targets=most_targets)
    return World(geometry, coils, survey(coils, options, sigma_known))


def sphere(depth_m: float = 1.0, x_m: float = 0.0, y_m: float = 0.0) -> Buried:
    """The thesis's sphere."""
    value, _ = principal_polarizability("sphere", RADIUS_M)
    return bury("sphere", (value, value, value), np.array([x_m, y_m, -depth_m]), 0.0, 0.0)


def rod(pitch_deg: float, roll_deg: float, depth_m: float = 1.0) -> Buried:
    """The thesis's cylinder."""
    across, along = cylinder(RADIUS_M, LENGTH_M, OMEGA_RAD_S, CONDUCTIVITY_S_M, tau_long=3.0 * LENGTH_M)
    principal = (across.real, across.real, along.real)
    return bury("cylinder", principal, np.array([0.0, 0.0, -depth_m]), np.deg2rad(pitch_deg), np.deg2rad(roll_deg))


def clean_t(geometry: EmiGeometry, *bodies: Buried) -> FloatArray:
    """Field (1, W, K) in T of bodies together, without noise."""
    fields = [channel_field_nt(geometry, body.position_m[0], body.tensor_m3) for body in bodies]
    return np.asarray(1e-9 * np.sum(fields, axis=0))


def noise_t(field_t: FloatArray, snr_db: float) -> float:
    """Standard deviation of the noise that gives a field its signal-to-noise ratio."""
    return float(np.sqrt((field_t**2).mean())) * 10 ** (-snr_db / 20)


def draws(field_t: FloatArray, sigma_t: float, n: int, seed: int) -> FloatArray:
    """(n, 1, W, K): the field with noise."""
    rng = np.random.default_rng([seed, n])
    return field_t + sigma_t * rng.standard_normal((n, *field_t.shape))


def estimates(name: EstimatorName, here: World, fields_t: FloatArray, sigma_t: float) -> Estimates:
    """What an estimator finds in each draw, detected or not."""
    ready, estimator = here.ready, ESTIMATORS[name]
    enough = Enough(2.0 * fields_t[0].size, 0.0, 0.0, 0.0)
    weight = np.full(fields_t.shape[1:], 1.0 / sigma_t)
    ground = ready.setting.grounds[0]
    fits = [estimator(Task(ready.sensor, np.ascontiguousarray(y), weight, ground, enough)) for y in fields_t]
    return Estimates(np.array([fit.r_m[0] for fit in fits]), np.array([fit.tensor_m3[0, 0] for fit in fits]))


def results(here: World, fields_t: FloatArray, sigma_t: float | None) -> list[ScanResult]:
    """What the default answers to each draw; without ``sigma_t`` in a world whose noise is not known."""
    return list(invert_over(here.ready, fields_t, sigma_t))


def bound(here: World, body: Buried, sigma_t: float) -> FloatArray:
    """Cramer-Rao bound (9, 9) of position and tensor, over the whole scan."""
    n_w, n_k = here.ready.sensor.direction.shape[:2]
    weight = np.full((1, n_w, n_k), 1.0 / sigma_t)
    reduced = evaluate(
        here.ready.sensor, np.zeros_like(weight), weight, np.arange(n_w), body.position_m, body.elements_m3[:, None]
    )
    fisher = fisher_matrix(reduced[None])[0]
    assert len(fisher) == 3 + N_TENSOR
    scale = 1.0 / np.sqrt(np.diagonal(fisher))
    return np.asarray(np.linalg.inv(fisher * np.outer(scale, scale)) * np.outer(scale, scale))
