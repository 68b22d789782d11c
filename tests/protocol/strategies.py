"""Hypothesis strategies: a valid message of every kind, drawn over all that the protocol allows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from trackmesh.protocol.arrays import AnyArray, ArrayField
from trackmesh.protocol.messages import (
    MESSAGES,
    BandFrame,
    EmiAngles,
    EmiGeometry,
    EmiLimit,
    EmiOptions,
    EmiPrior,
    EmiReceiver,
    EmiResult,
    EmiScanBatch,
    EmiTarget,
    EmiTransmitter,
    Envelope,
    Geodetic,
    HistoryQuery,
    Message,
    PlotBatch,
    RangeBatch,
    RefinedFrame,
    Registration,
    ScanPart,
    SensorBias,
    SensorHealth,
    SensorInfo,
    ServiceStatus,
    TagFrame,
    TrackFrame,
    TrackQuery,
    TruthFrame,
    UnitArea,
)
from trackmesh.protocol.messages.base import TopMessage
from trackmesh.protocol.messages.plots import COLUMN_BOUNDS, COLUMN_SETS, LARGEST_SIGMA

Fields = dict[str, Any]
Strategy = st.SearchStrategy[Any]

ids = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,8}", fullmatch=True)
boot_ids = st.from_regex(r"[A-Za-z0-9_-]{1,12}", fullmatch=True)
counts = st.integers(0, 2**63 - 1)
times_ns = counts
texts = st.text(max_size=8)
lengths = st.integers(0, 4)


def real(low: float | None = None, high: float | None = None, **more: bool) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False, **more)  # type: ignore[arg-type]


def maybe(strategy: Strategy) -> Strategy:
    return st.none() | strategy


def elements(field: ArrayField) -> Strategy:
    dtype = np.dtype(field.dtype)
    if dtype.kind == "f":
        return npst.from_dtype(dtype, allow_nan=False, allow_infinity=False, min_value=field.ge, max_value=field.le)
    info = np.iinfo(dtype)
    low = info.min if field.ge is None else int(field.ge)
    return st.integers(low, info.max if field.le is None else int(field.le))


def array(field: ArrayField, sizes: dict[str, int]) -> st.SearchStrategy[AnyArray]:
    shape = tuple(sizes[axis] if isinstance(axis, str) else axis or 0 for axis in field.shape)
    return npst.arrays(field.dtype, shape, elements=elements(field))


def arrays(kind: type[Message], **sizes: int) -> st.SearchStrategy[Fields]:
    """All array fields of a message, its named axes of these sizes; optional ones sometimes None."""
    found = {}
    for name, info in kind.model_fields.items():
        inner = [mark for arg in getattr(info.annotation, "__args__", ()) for mark in getattr(arg, "__metadata__", ())]
        for mark in [*info.metadata, *inner]:
            if isinstance(mark, ArrayField):
                found[name] = maybe(array(mark, sizes)) if mark in inner else array(mark, sizes)
    return st.fixed_dictionaries(found)


@st.composite
def built(draw: st.DrawFn, kind: type[Message], fields: Strategy, axes: dict[str, Strategy] | None = None) -> Message:
    """A message from ``fields`` and arrays whose named axes have drawn lengths; ``axes`` are lists along an axis."""
    sizes = {axis: draw(lengths) for axis in "nrspcwa"}
    along = {name: draw(st.lists(one, min_size=sizes[axis], max_size=sizes[axis])) for (name, axis), one in _axes(axes)}
    return kind(**draw(arrays(kind, **sizes)), **along, **draw(fields))


def _axes(axes: dict[str, Strategy] | None) -> list[tuple[tuple[str, str], Strategy]]:
    """``{"models:r": texts}`` as ((field, axis), elements)."""
    return [((name.split(":")[0], name.split(":")[1]), one) for name, one in (axes or {}).items()]


def fields(**some: Strategy) -> Strategy:
    return st.fixed_dictionaries(some)


places = st.builds(Geodetic, latitude_deg=real(-90, 90), longitude_deg=real(-180, 180), height_m=real(-1e5, 1e9))
header = {"boot_id": boot_ids, "seq": counts}
vectors = st.lists(real(), min_size=3, max_size=3)


@st.composite
def sensor_infos(draw: st.DrawFn) -> SensorInfo:
    kind = draw(st.sampled_from(["radar", "position", "ranging"]))
    sites: list[Strategy] = [
        st.builds(dict, site=places),
        st.builds(dict, site_enu_m=st.lists(real(-1e9, 1e9), min_size=3, max_size=3)),
    ]
    where = draw(st.one_of(*sites, *([st.just({})] if kind == "position" else [])))
    names = draw(st.lists(st.sampled_from(sorted(COLUMN_BOUNDS)), unique=True))
    return SensorInfo(
        sensor_id=draw(ids),
        kind=kind,
        **where,
        period_s=draw(real(1e-3, 1e6)),
        p_detect=draw(real(0, 1, exclude_min=True)),
        max_range_m=draw(real(1e-3, 1e9)),
        sigma={name: draw(real(1e-9, LARGEST_SIGMA.get(name, 1e9))) for name in names},
        interference=draw(maybe(st.dictionaries(st.sampled_from(sorted(COLUMN_BOUNDS)), real(0, 1e9), max_size=3))),
        clutter_density=draw(maybe(real(1e-18, 1e6))),
    )


@st.composite
def scan_parts(draw: st.DrawFn) -> ScanPart:
    sectors = draw(st.integers(1, 65536))
    return ScanPart(index=draw(counts), sector=draw(st.integers(0, sectors - 1)), sectors=sectors)


own_motion = st.lists(real(-1e5, 1e5), min_size=3, max_size=3)
own_places: Strategy = st.one_of(
    st.just({}),
    st.builds(dict, site=places, site_velocity_enu_mps=maybe(own_motion)),
    st.builds(
        dict,
        site_enu_m=st.lists(real(-1e9, 1e9), min_size=3, max_size=3),
        site_velocity_enu_mps=maybe(own_motion),
    ),
)


@st.composite
def plot_batches(draw: st.DrawFn) -> PlotBatch:
    n, columns = draw(lengths), list(draw(st.sampled_from(COLUMN_SETS)))
    values = [draw(st.lists(real(*COLUMN_BOUNDS[c]), min_size=n, max_size=n)) for c in columns]
    most = [LARGEST_SIGMA[c] ** 2 if c in LARGEST_SIGMA else 1e18 for c in columns]
    variances = [draw(st.lists(real(1e-18, high), min_size=n, max_size=n)) for high in most]
    return PlotBatch(
        sensor_id=draw(ids),
        **draw(fields(**header)),
        t_ns=np.array(draw(st.lists(times_ns, min_size=n, max_size=n)), np.int64),
        columns=columns,
        values=np.array(values, float).T,
        variances=np.array(variances, float).T if draw(st.booleans()) else None,
        labels=draw(maybe(st.lists(texts, min_size=n, max_size=n))),
        scan=draw(maybe(scan_parts())),
        **draw(own_places),
    )


@st.composite
def range_batches(draw: st.DrawFn) -> RangeBatch:
    tags, readers = (draw(st.lists(ids, min_size=1, max_size=3)) for _ in range(2))
    given_ = draw(arrays(RangeBatch, n=draw(lengths)))
    given_ |= {"tag": given_["tag"] % len(tags), "reader": given_["reader"] % len(readers)}
    # Either ranges, with or without variances, or signal strengths.
    if given_["range_m"] is None or draw(st.booleans()):
        given_ |= {"range_m": None, "variance_m2": None}
    if given_["range_m"] is not None or given_["rssi_dbm"] is None:
        given_["rssi_dbm"] = None if given_["range_m"] is not None else np.full(len(given_["t_ns"]), -60.0)
    return RangeBatch(network_id=draw(ids), tags=tags, readers=readers, **given_, **draw(fields(**header)))


@st.composite
def tag_frames(draw: st.DrawFn) -> TagFrame:
    n, s = draw(lengths), draw(lengths)
    tag_id, readers = (draw(st.lists(ids, min_size=k, max_size=k)) for k in (n, s))
    given_ = draw(arrays(TagFrame, n=n, m=draw(lengths) if n and s else 0))
    given_["used"] = given_["used"] % np.array([max(n, 1), max(s, 1)], "<u4")
    return TagFrame(tag_id=tag_id, readers=readers, **given_, **draw(fields(**unit, origin=maybe(places))))


query_fields: dict[str, Strategy] = {
    "track_ids": maybe(st.lists(st.integers(0, 2**53), max_size=4)),
    "bbox_enu_m": maybe(st.lists(real(), min_size=4, max_size=4)),
    "bbox_deg": maybe(st.lists(real(), min_size=4, max_size=4)),
    "status": maybe(st.lists(st.integers(0, 3), max_size=4)),
    "max_age_s": maybe(real(0)),
    "at_t_ns": maybe(times_ns),
}


@st.composite
def history_queries(draw: st.DrawFn) -> HistoryQuery:
    first, last = sorted((draw(times_ns), draw(times_ns)))
    return HistoryQuery(from_t_ns=first, to_t_ns=last, **draw(fields(**query_fields)))


sensor_biases = built(
    SensorBias,
    fields(
        sensor_id=ids,
        columns=st.lists(texts, min_size=2, max_size=2),
        locked=st.booleans(),
        pairs=counts,
        jumps=counts,
        notes=st.lists(texts, max_size=2),
    ),
)

transmitters = st.builds(
    EmiTransmitter,
    model=st.sampled_from(["dipole", "loop"]),
    radius_m=real(1e-300, 1e3),
    turns=real(1e-300, 1e6),
    current_a=real(1e-300, 1e6),
    axis=st.lists(real(-1e5, 1e5), min_size=3, max_size=3).filter(lambda v: math.hypot(*v) >= 1e-6),
    offset_m=vectors,
)
directions = st.lists(real(-1e5, 1e5), min_size=3, max_size=3).filter(lambda v: math.hypot(*v) >= 1e-6)
receivers = st.builds(
    EmiReceiver,
    offset_m=vectors,
    components=st.sampled_from(["xyz", "z"]) | st.lists(directions, min_size=1, max_size=3),
    radius_m=real(0, 1e3),
)
priors = st.builds(EmiPrior, position_m=vectors, sd_m=st.lists(real(1e-300, 1e3), min_size=3, max_size=3))
areas = st.lists(real(), min_size=4, max_size=4).filter(lambda a: a[0] != a[2] and a[1] != a[3])
options = st.builds(
    EmiOptions,
    background=st.sampled_from(["none", "const", "plane"]),
    robust=st.booleans(),
    depth_min_m=real(1e-300, 1),
    depth_max_m=maybe(real(1, 1e3, exclude_min=True)),
    max_targets=st.integers(1, 3),
    side=st.sampled_from(["below", "above", "unknown"]),
    area_m=maybe(areas),
    prior=maybe(priors),
    block_m=maybe(real(1e-300, 1e3)),
)


@st.composite
def scan_batches(draw: st.DrawFn) -> EmiScanBatch:
    w, several = draw(st.integers(1, 3)), draw(st.lists(receivers, min_size=1, max_size=2))
    k = sum(receiver.n_components for receiver in several)
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 2)), w, k)
    axes = draw(npst.arrays("<f8", (w, 3), elements=real(-1e6, 1e6)))
    geometry = EmiGeometry(
        positions_m=draw(npst.arrays("<f8", (w, 3), elements=real(-1e3, 1e3))),
        transmitter=draw(transmitters),
        receiver=several[0],
        receivers=several if len(several) > 1 else draw(maybe(st.just(several))),
        axes=axes if (np.linalg.norm(axes, axis=1) >= 1e-6).all() else None,
        attitude=draw(maybe(st.just(np.ones((w, 4))))),
    )
    positive = real(0, exclude_min=True)
    sigma = draw(maybe(positive | st.lists(positive, min_size=k, max_size=k)))
    factor = draw(maybe(npst.arrays("<f8", (w,), elements=real(1e-9, 1e9))))
    by_channel = draw(maybe(npst.arrays("<f8", (shape[1],), elements=real(1e-9, 1e9))))
    sent = draw(st.booleans())
    return EmiScanBatch(
        batch_id=draw(ids),
        geometry=geometry if sent else None,
        geometry_id=draw(maybe(ids)) if sent else draw(ids),
        channels=draw(maybe(st.lists(texts, min_size=shape[1], max_size=shape[1]))),
        channel_factor=None if sigma is None else by_channel,
        field=draw(npst.arrays("<f8", shape, elements=st.just(math.nan) | real())),
        field_unit=draw(st.sampled_from(["T", "nT", "pT", "arbitrary"])),
        sigma=sigma,
        sigma_factor=None if sigma is None else factor,
        options=draw(options),
    )


angles = built(
    EmiAngles,
    fields(
        theta_rad=maybe(real()),
        phi_rad=maybe(real()),
        psi_rad=maybe(real()),
        undefined=st.dictionaries(texts, texts, max_size=3),
    ),
)
targets = built(
    EmiTarget,
    fields(
        position_m=vectors,
        depth_m=real(),
        principal_m3=vectors,
        principal_sd_m3=st.lists(real(0), min_size=3, max_size=3),
        shape=st.sampled_from([None, "isotropic", "axisymmetric", "general"]),
        axis=maybe(vectors),
        axis_sd_rad=maybe(real(0)),
        p_isotropic=maybe(real(0, 1)),
        p_axisymmetric=maybe(real(0, 1)),
        angles=maybe(angles),
        channel=counts,
        inflation=real(0, exclude_min=True),
        ambiguous=st.sampled_from([None, "mirror"]),
    ),
)
results = st.builds(
    EmiResult,
    batch_id=ids,
    index=counts,
    status=st.sampled_from(["ok", "no_target", "low_snr", "edge", "invalid", "too_large"]),
    reasons=st.lists(texts, max_size=2),
    targets=st.lists(targets, max_size=2),
    chi2=maybe(real()),
    dof=maybe(counts),
    p_value=maybe(real(0, 1)),
    likelihood_ratio=maybe(real()),
    sigma_used=maybe(real()),
    n_used=counts,
    n_masked=counts,
    n_outliers=counts,
    iterations=counts,
    local_chi2=maybe(real()),
    bic=st.lists(real(), max_size=4),
    limit=maybe(built(EmiLimit, fields())),
    unit_id=maybe(ids),
    geometry_id=maybe(ids),
)

healths = st.builds(
    SensorHealth,
    sensor_id=ids,
    alive=st.booleans(),
    plots=counts,
    batches=counts,
    gaps=counts,
    duplicates=counts,
    refused=counts,
    last_seq=maybe(counts),
    last_t_ns=maybe(times_ns),
    clutter_density=maybe(real(0)),
    silent_since_ns=maybe(times_ns),
    clock_offset_s=maybe(real()),
    clock_drift_ppm=maybe(real()),
)
statuses = st.builds(
    ServiceStatus,
    kind=ids,
    unit_id=ids,
    **header,
    t_ns=times_ns,
    state=st.sampled_from(["starting", "compiling", "ready", "stopping"]),
    uptime_s=real(0),
    counters=st.dictionaries(texts, counts, max_size=3),
    refused=st.dictionaries(texts, counts, max_size=3),
    latency_ms=st.dictionaries(texts, real(0), max_size=3),
    figures=st.dictionaries(texts, real(), max_size=3),
    sensors=st.lists(healths, max_size=2),
    routers=st.lists(texts, max_size=2),
    degraded=st.lists(texts, max_size=2),
)


@st.composite
def truth_frames(draw: st.DrawFn) -> TruthFrame:
    n, columns = draw(lengths), draw(st.sampled_from([4, 6]))
    return TruthFrame(
        scenario_id=draw(ids),
        t_ns=draw(times_ns),
        id=draw(npst.arrays("<i8", (n,))),
        state=draw(npst.arrays("<f8", (n, columns), elements=real())),
    )


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | real() | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=5,
)
envelopes = (
    st.builds(Envelope, kind=st.just("ok"), schema_name=texts, payload=st.dictionaries(texts, json_values, max_size=3))
    | st.builds(Envelope, kind=st.just("error"), code=texts, detail=texts)
    | st.builds(Envelope, kind=st.just("end"), count=counts)
)

unit = {"unit_id": ids, **header, "t_ns": times_ns}


@st.composite
def unit_areas(draw: st.DrawFn) -> UnitArea:
    area = fields(
        unit_number=st.integers(0, 4095), started_t_ns=times_ns, origin=maybe(places), width_m=real(1e-3, 1e9),
        state=st.sampled_from(["joining", "active", "standby"]),
    )  # fmt: skip
    given_ = draw(arrays(UnitArea, k=draw(lengths)))
    return UnitArea(**given_ | draw(area))


VALID: dict[type[TopMessage], Strategy] = {
    SensorInfo: sensor_infos(),
    PlotBatch: plot_batches(),
    RangeBatch: range_batches(),
    TrackFrame: built(TrackFrame, fields(**unit, origin=maybe(places)), {"models:r": texts, "sensors:s": ids}),
    RefinedFrame: built(RefinedFrame, fields(**unit, lag=st.integers(1, 4))),
    TagFrame: tag_frames(),
    TrackQuery: st.builds(TrackQuery, **query_fields),
    HistoryQuery: history_queries(),
    BandFrame: built(BandFrame, fields(**unit, area=unit_areas())),
    Registration: st.builds(Registration, **unit, sensors=st.lists(sensor_biases, max_size=2)),
    EmiScanBatch: scan_batches(),
    EmiResult: results,
    ServiceStatus: statuses,
    TruthFrame: truth_frames(),
    Envelope: envelopes,
}
"""A strategy for every message that travels by itself."""

messages: st.SearchStrategy[TopMessage] = st.one_of(*VALID.values())

assert set(VALID) == set(MESSAGES.values()), "a message has no strategy"
