"""From the parameters of fits to the targets that are told."""

from __future__ import annotations

import numpy as np

from trackmesh.services.emi.design import N_TENSOR
from trackmesh.services.emi.diagnosis.attitude import Attitudes, attitude, attitudes
from trackmesh.services.emi.diagnosis.covariance import parameters_of
from trackmesh.services.emi.diagnosis.geometry import Mirror, reflected, reflection
from trackmesh.services.emi.diagnosis.results import Target
from trackmesh.services.emi.diagnosis.shape import SHAPES, Principal, along_axes, principal_values
from trackmesh.services.emi.kernels import FloatArray


def told_targets(r_m: FloatArray, depth_m: FloatArray, tensor_m3: FloatArray, covariance: FloatArray) -> list[Target]:
    """One target a row of a stack.

    Args:
        r_m, depth_m: (b, 3), (b,) positions.
        tensor_m3: (b, C, 6).
        covariance: (b, 3 + 6 C, 3 + 6 C) of both.
    """
    row, channel = np.arange(len(r_m)), np.argmax((tensor_m3**2).sum(2), 1)
    own = 3 + N_TENSOR * channel[:, None] + np.arange(N_TENSOR)
    block = covariance[row[:, None, None], own[:, :, None], own[:, None, :]]
    principal = principal_values(tensor_m3[row, channel], block)
    poses = attitudes(principal, block)
    curves = along_axes(tensor_m3, principal.vectors)
    return [
        _target(i, r_m, depth_m, tensor_m3, covariance, int(channel[i]), principal, poses, curves)
        for i in range(len(row))
    ]


def targets_of(
    r_m: FloatArray, depth_m: FloatArray, tensor_m3: FloatArray, covariance: FloatArray
) -> list[list[Target]]:
    """The targets of each fit of a stack, the one that is strongest at the surface first.

    Args:
        r_m, depth_m: (b, T, 3), (b, T).
        tensor_m3: (b, C, T, 6).
        covariance: (b, P, P), see ``covariance``.
    """
    n_c, n_t = tensor_m3.shape[1:3]
    by_target = []
    for t in range(n_t):
        own = parameters_of(t, n_t, n_c)
        block = covariance[:, own[:, None], own[None, :]]
        by_target.append(told_targets(r_m[:, t], depth_m[:, t], tensor_m3[:, :, t], block))
    return [sorted(targets, key=_strength, reverse=True) for targets in zip(*by_target, strict=True)]


def image_of(target: Target, mirror: Mirror, surface_m: float) -> Target:
    """The mirror image of a target."""
    turn = reflection(mirror, len(target.tensor_m3))
    position = reflected(mirror, target.position_m)
    tensor = target.tensor_m3 @ turn[3 : 3 + N_TENSOR, 3 : 3 + N_TENSOR].T
    covariance, depth = turn @ target.covariance @ turn.T, np.array([surface_m - position[2]])
    return told_targets(position[None], depth, tensor[None], covariance[None])[0]._replace(ambiguous="mirror")


def _strength(target: Target) -> float:
    """Field at the surface, in arbitrary units."""
    return float(np.sqrt((target.tensor_m3**2).sum()) / max(abs(target.depth_m), 1e-6) ** 6)


def _target(
    i: int,
    r_m: FloatArray,
    depth_m: FloatArray,
    tensor_m3: FloatArray,
    covariance: FloatArray,
    channel: int,
    principal: Principal,
    poses: Attitudes,
    curves: FloatArray,
) -> Target:
    shape = SHAPES[principal.shape[i]]
    has_axis = shape != "isotropic"
    return Target(
        r_m[i],
        float(depth_m[i]),
        covariance[i],
        tensor_m3[i],
        channel,
        principal.values_m3[i],
        principal.sd_m3[i],
        curves[i],
        shape,
        float(principal.p_isotropic[i]),
        float(principal.p_axisymmetric[i]),
        poses.axis[i] if has_axis else None,
        poses.axis_covariance[i] if has_axis else None,
        float(poses.axis_sd_rad[i]) if has_axis else None,
        attitude(poses, principal, i),
    )
