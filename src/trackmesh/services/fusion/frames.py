"""The picture as a message: system tracks to ``TrackFrame``, and the selection that a query asks for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pymap3d

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import (
    COASTING,
    CONFIRMED,
    TENTATIVE,
    UNKNOWN_HEIGHT_M2,
    Geodetic,
    TrackFrame,
    TrackQuery,
)
from trackmesh.services.estimation.jit import kernel
from trackmesh.services.fusion.layer import Layer

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_PLACE = np.zeros((6, 6), np.int64)
_PLACE[np.triu_indices(6)] = np.arange(21)
_FLOAT32_MOST = float(np.finfo(np.float32).max)


@kernel
def pack_states(x: FloatArray, P: FloatArray) -> tuple[FloatArray, npt.NDArray[np.float32]]:
    """States (n, 4) and covariances (n, 4, 4) as (n, 6) and upper triangles (n, 21), padded with zeros."""
    n, d = x.shape
    state, covariance = np.zeros((n, 6)), np.zeros((n, 21), np.float32)
    for k in range(n):
        for a in range(d):
            state[k, a] = x[k, a]
            for b in range(a, d):
                # A prediction over a year is worth nothing, but must still be a message: it saturates.
                covariance[k, _PLACE[a, b]] = min(max(P[k, a, b], -_FLOAT32_MOST), _FLOAT32_MOST)
    return state, covariance


def status_of(layer: Layer, rows: IntArray, t_s: float, coasting_after_s: float) -> npt.NDArray[np.uint8]:
    """Status of rows at a time: tentative, confirmed, or coasting when no plot came for ``coasting_after_s``."""
    coasting = t_s - layer.life.last_s[rows] > coasting_after_s
    status = np.where(layer.life.confirmed[rows], np.where(coasting, COASTING, CONFIRMED), TENTATIVE)
    return status.astype(np.uint8)


def manoeuvre_fit(mu: FloatArray, models: int) -> FloatArray | None:
    """Probability (n,) of the first ``models`` of all (n, r); None where there are none of that kind."""
    # A sum of probabilities may be one and a bit in the last place, which no client would accept.
    return np.minimum(mu[:, :models].sum(axis=1), 1.0) if models else None


def heights(layer: Layer, rows: IntArray, t_s: float) -> tuple[FloatArray | None, FloatArray | None]:
    """Heights (n,) and variances (n,) of rows as frames tell them; None where no row has one."""
    if layer.heights is None:
        return None, None
    height, variance = layer.heights.estimate(rows, layer.life.uid[rows], t_s)
    unknown = ~(variance < UNKNOWN_HEIGHT_M2)
    if unknown.all():
        return None, None
    return np.where(unknown, 0.0, height), np.where(unknown, UNKNOWN_HEIGHT_M2, variance)


def select(frame: TrackFrame, query: TrackQuery) -> TrackFrame:
    """The part of a frame that a query asks for.

    Raises:
        RefusedMessage: the query needs an origin that the picture does not have.
    """
    wanted = query.status if query.status is not None else [CONFIRMED, COASTING]
    keep = np.isin(frame.status, wanted)
    if query.track_ids is not None:
        keep &= np.isin(frame.track_id, query.track_ids)
    if query.max_age_s is not None:
        keep &= frame.t_ns - frame.updated_t_ns <= query.max_age_s * 1e9
    if query.bbox_enu_m is not None:
        keep &= _inside(frame.state[:, 0], frame.state[:, 1], query.bbox_enu_m)
    if query.bbox_deg is not None:
        latitude, longitude = geodetic(frame.state[:, :2], frame.origin)
        # The corners are (latitude, longitude), the plane is (east, north): latitude is "north".
        south, west, north, east = query.bbox_deg
        keep &= _inside(longitude, latitude, [west, south, east, north])
    return take(frame, keep)


_PER_TRACK = (
    "track_id",
    "epoch",
    "status",
    "state",
    "covariance",
    "height_m",
    "height_variance_m2",
    "model_probability",
    "manoeuvre_fit",
    "members",
    "updated_t_ns",
    "first_t_ns",
)


def join(frame: TrackFrame, others: list[TrackFrame]) -> TrackFrame:
    """The frame with the tracks of others behind its own; all of one unit and set of sensors."""
    sensors = len(frame.sensors)
    parts = _alike([frame, *others])
    return frame.model_copy(
        update={
            name: np.concatenate([_widened(getattr(f, name), name, sensors) for f in parts])
            for name in _given(parts[0])
        }
    )


def _alike(parts: list[TrackFrame]) -> list[TrackFrame]:
    """Where some frames have heights, the others have unknown ones."""
    if all(f.height_m is None for f in parts):
        return parts
    return [f if f.height_m is not None else f.model_copy(update=_no_heights(len(f.track_id))) for f in parts]


def _no_heights(n: int) -> dict[str, FloatArray]:
    return {"height_m": np.zeros(n), "height_variance_m2": np.full(n, UNKNOWN_HEIGHT_M2)}


def _given(frame: TrackFrame) -> list[str]:
    return [name for name in _PER_TRACK if getattr(frame, name) is not None]


def _widened(values: npt.NDArray[np.generic], name: str, sensors: int) -> npt.NDArray[np.generic]:
    # A sensor may have been heard of since a track ended.
    if name != "members" or values.shape[1] == sensors:
        return values
    return np.pad(values, ((0, 0), (0, sensors - values.shape[1])), constant_values=-1)


def take(frame: TrackFrame, keep: npt.NDArray[np.bool_]) -> TrackFrame:
    """The frame with only these tracks."""
    return frame.model_copy(update={name: np.ascontiguousarray(getattr(frame, name)[keep]) for name in _given(frame)})


def geodetic(position_m: FloatArray, origin: Geodetic | None) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude in degrees of positions (n, 2) in the system plane, taken at height 0 of the plane.

    Raises:
        RefusedMessage: there is no origin.
    """
    if origin is None:
        raise RefusedMessage("no_origin", "This picture has no geographic origin, ask by bbox_enu_m.")
    up = np.zeros(len(position_m))
    latitude, longitude, _ = pymap3d.enu2geodetic(
        position_m[:, 0], position_m[:, 1], up, origin.latitude_deg, origin.longitude_deg, origin.height_m
    )
    return np.asarray(latitude), np.asarray(longitude)


def _inside(x: FloatArray, y: FloatArray, box: list[float]) -> npt.NDArray[np.bool_]:
    x0, y0, x1, y1 = box
    if x1 < x0 or y1 < y0:
        raise RefusedMessage("invalid", "A bounding box is given by its south-west and its north-east corner.")
    return np.asarray((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
