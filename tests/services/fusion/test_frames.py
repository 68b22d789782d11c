from __future__ import annotations

import numpy as np
import pymap3d
import pytest
from tests.services.estimation.makers import covariances
from tests.services.fusion.makers import COASTING, CONFIRMED, ENDED, START_NS, TENTATIVE, layer, ns

from trackmesh.protocol.errors import RefusedMessage
from trackmesh.protocol.messages import Geodetic, TrackFrame, TrackQuery
from trackmesh.services.fusion import frames

ORIGIN = Geodetic(latitude_deg=50.0, longitude_deg=8.0, height_m=100.0)


def frame(n: int = 6, sensors: int = 2, first_id: int = 1, origin: Geodetic | None = ORIGIN) -> TrackFrame:
    """Tracks 10 km apart on a line to the north-east, of all statuses in turn, each a second older than the last."""
    state = np.zeros((n, 6))
    state[:, :2] = 1e4 * np.arange(n)[:, None]
    return TrackFrame(
        unit_id="main",
        boot_id="test",
        seq=0,
        t_ns=ns(100.0),
        origin=origin,
        track_id=np.arange(first_id, first_id + n),
        epoch=np.zeros(n, np.uint32),
        status=(1 + np.arange(n) % 3).astype(np.uint8) % 3,
        state=state,
        covariance=np.zeros((n, 21), np.float32),
        model_probability=np.ones((n, 1)),
        models=["cv-1"],
        sensors=[f"s{k}" for k in range(sensors)],
        members=np.arange(n * sensors).reshape(n, sensors),
        updated_t_ns=ns(100.0) - np.arange(n) * 10**9,
        first_t_ns=np.full(n, START_NS),
    )


def selected(query: TrackQuery, of: TrackFrame | None = None) -> list[int]:
    return [int(k) for k in frames.select(of or frame(), query).track_id]


ALL = [TENTATIVE, CONFIRMED, COASTING]


def test_states_are_packed_and_found_again() -> None:
    rng = np.random.default_rng(1)
    x, P = rng.normal(size=(5, 4)), covariances(rng, (5,), 4)
    state, covariance = frames.pack_states(x, P)
    packed = frame(5).model_copy(update={"state": state, "covariance": covariance})
    assert np.array_equal(state, np.pad(x, ((0, 0), (0, 2))))
    np.testing.assert_allclose(packed.covariance_matrices(), np.pad(P, ((0, 0), (0, 2), (0, 2))), rtol=1e-6)
    assert covariance.dtype == np.dtype("<f4")


def test_status_is_told_by_the_age_of_the_last_plot() -> None:
    bank = layer()
    bank.life.confirmed[:3] = [False, True, True]
    bank.life.last_s[:3] = [0.0, 4.0, 3.9]
    assert frames.status_of(bank, np.arange(3), 10.0, 6.0).tolist() == [TENTATIVE, CONFIRMED, COASTING]


def test_without_conditions_the_confirmed_and_the_coasting() -> None:
    assert frame().status.tolist() == [1, 2, 0, 1, 2, 0]
    assert selected(TrackQuery()) == [1, 2, 4, 5]


@pytest.mark.parametrize(
    ("query", "wanted"),
    [
        (TrackQuery(status=[TENTATIVE]), [3, 6]),
        (TrackQuery(status=[]), []),
        (TrackQuery(status=[ENDED]), []),
        (TrackQuery(track_ids=[5, 3, 77]), [5]),
        (TrackQuery(track_ids=[5, 3, 77], status=ALL), [3, 5]),
        (TrackQuery(track_ids=[]), []),
        (TrackQuery(max_age_s=1.0), [1, 2]),
        (TrackQuery(max_age_s=0.0), [1]),
        (TrackQuery(bbox_enu_m=[1e4, 0.0, 4e4, 3e4], status=ALL), [2, 3, 4]),
        (TrackQuery(bbox_enu_m=[1e4, 0.0, 4e4, 3e4], max_age_s=2.0), [2]),
    ],
)
def test_every_condition_must_hold(query: TrackQuery, wanted: list[int]) -> None:
    assert selected(query) == wanted


def test_a_box_in_degrees() -> None:
    place = frame().state[:, :2]
    latitude, longitude, _ = pymap3d.enu2geodetic(place[:, 0], place[:, 1], np.zeros(6), 50.0, 8.0, 100.0)
    box = [latitude[1] - 1e-6, longitude[1] - 1e-6, latitude[3] + 1e-6, longitude[3] + 1e-6]
    assert selected(TrackQuery(bbox_deg=box, status=ALL)) == [2, 3, 4]
    narrow = [latitude[1] + 1e-6, longitude[1] - 1e-6, latitude[3] + 1e-6, longitude[3] - 1e-6]
    assert selected(TrackQuery(bbox_deg=narrow, status=ALL)) == [3]
    np.testing.assert_allclose(frames.geodetic(place, ORIGIN), (latitude, longitude), atol=1e-12)


def test_boxes_that_cannot_be_answered_are_refused() -> None:
    with pytest.raises(RefusedMessage, match="no geographic origin") as error:
        frames.select(frame(origin=None), TrackQuery(bbox_deg=[0.0, 0.0, 1.0, 1.0]))
    assert error.value.reason == "no_origin"
    for box in ([1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 1.0, 0.0]):
        with pytest.raises(RefusedMessage, match="south-west"):
            frames.select(frame(), TrackQuery(bbox_enu_m=box))


def test_taking_keeps_rows_together() -> None:
    whole = frame()
    part = frames.take(whole, np.array([False, True, False, False, True, False]))
    assert part.track_id.tolist() == [2, 5]
    assert part.members.tolist() == [[2, 3], [8, 9]]
    assert part.state[:, 0].tolist() == [1e4, 4e4]
    TrackFrame.model_validate(part.model_dump())


def test_joining_fills_up_the_sensors_that_came_later() -> None:
    joined = frames.join(frame(2, sensors=3), [frame(1, sensors=2, first_id=10), frame(1, sensors=3, first_id=20)])
    assert joined.track_id.tolist() == [1, 2, 10, 20]
    assert joined.members.tolist() == [[0, 1, 2], [3, 4, 5], [0, 1, -1], [0, 1, 2]]
    TrackFrame.model_validate(joined.model_dump())
