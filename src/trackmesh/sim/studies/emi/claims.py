"""What the thesis claims of its initial estimate and its filter, and what is found: errors by SNR, attitude, depth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from trackmesh.protocol.arrays import FloatArray
from trackmesh.services.emi.diagnosis.attitude import attitudes
from trackmesh.services.emi.diagnosis.shape import principal_values
from trackmesh.services.emi.estimators import EstimatorName
from trackmesh.sim.emi import Buried
from trackmesh.sim.studies.emi.setting import (
    ATTITUDES_DEG,
    SNR_DB,
    Estimates,
    World,
    clean_t,
    draws,
    estimates,
    noise_t,
    rod,
    sphere,
)

SNRS_DB = (0.0, 10.0, 20.0, 30.0, 40.0)
DEPTHS_M = (0.4, 0.6, 0.8, 1.0)
ROLLS_DEG = (0, 45, 90)
FILTERS: tuple[EstimatorName, ...] = ("kf-ekf-thesis", "ekf9", "varpro")
SHARE = {"varpro": 1.0, "initial": 1.0, "ekf9": 0.25, "kf-ekf-thesis": 0.25}
"""Of the runs: the filters take much longer."""


class Errors(NamedTuple):
    """Mean errors over n draws: horizontal, vertical and in all, of position in cm; of the tensor in per cent."""

    horizontal_cm: float
    vertical_cm: float
    position_cm: float
    tensor_percent: float
    n: int


class Case(NamedTuple):
    """One point of a figure: figure, curve, abscissa, estimator, and its errors."""

    figure: str
    curve: str
    at: float
    estimator: EstimatorName
    errors: Errors


class AngleErrors(NamedTuple):
    """Mean errors of an attitude in degrees: pitch, roll, and of the axis itself; standard deviations; draws."""

    attitude_deg: tuple[int, int]
    estimator: EstimatorName
    mean_deg: FloatArray
    std_deg: FloatArray
    n: int


def errors(found: Estimates, body: Buried) -> Errors:
    """Mean errors, as equations 5-5 to 5-11 have them."""
    off = 100.0 * (found.position_m - body.position_m[0])
    truth = body.elements_m3[0]
    tensor = 100.0 * np.linalg.norm(found.tensor_m3 - truth, axis=1) / np.linalg.norm(truth)
    return Errors(
        float(np.hypot(off[:, 0], off[:, 1]).mean()),
        float(np.abs(off[:, 2]).mean()),
        float(np.linalg.norm(off, axis=1).mean()),
        float(tensor.mean()),
        len(off),
    )


def runs_of(name: EstimatorName, runs: int) -> int:
    """How many draws an estimator gets."""
    return max(4, round(SHARE[name] * runs))


def cases() -> Iterator[tuple[str, str, float, EstimatorName, Buried, float]]:
    """Figure, curve, abscissa, estimator, body and SNR of each point."""
    for snr in SNRS_DB:
        yield "5-8, 5-10, 5-13", "sphere", snr, "initial", sphere(), snr
        for name in FILTERS:
            yield "5-17", "sphere", snr, name, sphere(), snr
    for depth in DEPTHS_M:
        yield "5-11", "sphere", depth, "initial", sphere(depth), SNR_DB
    for roll in ROLLS_DEG:
        for pitch, _ in ATTITUDES_DEG:
            body = rod(pitch, roll)
            yield "5-9, 5-12, 5-14", f"roll {roll}", float(pitch), "initial", body, SNR_DB
            for name in FILTERS:
                yield "5-18", f"roll {roll}", float(pitch), name, body, SNR_DB


def measured(here: World, runs: int, say: Callable[[float], None]) -> list[Case]:
    """Every point of the figures."""
    todo = list(cases())
    done = []
    for i, (figure, curve, at, name, body, snr) in enumerate(todo):
        field = clean_t(here.geometry, body)
        sigma, n = noise_t(field, snr), runs_of(name, runs)
        found = estimates(name, here, draws(field, sigma, n, seed=i), sigma)
        done.append(Case(figure, curve, at, name, errors(found, body)))
        say((i + 1) / len(todo))
    return done


def angle_errors(here: World, name: EstimatorName, runs: int) -> list[AngleErrors]:
    """Table 5-4 by one estimator."""
    return [_angle_errors(here, name, attitude, runs_of(name, runs)) for attitude in ATTITUDES_DEG]


def _angle_errors(here: World, name: EstimatorName, attitude: tuple[int, int], n: int) -> AngleErrors:
    body = rod(*attitude)
    field = clean_t(here.geometry, body)
    sigma = noise_t(field, SNR_DB)
    found = estimates(name, here, draws(field, sigma, n, seed=sum(attitude)), sigma)
    told, axis_deg = angles_deg(found.tensor_m3, body.axis[0])
    off = np.abs((told - np.array(attitude) + 180.0) % 360.0 - 180.0)
    table = np.column_stack([off, axis_deg])
    return AngleErrors(attitude, name, table.mean(0), table.std(0), n)


def angles_deg(tensor_m3: FloatArray, axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pitch and roll (n, 2) of tensors (n, 6), and the angle (n,) of their axis from the true one.

    A tensor does not tell one end of an axis from the other: the end is taken that is nearer to the true one.
    """
    nothing = np.broadcast_to(np.eye(6), (len(tensor_m3), 6, 6))
    found = attitudes(principal_values(tensor_m3, nothing), nothing).axis
    found = found * np.where(found @ axis < 0.0, -1.0, 1.0)[:, None]
    x, y, z = found.T
    pitch, roll = np.arctan2(-x, np.hypot(y, z)), np.arctan2(y, z)
    off = np.arctan2(np.linalg.norm(np.cross(found, axis), axis=1), found @ axis)
    return np.degrees(np.stack([pitch, roll], 1)), np.degrees(off)
