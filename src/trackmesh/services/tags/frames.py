"""The picture as a message."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from trackmesh.protocol.messages import TagFrame
from trackmesh.services.tags.telling import Told, pack, shared

IntArray = npt.NDArray[np.int64]
UInt8Array = npt.NDArray[np.uint8]
UInt32Array = npt.NDArray[np.uint32]

_PER_TAG = (
    "status",
    "state",
    "covariance",
    "quality",
    "certainty",
    "other",
    "range_bias_m",
    "range_scale",
    "updated_t_ns",
)


def make_frame(
    header: dict[str, object],
    names: list[str],
    status: UInt8Array,
    told: Told,
    reader_names: Sequence[str],
    updated_t_ns: IntArray,
) -> TagFrame:
    """A frame of n tags; ``header`` holds unit_id, boot_id, seq, t_ns and origin."""
    state, covariance = pack(told)
    bias, scale = shared(told)
    readers, used = _used(told.used, reader_names)
    return TagFrame.model_construct(
        schema_version=1,
        **header,  # type: ignore[arg-type]
        tag_id=names,
        status=status,
        state=state,
        covariance=covariance,
        quality=np.clip(told.quality, 0.0, 1.0),
        certainty=np.clip(told.certainty, 0.0, 1.0),
        other=told.other,
        range_bias_m=bias,
        range_scale=scale,
        readers=readers,
        used=used,
        updated_t_ns=updated_t_ns,
    )


def join(frame: TagFrame, others: list[TagFrame]) -> TagFrame:
    """The frame with the tags of others behind its own; of those it is not said which readers they used."""
    return frame.model_copy(
        update={"tag_id": [name for f in (frame, *others) for name in f.tag_id]}
        | {
            name: np.concatenate([getattr(f, name) for f in (frame, *others)])
            for name in _PER_TAG
            if getattr(frame, name) is not None
        }
    )


def _used(rows: IntArray, reader_names: Sequence[str]) -> tuple[list[str], UInt32Array]:
    """Names of the readers in rows (n, k), -1 for none, and the pairs of tag and index into these names."""
    tag, place = np.nonzero(rows >= 0)
    reader = rows[tag, place]
    # A reader that has moved has several rows and one name.
    names = sorted({reader_names[row] for row in np.unique(reader).tolist()})
    index = {name: k for k, name in enumerate(names)}
    of_row = np.zeros(len(reader_names), np.int64)
    for row in np.unique(reader).tolist():
        of_row[row] = index[reader_names[row]]
    pairs = np.unique(np.column_stack([tag, of_row[reader]]), axis=0) if len(tag) else np.empty((0, 2), np.int64)
    return names, pairs.astype("<u4")
