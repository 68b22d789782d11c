"""Whether a target is seen, two are told apart, and what a point dipole costs that stands for a loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.emi.fields import from_elements
from trackmesh.sim.emi import Buried, bury, principal_polarizability
from trackmesh.sim.studies.emi.setting import (
    COIL,
    LENGTH_M,
    LOOP,
    RADIUS_M,
    World,
    clean_t,
    draws,
    noise_t,
    results,
    rod,
    sphere,
    world,
)

DETECTED_DB = (-25.0, -22.0, -20.0, -18.0)
NOISE_SCANS = 10
"""Scans of noise alone, by the runs."""
APART_M = (0.3, 0.5, 0.8, 1.2)
DIPOLE_DEPTHS_M = (0.6, 1.0, 1.5, 2.0, 3.0)


class Detection(NamedTuple):
    """False alarms of so many scans of noise, and how often a sphere at 1 m is seen, by SNR."""

    false_alarms: int
    noise_scans: int
    seen: dict[float, float]
    runs: int


class Apart(NamedTuple):
    """Two targets: their distance, the SNR, how often two were told, and the median of their worst errors, in cm."""

    apart_m: float
    snr_db: float
    two_told: float
    error_cm: float
    runs: int


class DipoleBias(NamedTuple):
    """A loop's scan inverted with a dipole: how much too deep (cm), the tensor's error (%), and with the loop (cm)."""

    body: str
    depth_m: float
    bias_cm: float
    tensor_percent: float
    loop_cm: float
    warned: bool


def detection(runs: int) -> Detection:
    """On the thesis's scan with the exact loop, constant background."""
    here = world(LOOP, background="const")
    n_w, total = len(here.geometry.positions_m), NOISE_SCANS * runs
    rng, alarms = np.random.default_rng(1), 0
    for first in range(0, total, 50):
        noise = rng.standard_normal((min(50, total - first), 1, n_w, 3))
        alarms += sum(r.status != "no_target" for r in results(here, noise, 1.0))
    field = clean_t(here.geometry, sphere())
    seen = {}
    for snr in DETECTED_DB:
        sigma = noise_t(field, snr)
        told = results(here, draws(field, sigma, runs, seed=2), sigma)
        seen[snr] = float(np.mean([r.status != "no_target" for r in told]))
    return Detection(alarms, total, seen, runs)


def two_targets(runs: int, snrs_db: tuple[float, ...] = (10.0, 20.0, 30.0)) -> list[Apart]:
    """A sphere and a cylinder 0.1 m higher, side by side, up to three targets allowed."""
    here = world(LOOP, spacing_m=0.2, background="const", most_targets=3)
    return [_two(here, apart, snr, runs) for apart in APART_M for snr in snrs_db]


def _two(here: World, apart_m: float, snr_db: float, runs: int) -> Apart:
    left, right = sphere(0.9, -apart_m / 2.0), rod(45.0, 45.0, 0.8)
    right = right._replace(position_m=right.position_m + np.array([apart_m / 2.0, 0.0, 0.0]))
    field = clean_t(here.geometry, left, right)
    sigma = noise_t(field, snr_db)
    worst = []
    for result in results(here, draws(field, sigma, runs, seed=3), sigma):
        if len(result.targets) == 2:
            worst.append(_worst(np.array([t.position_m for t in result.targets]), (left, right)))
    told = len(worst) / runs
    return Apart(apart_m, snr_db, told, 100.0 * float(np.median(worst)) if worst else float("nan"), runs)


def _worst(found_m: FloatArray, truth: tuple[Buried, ...]) -> float:
    return max(float(np.linalg.norm(found_m - body.position_m[0], axis=1).min()) for body in truth)


def _standing(depth_m: float) -> Buried:
    """A cylinder with the axial time constant set right, unlike ``rod``."""
    across, along = principal_polarizability("cylinder", RADIUS_M, LENGTH_M)
    return bury("cylinder", (across, across, along), np.array([0.0, 0.0, -depth_m]), 0.0, 0.0)


def dipole_bias() -> list[DipoleBias]:
    """Without noise: what the model alone does."""
    wrong, right = world(LOOP, model=COIL, sigma_known=False), world(LOOP, sigma_known=False)
    found = []
    for depth in DIPOLE_DEPTHS_M:
        for name, body in (("sphere", sphere(depth)), ("standing cylinder", _standing(depth))):
            field = clean_t(right.geometry, body)
            (dipole,), (loop,) = results(wrong, field[None], None), results(right, field[None], None)
            target, truth = dipole.targets[0], from_elements(body.elements_m3[0])
            off = np.linalg.norm(from_elements(target.tensor_m3[0]) - truth) / np.linalg.norm(truth)
            bias, exact = (t.targets[0].position_m - body.position_m[0] for t in (dipole, loop))
            cm = [100.0 * float(x) for x in (-bias[2], np.abs(exact).max())]
            warned = "dipole_transmitter_near" in dipole.reasons
            found.append(DipoleBias(name, depth, cm[0], 100.0 * float(off), cm[1], warned))
    return found
